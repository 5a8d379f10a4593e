"""The demo's room, its cameras, and ray-cast photographs of its analytic surfaces.

Notation: world axes x and y along the floor, z up, metres; the room's corner is at (-1.6, -1.6). V
views of H x W pixels with centres at +0.5; ``pixel_rays`` have unit z in camera axes, so that the
ray parameter t of a hit is planar z. The room has every kind of surface on which upsampling behaves
differently: textured planes (floor, brick wall, box), curved surfaces (sphere, cylinder, wavy
screen), foliage, and a textureless wall. Depth is exact to float32 at pixel centres; colours are
means over a grid of rays, for antialiasing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, UInt8

from splatseed.camera import Camera
from splatseed.photos.viewpoint import look_at
from splatseed.photos.visibility import points_in_image
from splatseed.progress import num_threads
from splatseed.projection import pixel_centers
from splatseed.synthetic.surfaces import (
    Box,
    Cylinder,
    Discs,
    Points,
    Rectangle,
    SineSheet,
    Sphere,
    Surface,
    Union,
    yaw_frame,
)
from splatseed.synthetic.texture import Mottled, Plain, Texture, Tiles

TEXTURELESS = "bare wall"
"""The surface without texture."""

CORNER = -1.6
"""x and y of the room's corner, metres."""
REACH = 4.6
"""Length of the walls."""
WALL_HEIGHT = 2.4
NUM_LEAVES = 300

UP = np.array([0.0, 0.0, 1.0])
LOOK_AT = np.array([-0.15, -0.15, 0.45])
FOCAL = 0.95
"""Focal length in image widths: a 55 degree lens, like a phone's."""
SUN = np.array([0.48, 0.30, 0.82]) / np.linalg.norm([0.48, 0.30, 0.82])
"""Direction to the sun."""
AMBIENT = 0.45
"""Share of ambient light."""
BACKGROUND = np.array([0.72, 0.78, 0.84])

BUNDLE = 16_384
"""Rays per bundle: small enough for the cache, and for BLAS not to start threads of its own."""


@dataclass(frozen=True)
class Room:
    """Named surfaces with textures."""

    names: tuple[str, ...]  # of the surfaces, such as "bare wall"
    surfaces: Union
    textures: tuple[Texture, ...]  # of the surfaces, in their order

    def part(self, name: str) -> Surface:
        """Return the surface of a name."""
        return self.surfaces.parts[self.names.index(name)]

    def without(self, name: str) -> Union:
        """Return all surfaces except one."""
        return Union(tuple(part for part in self.surfaces.parts if part is not self.part(name)))


def build_room(rng: np.random.Generator) -> Room:
    """Build the room; ``rng`` places the leaves, all else is fixed."""
    pieces = {**_walls(), **_furniture(), **_plant(rng)}
    return Room(
        tuple(pieces),
        Union(tuple(surface for surface, _ in pieces.values())),
        tuple(texture for _, texture in pieces.values()),
    )


def _grain(frequency: float, seed: int, stretch: tuple[float, float, float] = (1, 1, 1)) -> Mottled:
    x, y, z = (frequency * s for s in stretch)
    return Mottled(((0.55,) * 3, (1.35,) * 3), (x, y, z), octaves=3, seed=seed)


def _walls() -> dict[str, tuple[Surface, Texture]]:
    corner = np.array([CORNER, CORNER, 0.0])
    along_x, along_y, up = np.diag([REACH, REACH, WALL_HEIGHT])
    oak = ((0.42, 0.27, 0.15), (0.66, 0.46, 0.28), (0.80, 0.62, 0.42))
    brick = ((0.55, 0.24, 0.18), (0.68, 0.36, 0.26), (0.74, 0.52, 0.40), (0.60, 0.30, 0.24))
    return {
        "floor": (
            Rectangle(corner, along_x, along_y),
            Tiles(oak, (0.9, 0.16, 9.0), _grain(14.0, 1, (0.5, 1.5, 1)), joint=0.012, seed=1),
        ),
        "brick wall": (
            Rectangle(corner, along_x, up),
            Tiles(brick, (0.26, 9.0, 0.12), _grain(11.0, 2), joint=0.022, seed=2),
        ),
        TEXTURELESS: (Rectangle(corner, along_y, up), Plain((0.83, 0.84, 0.82))),
    }


