"""Global search: rough alignments of tie points with a cloud, over all orientations and shifts.

Both clouds are at root mean square size 1 around 0. A *start* takes a tie point to the cloud's
frame: x -> s R x + t. Its *score* is the mean over the tie points of max(``max_distance`` - d / s,
0), with d the distance to the cloud. Dividing by s measures it in the scene's units; otherwise
shrinking all tie points to one place would score best. For each rotation and scale, the scores of
all shifts are one correlation of the tie points' histogram with a grid of these values, by Fourier
transforms. Orientations are Alexa's super-Fibonacci spirals on unit quaternions ("Super-Fibonacci
Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022); those around the best are tried next.
Nothing is random.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float64
from scipy.fft import irfftn, rfftn
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from splatseed.progress import Progress, silent
from splatseed.seeding.clouds.tie_points import Points
from splatseed.similarity import Similarity

CORE = 0.95  # fraction of a cloud, nearest to its center, that determines its size


@dataclass(frozen=True)
class SearchSettings:
    """What the global search tries; lengths are in extents of the scene."""

    rotations: int = 1200
    """Orientations; any other is about 18 degrees from the nearest of them."""
    refined: int = 12
    """How many of the best orientations the search refines."""
    offsets: tuple[float, ...] = (-9.0, 0.0, 9.0)
    """Degrees about each axis by which it refines them."""
    scales: tuple[float, ...] = (0.7, 0.84, 1.0, 1.19, 1.42)
    tie_point_cell: float = 0.1
    """Side of cells of which each counts once, whatever the number of its tie points."""
    grid_size: int = 36
    """Cells of the grid along each axis."""
    grid_half_width: float = 2.7
    max_distance: float = 0.3
    """Distance from the cloud at which a tie point's score becomes zero."""

    @property
    def cell_side(self) -> float:
        """Side of a cell of the grid."""
        return 2 * self.grid_half_width / self.grid_size


SEARCH = SearchSettings()


def to_unit_size(xyz: Points) -> Similarity:
    """Return the map that brings a cloud's core to center 0 and root mean square size 1."""
    center = np.median(xyz, axis=0)
    for _ in range(3):
        distance = np.linalg.norm(xyz - center, axis=1)
        core = xyz[distance <= np.quantile(distance, CORE)]
        center = core.mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum((core - center) ** 2, axis=1))))
    return Similarity(1 / extent, np.eye(3), -center / extent)


def find_starts(
    cloud: Points,
    tie_xyz: Points,
    num: int,
    progress: Progress = silent,
    settings: SearchSettings = SEARCH,
) -> list[Similarity]:
    """Return the ``num`` best starts, one per orientation, of points at unit size."""
    size, side = settings.grid_size, settings.cell_side
    cell = np.floor((cloud + settings.grid_half_width) / side).astype(np.int64)
    empty = np.ones((size,) * 3, np.bool_)
    empty[tuple(cell[((cell >= 0) & (cell < size)).all(axis=1)].T)] = False
    distances = np.asarray(distance_transform_edt(empty) * side, np.float32)
    fields = [
        rfftn(np.maximum(settings.max_distance - distances / scale, 0).astype(np.float32))
        for scale in settings.scales
    ]
    tie_cell = np.floor(tie_xyz / settings.tie_point_cell).astype(np.int64)
    first = np.unique(tie_cell, axis=0, return_index=True)[1]
    sample = tie_xyz[np.sort(first)]
    coarse = spread_rotations(settings.rotations)
    starts = _correlate(fields, sample, coarse, settings, "try orientations", progress)
    turns = [turn for turn in product(settings.offsets, repeat=3) if any(turn)]
    small = Rotation.from_rotvec(np.radians(turns)).as_matrix()
    best = np.array([start.rotation for _, start in _best_first(starts)[: settings.refined]])
    fine = np.asarray(best[:, None] @ small).reshape(-1, 3, 3)
    starts += _correlate(fields, sample, fine, settings, "refine orientations", progress)
    return [start for _, start in _best_first(starts)[:num]]


def _best_first(starts: list[tuple[float, Similarity]]) -> list[tuple[float, Similarity]]:
    return sorted(starts, key=lambda scored: -scored[0])


def _correlate(
    fields: list[np.ndarray],
    tie_xyz: Points,
    rotations: Float64[np.ndarray, "n 3 3"],
    settings: SearchSettings,
    stage: str,
    progress: Progress,
) -> list[tuple[float, Similarity]]:
    """Return the score of each rotation with its best scale and shift."""
    size, side = settings.grid_size, settings.cell_side
    shape = (size,) * 3
    starts = []
    for r, rotation in enumerate(rotations):
        rotated, score = tie_xyz @ rotation.T, -np.inf
        for s, field in zip(settings.scales, fields, strict=True):
            cells = np.floor(s * rotated / side).astype(np.int64) % size
            flat = np.ravel_multi_index(tuple(cells.T), shape)
            counts = np.bincount(flat, minlength=size**3).reshape(shape).astype(np.float32)
            scores = irfftn(field * np.conj(rfftn(counts)), shape)
            if scores.max() > score:
                best = np.array(np.unravel_index(int(scores.argmax()), shape))
                score, scale = float(scores.max()), s
                shift = (best + 0.5) * side - settings.grid_half_width
        starts.append((score, Similarity(scale, rotation, shift)))
        progress(stage, (r + 1) / len(rotations))
    return starts


def spread_rotations(num: int) -> Float64[np.ndarray, "n 3 3"]:
    """Return rotations that are spread evenly over all orientations."""
    s = np.arange(num) + 0.5
    small, large = np.sqrt(s / num), np.sqrt(1 - s / num)
    alpha, beta = 2 * np.pi * s / np.sqrt(2.0), 2 * np.pi * s / 1.533751168755204288118041
    x, y = small * np.sin(alpha), small * np.cos(alpha)
    z, w = large * np.sin(beta), large * np.cos(beta)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0).copy()
