"""Made captures whose poses and points are right, but hard to confirm: nothing may be called wrong.

Notation: V views of H x W pixels, metres, as in ``splatseed.synthetic``. Points are those of
simulated Structure-from-Motion; a *scan* instead has points wherever cameras see a surface, also on
bare walls, and no tracks.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from PIL import Image as PillowImage
from scipy.ndimage import zoom
from scipy.spatial.transform import Rotation

from splatseed import PointCloud, Scene, load_scene
from splatseed.camera import Camera, Intrinsics, quat_from_rotation
from splatseed.photos.viewpoint import look_at
from splatseed.scene import Image
from splatseed.synthetic.capture import Capture, photograph_room, write_capture
from splatseed.synthetic.room import UP, Room, build_room, orbit_cameras, render_views
from splatseed.synthetic.surfaces import Box, Cylinder, Rectangle, Sphere, Surface, Union, yaw_frame
from splatseed.synthetic.texture import Mottled, Plain, Points, Texture, Tiles

__all__ = ["HARD_CAPTURES", "make_hard_capture"]

WIDTH, HEIGHT, VIEWS = 240, 180, 14
SCAN = 6000
"""Points of a scan."""
CLAY = Plain((0.8, 0.78, 0.74))
STONE = Mottled(((0.2, 0.2, 0.25), (0.8, 0.75, 0.7)), (7.0, 7.0, 7.0), octaves=4, contrast=3.0)
Pieces = Sequence[tuple[Surface, Texture]]
Maker = Callable[[np.random.Generator], Capture]


def make_hard_capture(name: str, folder: Path) -> Scene:
    """Write one of ``HARD_CAPTURES`` into a folder that does not exist, and load it."""
    capture = HARD_CAPTURES[name](np.random.default_rng(0))
    write_capture(capture, folder)
    if name.endswith(MASKED):
        (folder / "masks").mkdir()
        for image, depth in zip(capture.scene.images, capture.depths, strict=True):
            shown = np.where(depth > 0, 255, 0).astype(np.uint8)
            PillowImage.fromarray(shown).save(folder / "masks" / f"{image.name}.png")
    return load_scene(folder)


def _checks(side: float) -> Texture:
    """A chessboard in space: every field looks like the next but one."""

    def colors(xyz: Points) -> Points:
        odd = np.floor(xyz / side + 0.37).sum(axis=1) % 2 > 0
        return np.where(odd[:, None], 0.85, 0.2) * np.ones(3)

    return colors


def _corner(texture: Texture) -> Pieces:
    """A floor and two walls of one texture."""
    low, (x, y, z) = np.array([-1.6, -1.6, 0.0]), np.diag([4.6, 4.6, 2.4])
    return [(Rectangle(low, *sides), texture) for sides in ((x, y), (x, z), (y, z))]


def _furniture(texture: Texture) -> Pieces:
    box = Box(np.array([0.25, -0.75, 0.3]), np.array([0.38, 0.28, 0.3]), yaw_frame(24.0))
    ball = Sphere(np.array([0.3, 0.35, 0.32]), 0.32)
    return [(box, texture), (ball, texture)]


def _room(*pieces: Pieces) -> Room:
    parts = [each for group in pieces for each in group]
    names = tuple(f"part {i}" for i in range(len(parts)))
    surfaces = Union(tuple(surface for surface, _ in parts))
    return Room(names, surfaces, tuple(texture for _, texture in parts))


def _rods() -> Pieces:
    """Thin rods and nothing else: most pixels show the background."""
    places = np.stack(np.meshgrid([-0.7, -0.1, 0.5], [-0.7, -0.1, 0.5]), -1).reshape(-1, 2)
    bands = Tiles(((0.1, 0.1, 0.4), (0.7, 0.2, 0.1)), (9.0, 9.0, 0.08), STONE)
    return [(Cylinder(np.array([x, y, 0.5]), yaw_frame(0.0), 0.02, 1.0), bands) for x, y in places]


def _orbit(views: int = VIEWS) -> tuple[Camera, ...]:
    return orbit_cameras(views, WIDTH, HEIGHT)


def _facing(spread: float) -> tuple[Camera, ...]:
    """Cameras side by side that look the same way, ``spread`` metres from first to last."""
    first = _orbit()[VIEWS // 2]
    steps = np.linspace(-0.5, 0.5, VIEWS)
    places = np.stack([steps, 0.3 * np.sin(7 * steps), np.zeros(VIEWS)], axis=1) * spread
    poses = np.tile(first.cam_from_world, (VIEWS, 1, 1))
    poses[:, :3, 3] -= places
    return tuple(replace(first, cam_from_world=pose) for pose in poses)


def _turning(drift: float = 0.0) -> tuple[Camera, ...]:
    """Cameras that turn in the middle of the room, moved by ``drift`` metres in all."""
    K, cameras = _orbit()[0].K, []
    for share in np.linspace(0.0, 1.0, VIEWS):
        eye = np.array([0.9 + drift * share, 0.9, 0.8])
        ahead = Rotation.from_euler("z", 180.0 + 90.0 * share, degrees=True).apply([1.0, 0, -0.2])
        cameras.append(Camera(K, WIDTH, HEIGHT, look_at(eye, eye + ahead, UP)))
    return tuple(cameras)


def _sfm(room: Room, cameras: Sequence[Camera]) -> Maker:
    return lambda rng: photograph_room(room, cameras, rng)


def _scan(room: Room, cameras: Sequence[Camera], num: int = SCAN) -> Maker:
    def make(rng: np.random.Generator) -> Capture:
        pixels, depths = render_views(room, cameras)
        view, row, column = (each[:, 0] for each in np.split(np.argwhere(depths > 0), 3, axis=1))
        kept = rng.permutation(len(view))[:num]
        view, row, column = view[kept], row[kept], column[kept]
        uv, z = np.stack([column, row], axis=1) + 0.5, depths[view, row, column].astype(float)
        xyz = np.empty((len(view), 3), np.float32)
        for i, camera in enumerate(cameras):
            xyz[view == i] = camera.unproject(uv[view == i], z[view == i])
        (fx, _, cx), (_, fy, cy) = cameras[0].K[:2]
        lens = Intrinsics(1, "PINHOLE", WIDTH, HEIGHT, (fx, fy, cx, cy))
        images = tuple(
            Image(f"view_{i:03d}.png", i + 1, lens, quat_from_rotation(T[:3, :3]), T[:3, 3])
            for i, T in enumerate(camera.cam_from_world for camera in cameras)
        )
        scene = Scene(PointCloud(xyz, pixels[view, row, column]), images, (lens,))
        return Capture(scene, pixels, depths, room, np.zeros(len(xyz), bool))

    return make


def _few(make: Maker, num: int) -> Maker:
    """Only the first points; tracks are left out."""

    def fewer(rng: np.random.Generator) -> Capture:
        capture = make(rng)
        points = capture.scene.points.select(np.arange(len(capture.scene.points)) < num)
        return replace(capture, scene=capture.scene.with_points(points))

    return fewer


def _changed(
    make: Maker, change: Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]
) -> Maker:
    """Photographs [H W 3] that were changed, by their depth [H W] and random numbers."""

    def changed(rng: np.random.Generator) -> Capture:
        capture = make(rng)
        pixels = [change(*each, rng) for each in zip(capture.images, capture.depths, strict=True)]
        return replace(capture, images=np.clip(pixels, 0, 255).astype(np.uint8))

    return changed


def _on_white(image: np.ndarray, depth: np.ndarray, _: np.random.Generator) -> np.ndarray:
    return np.where(depth[..., None] > 0, image, 255)


def _on_turntable(image: np.ndarray, depth: np.ndarray, _: np.random.Generator) -> np.ndarray:
    """A background that does not turn with the object."""
    rng = np.random.default_rng(5)
    wall = zoom(rng.uniform(0, 255, (HEIGHT // 10, WIDTH // 10, 3)), (10, 10, 1), order=1)
    return np.where(depth[..., None] > 0, image, wall)


def _exposed(image: np.ndarray, _: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return image * rng.uniform(0.4, 1.2)


def _noisy(image: np.ndarray, _: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return image + rng.normal(scale=15.0, size=image.shape)


_CLUTTER = build_room(np.random.default_rng(0))
_OBJECT = _room(_furniture(STONE))
_BARE, _HALF_BARE = _room(_corner(CLAY), _furniture(CLAY)), _room(_corner(CLAY), _furniture(STONE))
_CHECKED = _room(_corner(_checks(0.12)), _furniture(_checks(0.08)))
_CHECKED_WALLS = _room(_corner(_checks(0.2)), _furniture(STONE))
MASKED = ", masked"
"""How names of captures end whose masks leave out the background."""
_TURNTABLE = _changed(_sfm(_OBJECT, _orbit()), _on_turntable)
_RODS = _changed(_sfm(_room(_rods()), _orbit()), _on_white)
HARD_CAPTURES: Mapping[str, Maker] = MappingProxyType(
    {
        "bare walls and furniture, a scan": _scan(_BARE, _orbit()),
        "bare walls, a scan": _scan(_HALF_BARE, _orbit()),
        "bare walls": _sfm(_HALF_BARE, _orbit()),
        "chessboards, a scan": _scan(_CHECKED, _orbit()),
        "chessboards": _sfm(_CHECKED, _orbit()),
        "chessboards as walls": _sfm(_CHECKED_WALLS, _orbit()),
        "cameras that turn in one place, a scan": _scan(_CLUTTER, _turning()),
        "cameras that turn, and move 3 cm": _scan(_CLUTTER, _turning(0.03)),
        "two photographs, a scan": _scan(_CLUTTER, _orbit()[6:8]),
        "three photographs": _sfm(_CLUTTER, _orbit()[6:9]),
        "four photographs all around, a scan": _scan(_CLUTTER, _orbit()[::4]),
        "cameras within 1 cm, a scan": _scan(_CLUTTER, _facing(0.01)),
        "cameras within 5 cm": _sfm(_CLUTTER, _facing(0.05)),
        "cameras within 5 cm, a scan": _scan(_CLUTTER, _facing(0.05)),
        "cameras within 20 cm": _sfm(_CLUTTER, _facing(0.2)),
        "30 points": _few(_sfm(_CLUTTER, _orbit()), 30),
        "100 points": _few(_sfm(_CLUTTER, _orbit()), 100),
        "rods on white": _RODS,
        f"rods on white{MASKED}": _RODS,
        "rods on white, a scan": _changed(_scan(_room(_rods()), _orbit()), _on_white),
        "a turntable": _TURNTABLE,
        f"a turntable{MASKED}": _TURNTABLE,
        "a turntable, a scan": _changed(_scan(_OBJECT, _orbit()), _on_turntable),
        "other exposures": _changed(_sfm(_CLUTTER, _orbit()), _exposed),
        "noise": _changed(_scan(_CLUTTER, _orbit()), _noisy),
    }
)
"""Makers of captures by what is hard about them."""
