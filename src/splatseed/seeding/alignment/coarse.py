"""Coarse alignment: every orientation, at several scales and shifts, by a grid of distances.

Notation: both clouds are first brought to extent 1 around 0 (``Unit``). A start takes a *mark* (a
point of the scene) to the cloud's frame: x -> s R x + t. Its cost is the mean distance from a mark
to the cloud, at most ``FAR``, in units of the scene's extent: divided by s, since otherwise
shrinking all marks to one point of the cloud would be best.
Promise: the same points give the same starts; nothing is random.

Orientations are Alexa's super-Fibonacci spirals on unit quaternions ("Super-Fibonacci Spirals:
Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.kernels.jit import kernel, parallel_range
from splatseed.similarity import Similarity

__all__ = ["Unit", "find_starts", "spread_rotations"]

ROTATIONS = 4000
"""About 12 degrees from any orientation to the nearest."""
SCALES = (0.65, 0.8, 1.0, 1.25, 1.55)
SHIFTS = (-0.15, 0.0, 0.15)
"""Along each axis, in units of the extent."""
MARKS = 256
CELLS, HALF = 96, 1.2
"""Cells of the grid along each axis, and half its side."""
FAR = 0.15


@dataclass(frozen=True, eq=False)
class Unit:
    """A cloud's place and size, robustly.

    Args:
        center: float64 [3].
        extent: Greatest extent along an axis.
    """

    center: Float64[np.ndarray, " 3"]
    extent: float

    @classmethod
    def of(cls, xyz: Float64[np.ndarray, "N 3"]) -> Unit:
        """That of some points; the size does not change when they are turned."""
        center = np.median(xyz, axis=0)
        distance = np.linalg.norm(xyz - center, axis=1)
        return cls(center, float(np.sqrt(np.mean(np.sort(distance)[: int(0.95 * len(xyz))] ** 2))))

    @property
    def similarity(self) -> Similarity:
        """From the cloud's own frame to unit size around 0."""
        return Similarity(1 / self.extent, np.eye(3), -self.center / self.extent)


class Starts(NamedTuple):
    """Starts, best first."""

    rotation: Float64[np.ndarray, "n 3 3"]
    scale: Float64[np.ndarray, " n"]
    shift: Float64[np.ndarray, "n 3"]
    cost: Float64[np.ndarray, " n"]


def find_starts(
    cloud: Float64[np.ndarray, "N 3"], marks: Float64[np.ndarray, "M 3"], num: int
) -> Starts:
    """The best starts of different orientations.

    Args:
        cloud: Its points, at unit size.
        marks: The scene's points, at unit size.
        num: How many starts.
    """
    some = marks[:: -(-len(marks) // MARKS)]
    rotations = spread_rotations(ROTATIONS)
    shifts = np.stack(np.meshgrid(SHIFTS, SHIFTS, SHIFTS, indexing="ij"), axis=-1).reshape(-1, 3)
    costs = np.empty((len(rotations), len(SCALES), len(shifts)))
    _score(some, rotations, np.array(SCALES), shifts, _distances(cloud), HALF, FAR, costs)
    flat = costs.reshape(len(rotations), -1)
    best = flat.argmin(axis=1)
    cost = flat[np.arange(len(flat)), best]
    order: Int64[np.ndarray, " n"] = np.argsort(cost, kind="stable")[:num]
    scale, shift = np.unravel_index(best[order], costs.shape[1:])
    return Starts(rotations[order], np.array(SCALES)[scale], shifts[shift], cost[order])


def spread_rotations(num: int) -> Float64[np.ndarray, "n 3 3"]:
    """Rotations spread evenly over all orientations."""
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


def _distances(cloud: Float64[np.ndarray, "N 3"]) -> np.ndarray:
    """Distances to the cloud at the centres of the grid's cells, float32."""
    from scipy.ndimage import distance_transform_edt  # noqa: PLC0415  (slow to import)

    side = 2 * HALF / CELLS
    place = np.floor((cloud + HALF) / side).astype(np.int64)
    place = place[((place >= 0) & (place < CELLS)).all(axis=1)]
    empty = np.ones((CELLS,) * 3, np.bool_)
    empty[tuple(place.T)] = False
    return np.asarray(distance_transform_edt(empty) * side, np.float32)


@kernel
def _score(marks, rotations, scales, shifts, grid, half, far, costs):  # type: ignore[no-untyped-def]  # Numba's types
    """The cost of every start."""
    per_side = len(grid) / (2.0 * half)
    for r in parallel_range(len(rotations)):
        turned = np.empty((len(marks), 3))
        for m in range(len(marks)):
            for axis in range(3):
                turned[m, axis] = 0.0
                for k in range(3):
                    turned[m, axis] += rotations[r, axis, k] * marks[m, k]
        for s in range(len(scales)):
            for t in range(len(shifts)):
                total = 0.0
                for m in range(len(marks)):
                    i = int((scales[s] * turned[m, 0] + shifts[t, 0] + half) * per_side)
                    j = int((scales[s] * turned[m, 1] + shifts[t, 1] + half) * per_side)
                    k = int((scales[s] * turned[m, 2] + shifts[t, 2] + half) * per_side)
                    inside = 0 <= min(i, j, k) and max(i, j, k) < len(grid)
                    distance = grid[i, j, k] / scales[s] if inside else far
                    total += min(distance, far)
                costs[r, s, t] = total / len(marks)
