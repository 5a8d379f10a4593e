"""Coarse alignment: every orientation and shift, at several scales, by correlation on a grid.

Notation: both clouds are first brought to root mean square size 1 around 0. A start
takes a *mark* (a point of the scene) to the cloud's frame: x -> s R x + t. Its *reward* is the mean
over the marks of max(``FAR`` - d / s, 0), with d the distance to the cloud: in the scene's units,
as otherwise shrinking all marks to one point of the cloud would be best. For each rotation and
scale the rewards of all shifts are one correlation of the marks' histogram with the grid of
max(``FAR`` - d / s, 0), computed by Fourier transforms.
Then the orientations around the best ones are tried: halfway between two of the first is too far
from either for ICP in a sparse cloud.
Promise: the same points give the same starts; nothing is random.

Orientations are Alexa's super-Fibonacci spirals on unit quaternions ("Super-Fibonacci Spirals:
Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022).
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64
from scipy.fft import irfftn, rfftn
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from splatseed.progress import Progress, silent
from splatseed.similarity import Similarity

ROTATIONS = 1200
"""About 18 degrees from any orientation to the nearest."""
BEST, AROUND = 12, (-9.0, 0.0, 9.0)
"""Of how many orientations those around are tried, and by how many degrees about each axis."""
SCALES = (0.7, 0.84, 1.0, 1.19, 1.42)
EVEN = 0.1
"""Side of the cells of which each counts once, however many marks it holds."""
CELLS, HALF = 36, 2.7
"""Cells of the grid along each axis, and half its side."""
FAR = 0.3
INNER = 0.95


def to_unit_size(xyz: Float64[np.ndarray, "N 3"]) -> Similarity:
    """From a cloud's own frame to unit size around 0; the farthest twentieth does not count."""
    center = np.median(xyz, axis=0)
    for _ in range(3):
        distance = np.linalg.norm(xyz - center, axis=1)
        inner = xyz[distance <= np.quantile(distance, INNER)]
        center = inner.mean(axis=0)
    extent = float(np.sqrt(np.mean(np.sum((inner - center) ** 2, axis=1))))
    return Similarity(1 / extent, np.eye(3), -center / extent)


class Starts(NamedTuple):
    """Starts, best first."""

    rotation: Float64[np.ndarray, "n 3 3"]
    scale: Float64[np.ndarray, " n"]
    shift: Float64[np.ndarray, "n 3"]
    reward: Float64[np.ndarray, " n"]

    def best(self, num: int) -> Starts:
        """The ``num`` best, best first."""
        order: Int64[np.ndarray, " n"] = np.argsort(-self.reward, kind="stable")[:num]
        return Starts(*(values[order] for values in self))


def find_starts(
    cloud: Float64[np.ndarray, "N 3"],
    marks: Float64[np.ndarray, "M 3"],
    num: int,
    progress: Progress = silent,
) -> Starts:
    """The ``num`` best starts, one for each orientation, of points at unit size."""
    distances, some = _distances(cloud), even(marks, EVEN)
    fields = [rfftn(np.maximum(FAR - distances / scale, 0).astype(np.float32)) for scale in SCALES]
    spread = spread_rotations(ROTATIONS)
    first = _correlate(fields, some, spread, "try orientations", progress)
    around = _around(first.best(BEST).rotation)
    second = _correlate(fields, some, around, "try those around the best", progress)
    return Starts(*(np.concatenate(pair) for pair in zip(first, second, strict=True))).best(num)


def _correlate(
    fields: list[np.ndarray],
    marks: Float64[np.ndarray, "M 3"],
    rotations: Float64[np.ndarray, "n 3 3"],
    stage: str,
    progress: Progress,
) -> Starts:
    """Each rotation with its best scale and shift."""
    shape, side = (CELLS,) * 3, 2 * HALF / CELLS
    reward = np.full(len(rotations), -np.inf)
    scale, shift = np.empty(len(rotations)), np.empty((len(rotations), 3))
    for r, rotation in enumerate(rotations):
        turned = marks @ rotation.T
        for s, field in zip(SCALES, fields, strict=True):
            cells = np.floor(s * turned / side).astype(np.int64) % CELLS
            flat = np.ravel_multi_index(tuple(cells.T), shape)
            counts = np.bincount(flat, minlength=CELLS**3).reshape(shape).astype(np.float32)
            rewards = irfftn(field * np.conj(rfftn(counts)), shape)
            if rewards.max() > reward[r]:
                best = np.array(np.unravel_index(int(rewards.argmax()), shape))
                reward[r], scale[r] = rewards.max(), s
                shift[r] = (best + 0.5) * side - HALF
        if r % 50 == 0:
            progress(stage, r / len(rotations))
    progress(stage, 1.0)
    return Starts(rotations, scale, shift, reward / len(marks))


def _around(rotations: Float64[np.ndarray, "n 3 3"]) -> Float64[np.ndarray, "m 3 3"]:
    """Rotations a little off each of these, about all axes."""
    turns = [turn for turn in product(AROUND, repeat=3) if any(turn)]
    small = Rotation.from_rotvec(np.radians(turns)).as_matrix()
    return np.asarray(rotations[:, None] @ small).reshape(-1, 3, 3)


def even(xyz: Float64[np.ndarray, "N 3"], side: float) -> Float64[np.ndarray, "M 3"]:
    """The first point in each cell of this side."""
    cells = np.floor(xyz / side).astype(np.int64)
    first = np.unique(cells, axis=0, return_index=True)[1]
    return xyz[np.sort(first)]


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
    side = 2 * HALF / CELLS
    place = np.floor((cloud + HALF) / side).astype(np.int64)
    place = place[((place >= 0) & (place < CELLS)).all(axis=1)]
    empty = np.ones((CELLS,) * 3, np.bool_)
    empty[tuple(place.T)] = False
    return np.asarray(distance_transform_edt(empty) * side, np.float32)