def _furniture() -> dict[str, tuple[Surface, Texture]]:
    parcel = ((0.20, 0.36, 0.60), (0.85, 0.80, 0.66), (0.88, 0.60, 0.22), (0.30, 0.55, 0.56))
    marble = ((0.15, 0.17, 0.28), (0.52, 0.55, 0.66), (0.93, 0.91, 0.88))
    rust = ((0.28, 0.14, 0.12), (0.66, 0.33, 0.18), (0.86, 0.68, 0.44))
    cloth = ((0.45, 0.12, 0.26), (0.80, 0.45, 0.42), (0.96, 0.86, 0.70))
    # Across the room's corner: u along (1, -1), v up, w into the corner.
    upright = np.array([[1.0, -1.0, 0.0], [0.0, 0.0, np.sqrt(2)], [-1.0, -1.0, 0.0]]) / np.sqrt(2)
    return {
        "box": (
            Box(np.array([0.25, -0.75, 0.3]), np.array([0.38, 0.28, 0.3]), yaw_frame(24)),
            Tiles(parcel, (0.14, 0.14, 0.14), _grain(14.0, 3), seed=3),
        ),
        "sphere": (
            Sphere(np.array([0.30, 0.35, 0.32]), 0.32),
            Mottled(marble, (6.5, 6.5, 6.5), octaves=4, contrast=3.0, seed=4),
        ),
        "cylinder": (
            Cylinder(np.array([-0.62, 0.10, 0.24]), yaw_frame(0), 0.21, 0.48),
            Mottled(rust, (7.0, 7.0, 11.0), octaves=4, contrast=2.6, seed=5),
        ),
        "wavy screen": (
            SineSheet(np.array([-1.5, -0.4, 0.0]), upright, np.array([1.54, 1.25]), 0.07, 0.44),
            Mottled(cloth, (9.0, 9.0, 5.0), octaves=4, contrast=2.8, seed=6),
        ),
    }


