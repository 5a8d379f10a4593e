"""A room of Gaussians as training leaves them, its photographs, and how much is blended in it.

Notation: N Gaussians in the made room's metres (``splatseed.synthetic``), V cameras of W x H
pixels. A *useful pair* is a pixel with a Gaussian that adds to its colour: alpha is at least 1/255,
and the pixel's transmittance has not ended before. Promise: the same scene for the same numbers and
seed. ``SIZE`` was chosen once, so that a pixel has about 50 useful pairs at 400 x 300 with 50,000
Gaussians and at 800 x 600 with 200,000 (both are 2.4 pixels a Gaussian); how many there are is
always counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from benchmarks.common.clouds import sample_unevenly
from jaxtyping import Bool, Float32, Float64
from scipy.spatial.transform import Rotation

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.rendering._kernels.binning import RECORD, TILE
from splatseed.rendering._kernels.layout import gather
from splatseed.rendering.binning import depth_order, list_tiles
from splatseed.runtime.jit import kernel, parallel_range
from splatseed.splat.from_seeds import neighbor_distances
from splatseed.splat.gaussians import PARAMETERS, SH_C0, Gaussians
from splatseed.synthetic.room import Room, build_room, orbit_cameras, render_views, visible

__all__ = ["Workload", "make_workload", "useful_pairs"]

SIZE = 1.4
"""Mean size along the surface in local spacings."""
SIZE_SPREAD = 0.5
"""Standard deviation of the logarithm of each axis."""
THICKNESS = 0.1
"""Size across the surface, of the size along it."""
OPACITY_SPREAD = 2.0
"""Standard deviation of the opacities' logits: trained scenes have many faint and many solid
ones."""
FAINTEST = 0.005
"""Densification prunes what is fainter."""
HARMONICS = 0.03
"""Standard deviation of the coefficients beyond the first."""
WAVELENGTH = 1.0
"""How far dense and sparse parts are from each other, metres."""
NUM_VIEWS = 8
VIEW = ("photograph", "K", "cam_from_world")
"""The arrays of a view."""
SPARE = 1.6
"""Gaussians drawn for each that is seen."""
MIN_ALPHA, MAX_ALPHA, STOP = np.float32(1 / 255), np.float32(0.999), np.float32(1e-4)


@dataclass(frozen=True, eq=False)
class Workload:
    """Gaussians and photographs of what they show, in one frame."""

    gaussians: Gaussians
    views: tuple[View, ...]

    def save(self, path: Path) -> None:
        """Write everything to an .npz."""
        views = {name: np.stack([getattr(view, name) for view in self.views]) for name in VIEW}
        np.savez(path, **self.gaussians.arrays(), **views)

    @staticmethod
    def load(path: Path) -> Workload:
        """Read what ``save`` wrote."""
        with np.load(path) as arrays:
            gaussians = Gaussians(**{name: arrays[name] for name in PARAMETERS})
            rows = zip(*(arrays[name] for name in VIEW), strict=True)
            views = tuple(
                View(f"{i:03d}.png", image, Camera(K, image.shape[1], image.shape[0], pose))
                for i, (image, K, pose) in enumerate(rows)
            )
        return Workload(gaussians, views)


def make_workload(num: int, width: int, height: int, seed: int = 0) -> Workload:
    """``num`` Gaussians on what eight cameras see of the room, and their photographs."""
    rng = np.random.default_rng(seed)
    room = build_room(rng)
    cameras = orbit_cameras(NUM_VIEWS, width, height)
    xyz = _seen_points(room, cameras, num, rng)
    gaussians = _gaussians(xyz, *_normals_and_colors(room, xyz), rng)
    images, _ = render_views(room, cameras)
    views = tuple(
        View(f"{i:03d}.png", image, camera)
        for i, (image, camera) in enumerate(zip(images, cameras, strict=True))
    )
    return Workload(gaussians, views)


def _seen_points(
    room: Room, cameras: Sequence[Camera], num: int, rng: np.random.Generator
) -> Float64[np.ndarray, "num 3"]:
    """Uneven samples of the surfaces that some camera sees."""
    batches: list[np.ndarray] = []
    while sum(map(len, batches)) < num:
        xyz = sample_unevenly(room.surfaces, int(SPARE * num), rng, WAVELENGTH)
        batches.append(xyz[_seen_by_any(room, cameras, xyz)])
    return np.asarray(rng.permutation(np.concatenate(batches))[:num])


def _seen_by_any(
    room: Room, cameras: Sequence[Camera], xyz: Float64[np.ndarray, "N 3"]
) -> Bool[np.ndarray, " N"]:
    seen = np.zeros(len(xyz), bool)
    for camera in cameras:
        rest = np.flatnonzero(~seen)
        seen[rest] = visible(room.surfaces, camera, xyz[rest])
    return seen


def _normals_and_colors(
    room: Room, xyz: Float64[np.ndarray, "N 3"]
) -> tuple[Float64[np.ndarray, "N 3"], Float64[np.ndarray, "N 3"]]:
    parts = room.surfaces.parts
    which = np.stack([part.distance(xyz) for part in parts]).argmin(axis=0)
    normals, colors = np.empty_like(xyz), np.empty_like(xyz)
    for i, (part, texture) in enumerate(zip(parts, room.textures, strict=True)):
        mine = which == i
        normals[mine], colors[mine] = part.normals(xyz[mine]), texture(xyz[mine])
    return normals, colors


def _gaussians(
    xyz: Float64[np.ndarray, "N 3"],
    normals: Float64[np.ndarray, "N 3"],
    colors: Float64[np.ndarray, "N 3"],
    rng: np.random.Generator,
) -> Gaussians:
    """Flat ellipsoids along the surface, as large as the gaps between them."""
    num = len(xyz)
    sizes = SIZE * neighbor_distances(xyz)[:, None] * np.array([1.0, 1.0, THICKNESS])
    logits = rng.normal(scale=OPACITY_SPREAD, size=num)
    arrays = {
        "means": xyz,
        "scales": np.log(sizes) + rng.normal(scale=SIZE_SPREAD, size=(num, 3)),
        "quats": _quaternions(normals, rng),
        "opacities": np.maximum(logits, np.log(FAINTEST / (1 - FAINTEST))),
        "sh0": ((colors - 0.5) / SH_C0)[:, None],
        "shN": rng.normal(scale=HARMONICS, size=(num, 15, 3)),
    }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _quaternions(
    normals: Float64[np.ndarray, "N 3"], rng: np.random.Generator
) -> Float64[np.ndarray, "N 4"]:
    """Rotations that turn z to the normal and x anywhere across it, wxyz."""
    across = np.cross(normals, rng.normal(size=normals.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    axes = np.stack([across, np.cross(normals, across), normals], axis=2)
    return np.asarray(Rotation.from_matrix(axes).as_quat(scalar_first=True))


def useful_pairs(
    means2d: Float32[np.ndarray, "N 2"],
    conics: Float32[np.ndarray, "N 3"],
    opacities: Float32[np.ndarray, " N"],
    depths: Float32[np.ndarray, " N"],
    visible: Bool[np.ndarray, " N"],
    width: int,
    height: int,
) -> int:
    """How many useful pairs one view of projected Gaussians has, counted pixel by pixel.

    Args:
        means2d: Centres in px.
        conics: Inverse covariances (a, b, c).
        opacities: 0 to 1.
        depths: By which they are blended.
        visible: Which are drawn.
        width: Pixels.
        height: Pixels.
    """
    order = depth_order(depths, visible & (opacities >= MIN_ALPHA))
    shapes = [np.ascontiguousarray(each[order]) for each in (means2d, conics, opacities)]
    records = np.empty(RECORD * len(order), np.float32)
    gather(order, means2d, conics, np.log(shapes[2]), means2d, 0, records)
    lists = list_tiles(records, width, height)
    counts = np.zeros(len(lists.tile_start) - 1, np.int64)
    _count(*shapes, lists.tile_start, lists.listed_rank, width, height, counts)  # type: ignore[call-arg]  # star arguments
    return int(counts.sum())


@kernel
def _count(
    means2d: np.ndarray,
    conics: np.ndarray,
    opacities: np.ndarray,
    tile_start: np.ndarray,
    listed_rank: np.ndarray,
    width: int,
    height: int,
    counts: np.ndarray,
) -> None:
    """Blend every pixel's list in turn, and count what adds to it."""
    columns = (width + TILE - 1) // TILE
    for tile in parallel_range(len(tile_start) - 1):
        row, column = tile // columns, tile % columns
        for y in range(TILE * row, min(TILE * (row + 1), height)):
            for x in range(TILE * column, min(TILE * (column + 1), width)):
                passing = np.float32(1.0)
                for entry in range(tile_start[tile], tile_start[tile + 1]):
                    g = listed_rank[entry]
                    dx = means2d[g, 0] - np.float32(x + 0.5)
                    dy = means2d[g, 1] - np.float32(y + 0.5)
                    a, b, c = conics[g, 0], conics[g, 1], conics[g, 2]
                    sigma = np.float32(0.5) * (a * dx * dx + c * dy * dy) + b * dx * dy
                    alpha = min(opacities[g] * np.exp(-sigma), MAX_ALPHA)
                    if sigma < 0 or alpha < MIN_ALPHA:
                        continue
                    passing *= np.float32(1.0) - alpha
                    if passing <= STOP:
                        break
                    counts[tile] += 1
