"""Far Gaussians in packed formats: they must not take precision from all others.

Packed positions are steps between bounds, so one Gaussian at 1e6 units would leave the others a few
steps. Notation: *distance* is from the median position, by the largest of the three axes, and
*reach* its median, so that up to half of the Gaussians may be anywhere; *shell* 0 ends at 8 reaches
and each further one is 64 times as large. Formats with chunks give each shell its own; formats
with one step for all leave out far Gaussians where holding them would cost more of the picture.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from splatseed.splat.gaussians import Gaussians
from splatseed.text import agreeing, counted

NEAR, RATIO = 8.0, 64.0
"""Where shell 0 ends, in reaches, and how much larger each further shell is."""
NEGLIGIBLE = 1e-3
"""Cost that nobody sees: as of rounding positions by 3% of a Gaussian's size."""
COUNTED = 0.1
"""Share of the cost of a lost Gaussian that does not depend on how large it appears."""
MAX_BLUR = 0.5
"""Cost of a Gaussian in the wrong place, of one that is lost."""
COARSE = 0.1
"""Median error of rounding, relative to a Gaussian's size, beyond which the user should know."""
_MORTON_BITS = 21  # of each axis, 63 in all


def distances_of(means: Float32[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, " N"], float]:
    """The distance of each position, and the reach, which is positive."""
    xyz = means.astype(np.float64)
    distances = np.abs(xyz - np.median(xyz, axis=0)).max(axis=1)
    reach = float(np.median(distances))
    if reach == 0:  # most are in one place
        apart = distances[distances > 0]
        reach = float(np.median(apart)) if len(apart) else 1.0
    return distances, reach


def shells_of(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """The shell of each position."""
    distances, reach = distances_of(means)
    beyond = np.maximum(distances / (NEAR * reach), 1.0)
    shells = np.ceil(np.log(beyond) / np.log(RATIO))
    return np.asarray(shells, np.int64)


def morton_codes(means: Float32[np.ndarray, "N 3"]) -> np.ndarray:
    """Places on a Z curve whose cells grow with the distance, so that no far one makes them large.

    Along each axis sign(x) log(1 + |x|), x in reaches from the median, is divided evenly.
    """
    xyz = means.astype(np.float64)
    offsets = (xyz - np.median(xyz, axis=0)) / distances_of(means)[1]
    curved = np.sign(offsets) * np.log1p(np.abs(offsets))
    low, high = curved.min(axis=0), curved.max(axis=0)
    extent = np.where(high > low, high - low, 1)
    cells = ((curved - low) / extent * (2**_MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(xyz), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            digit = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= digit << np.uint64(3 * bit + axis)
    return code


def morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """The order of positions along the Z curve."""
    return np.argsort(morton_codes(means), kind="stable")


class Fit(NamedTuple):
    """A way to hold positions: which it keeps, and the size of a step at each, or at all."""

    kept: Bool[np.ndarray, " N"]
    step: Float64[np.ndarray, " N"] | float


def best_fit(gaussians: Gaussians, fits: Sequence[Fit]) -> tuple[int, float, float]:
    """The fit that costs the least: its index, the share lost, and the median error by rounding.

    Of fits whose cost is negligible the first is taken. A Gaussian counts by its opacity times the
    solid angle in which it appears from the middle, and a little for its own sake. Left out, it is
    lost; moved by rounding, it is blurred by the square of the error relative to its size, but by
    less than if it were lost. The median error is relative to the size, too.
    """
    distances, reach = distances_of(gaussians.means)
    sizes = np.exp(np.median(gaussians.scales, axis=1).astype(np.float64))
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-gaussians.opacities.astype(np.float64)))
    seen = opacity * np.minimum(sizes / np.maximum(distances, reach), 1) ** 2
    even = np.full(len(seen), 1 / len(seen))
    seen = seen / seen.sum() if seen.any() else even
    weights = (1 - COUNTED) * seen + COUNTED * even
    costs = []
    for i, (kept, step) in enumerate(fits):
        error = step / np.sqrt(12) / sizes  # of values that are rounded to steps
        blurred = float((weights * np.minimum(error**2, MAX_BLUR))[kept].sum())
        lost = float(weights[~kept].sum())
        costs.append((lost + blurred, i, lost))
        if lost + blurred <= NEGLIGIBLE:
            break
    _, best, lost = min(costs)
    kept, step = fits[best]
    errors = (step / np.sqrt(12) / sizes)[kept]
    return best, lost, float(np.median(errors)) if len(errors) else np.inf


def left_out_note(suffix: str, kept: Bool[np.ndarray, " N"], where: str) -> str:
    """The note on far Gaussians that a file of this suffix lacks."""
    number = int(np.count_nonzero(~kept))
    far = f"{counted(number, 'Gaussian')} of {len(kept):,} {agreeing(number, 'is', 'are')} {where}"
    return (
        f"{far} and {agreeing(number, 'was', 'were')} left out: in a {suffix} "
        f"{agreeing(number, 'it', 'they')} would have made the positions of all others coarse."
    )