def _plant(rng: np.random.Generator) -> dict[str, tuple[Surface, Texture]]:
    """Make leaves of random orientation in a ball above the cylinder, their pot."""
    direction = rng.normal(size=(NUM_LEAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # The cube root gives uniform density; a positive minimum leaves room for the stem.
    reach = 0.36 * np.cbrt(rng.uniform(0.15, 1.0, NUM_LEAVES))
    axes = direction + 0.8 * rng.normal(size=(NUM_LEAVES, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    centers = np.array([-0.62, 0.10, 0.86]) + direction * reach[:, None]
    leaves = Discs(centers, axes, rng.uniform(0.035, 0.065, NUM_LEAVES))
    green = ((0.07, 0.20, 0.06), (0.22, 0.45, 0.12), (0.55, 0.70, 0.25), (0.85, 0.85, 0.45))
    return {"leaves": (leaves, Mottled(green, (14.0, 14.0, 14.0), octaves=3, contrast=2.4, seed=7))}


def orbit_cameras(num_views: int, width: int, height: int) -> tuple[Camera, ...]:
    """Place cameras on an arc around the open side of the room, at varying height.

    All face the middle of the room, with the y axis down.
    """
    K = np.array([[FOCAL * width, 0.0, width / 2], [0.0, FOCAL * width, height / 2], [0, 0, 1.0]])
    share = (np.arange(num_views) + 0.5) / num_views
    azimuth = np.radians(-15.0 + 120.0 * share)
    elevation = np.radians(30.0 + 17.0 * np.sin(2.0 * np.pi * 3.0 * share))
    radius = 2.75 + 0.25 * np.cos(2.0 * np.pi * 5.0 * share)
    across = np.cos(elevation)
    outward = np.stack(
        [np.cos(azimuth) * across, np.sin(azimuth) * across, np.sin(elevation)], axis=1
    )
    eyes = LOOK_AT + radius[:, None] * outward
    return tuple(Camera(K, width, height, look_at(eye, LOOK_AT, UP)) for eye in eyes)


# Photographs -------------------------------------------------------------------------------------


def pixel_rays(camera: Camera, dx: float = 0.0, dy: float = 0.0) -> Points:
    """Return world directions through the pixels, row by row, [H*W, 3], with unit camera z.

    ``dx`` and ``dy`` offset the rays from pixel centres, px.
    """
    uv = pixel_centers(camera.height, camera.width) + np.array([dx, dy])
    return camera.rays(uv).reshape(-1, 3)


def render_views(
    room: Room, cameras: Sequence[Camera], supersample: int = 2
) -> tuple[UInt8[np.ndarray, "V H W 3"], Float32[np.ndarray, "V H W"]]:
    """Render uint8 sRGB images [V, H, W, 3] and planar z float32 [V, H, W]; 0 = no hit."""
    # Views are independent, so threads do not change the result.
    with ThreadPoolExecutor(num_threads()) as pool:
        views = list(pool.map(lambda camera: render_view(room, camera, supersample), cameras))
    return np.stack([image for image, _ in views]), np.stack([depth for _, depth in views])


def render_view(
    room: Room, camera: Camera, supersample: int = 2
) -> tuple[UInt8[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """Render a photograph and its depth, with ``supersample``^2 rays per pixel for colour."""
    shape = (camera.height, camera.width)
    t = _in_bundles(lambda rays: room.surfaces.intersect(camera.center, rays), pixel_rays(camera))
    depth = np.where(np.isfinite(t), t, 0.0).astype(np.float32).reshape(shape)
    offsets = (np.arange(supersample) + 0.5) / supersample - 0.5
    total = sum(
        _in_bundles(lambda rays: _shade(room, camera, rays), pixel_rays(camera, dx, dy))
        for dy in offsets
        for dx in offsets
    )
    image = np.round(255.0 * total / supersample**2).astype(np.uint8)
    return image.reshape(*shape, 3), depth


def _in_bundles(function: Callable[[np.ndarray], np.ndarray], directions: Points) -> np.ndarray:
    bundles = range(0, len(directions), BUNDLE)
    return np.concatenate([function(directions[start : start + BUNDLE]) for start in bundles])


def _shade(room: Room, camera: Camera, directions: Points) -> Points:
    """Shade rays, colours 0..1: texture times Lambertian light of a distant sun."""
    t, which = room.surfaces.intersect_parts(camera.center, directions)
    colors = np.tile(BACKGROUND, (len(directions), 1))
    for i, (surface, texture) in enumerate(zip(room.surfaces.parts, room.textures, strict=True)):
        mine = np.flatnonzero(which == i)
        if len(mine):
            xyz = camera.center + t[mine, None] * directions[mine]
            normals = surface.normals(xyz)
            facing = -np.sign(np.einsum("ij,ij->i", normals, directions[mine]))  # two-sided
            light = AMBIENT + (1.0 - AMBIENT) * np.maximum(facing * (normals @ SUN), 0.0)
            colors[mine] = texture(xyz) * light[:, None]
    return colors


def visible(surfaces: Surface, camera: Camera, xyz: Points) -> Bool[np.ndarray, " N"]:
    """Whether each surface point is in the image and not occluded, [N]."""
    seen = points_in_image(camera, xyz).point_idx
    first = surfaces.intersect(camera.center, xyz[seen] - camera.center)
    result = np.zeros(len(xyz), bool)
    result[seen] = first > 1.0 - 1e-6  # t = 1 is the point itself
    return result
