"""Photographs of analytic surfaces, by ray casting.

Notation: V views of H x W pixels with centres at +0.5. ``pixel_rays`` have unit z in camera axes,
so the ray parameter t of a hit is its planar z-depth. Promise: depth is that of the surface along
the ray through the pixel's centre, exact up to float32; colour is the mean over a small grid of
rays, so that edges are smooth; nothing is random.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.camera import Camera
from splatseed.synthetic.room import Room
from splatseed.synthetic.surfaces import Surface

SUN = np.array([0.48, 0.30, 0.82]) / np.linalg.norm([0.48, 0.30, 0.82])
"""Direction to the sun."""
AMBIENT = 0.45
"""Share of the light that comes from everywhere."""
BACKGROUND = np.array([0.72, 0.78, 0.84])

BUNDLE = 16_384
"""Rays per bundle: temporaries stay in the cache, and products are too small for BLAS's own
threads, which would compete with ours."""


def pixel_rays(camera: Camera, dx: float = 0.0, dy: float = 0.0) -> Float64[np.ndarray, "HW 3"]:
    """World directions through the pixels, row by row, [H*W, 3], one unit along camera z each.

    ``dx`` and ``dy`` move the ray off the pixel's centre, in pixels.
    """
    world_from_pixel = camera.cam_from_world[:3, :3].T @ np.linalg.inv(camera.K)
    u = (np.arange(camera.width) + (0.5 + dx))[:, None] * world_from_pixel[:, 0]
    v = (np.arange(camera.height) + (0.5 + dy))[:, None] * world_from_pixel[:, 1]
    return np.asarray(v[:, None] + u + world_from_pixel[:, 2]).reshape(-1, 3)


def render_views(
    room: Room, cameras: Sequence[Camera], supersample: int = 2
) -> tuple[UInt8[np.ndarray, "V H W 3"], Float32[np.ndarray, "V H W"]]:
    """Images, uint8 sRGB [V, H, W, 3], and planar z-depths, float32 [V, H, W]; 0 = nothing hit."""
    # The views are independent and the work releases the GIL, so threads change only the time.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        views = list(pool.map(lambda camera: render_view(room, camera, supersample), cameras))
    return np.stack([image for image, _ in views]), np.stack([depth for _, depth in views])


def render_view(
    room: Room, camera: Camera, supersample: int = 2
) -> tuple[UInt8[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]]:
    """One photograph and its depth; ``supersample`` squared rays per pixel for the colour."""
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


def _in_bundles(
    function: Callable[[np.ndarray], np.ndarray], directions: Float64[np.ndarray, "N 3"]
) -> np.ndarray:
    """``function`` of the rays, ``BUNDLE`` at a time."""
    bundles = range(0, len(directions), BUNDLE)
    return np.concatenate([function(directions[start : start + BUNDLE]) for start in bundles])


def _shade(
    room: Room, camera: Camera, directions: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, "N 3"]:
    """Colours 0..1 along rays: texture times Lambert's cosine under a distant sun."""
    t, which = room.surfaces.intersect_parts(camera.center, directions)
    colors = np.tile(BACKGROUND, (len(directions), 1))
    for i, (surface, texture) in enumerate(zip(room.surfaces.parts, room.textures, strict=True)):
        mine = np.flatnonzero(which == i)
        if len(mine):
            xyz = camera.center + t[mine, None] * directions[mine]
            light = _lambert(surface.normals(xyz), directions[mine])
            colors[mine] = texture(xyz) * light[:, None]
    return colors


def _lambert(
    normals: Float64[np.ndarray, "N 3"], directions: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, " N"]:
    """Lambertian brightness 0..1 of the visible side: sheets and leaves have two."""
    facing = -np.sign(np.einsum("ij,ij->i", normals, directions))
    return np.asarray(AMBIENT + (1.0 - AMBIENT) * np.maximum(facing * (normals @ SUN), 0.0))


def visible(
    surfaces: Surface, camera: Camera, xyz: Float64[np.ndarray, "N 3"]
) -> Bool[np.ndarray, " N"]:
    """Which points on the surfaces the camera sees: in the image and not occluded, [N]."""
    uv, depth = camera.project(xyz)
    inside = (depth > 0) & (uv >= 0).all(axis=1) & (uv < [camera.width, camera.height]).all(axis=1)
    seen: Int64[np.ndarray, " M"] = np.flatnonzero(inside)
    first = surfaces.intersect(camera.center, xyz[seen] - camera.center)
    result = np.zeros(len(xyz), bool)
    result[seen] = first > 1.0 - 1e-6  # t = 1 is the point itself
    return result
