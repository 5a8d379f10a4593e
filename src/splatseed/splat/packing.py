"""Quantise Gaussians for packed formats, and keep positions precise despite distant Gaussians.

Notation: quaternions are wxyz. *Smallest three* stores a unit quaternion as the index of its
largest component, made positive, and the other three, each within 1/sqrt(2) of 0.

Packed positions are quantised between bounds: one Gaussian at 1e6 units would leave a few steps for
all others. *Distance* is the maximum norm from the median position, and *reach* its median, which
up to half of the Gaussians cannot move. *Shell* 0 ends at 8 reaches; each further shell is 64 times
as large. Distant Gaussians are dropped if keeping them would cost more image quality.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.findings import Finding
from splatseed.splat.gaussians import Gaussians
from splatseed.text import agreeing, counted

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The remaining components, by the index of the largest."""


def smallest_three(
    quats: Float32[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N 3"]]:
    """Return the index of each quaternion's largest component, and the other three in order."""
    unit = unit_quats(quats)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1, 1).astype(np.float32)[:, None]
    return largest, unit[rows[:, None], _OTHERS[largest]]


def from_smallest_three(
    largest: Int64[np.ndarray, " N"], three: Float32[np.ndarray, "N 3"]
) -> Float32[np.ndarray, "N 4"]:
    """Decode the unit quaternions of ``smallest_three``."""
    rows = np.arange(len(three))
    quats = np.empty((len(three), 4), np.float32)
    quats[rows[:, None], _OTHERS[largest]] = three
    # A unit quaternion: the fourth square is 1 minus the other three.
    quats[rows, largest] = np.sqrt(np.maximum(1 - (three**2).sum(axis=1), 0))
    return quats


def opacity_bytes(logits: Float32[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Convert logits to opacities in steps of 1/255."""
    with np.errstate(over="ignore"):
        return np.rint(255 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.uint8)


def opacity_logits(values: UInt8[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """Convert opacities in steps of 1/255 to logits; 0 and 1 move inwards by a quarter step."""
    opacity = np.clip(values / 255, 0.25 / 255, 1 - 0.25 / 255)
    return np.log(opacity / (1 - opacity)).astype(np.float32)


def rounded_bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """Round values to bytes, clipped to 0 to 255."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def unit_quats(quats: Float32[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Normalise quaternions; those of length 0 become the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    known = np.isfinite(norms) & (norms > 0)
    unit = np.divide(quats, norms, out=np.zeros_like(quats), where=known)
    unit[~known[:, 0]] = (1, 0, 0, 0)
    return np.asarray(unit)


@dataclass(frozen=True)
class PackingSettings:
    """Constants of the choice of steps and shells."""

    first_shell: float = 8.0  # end of shell 0, in reaches
    shell_ratio: float = 64.0  # end of each further shell, in ends of the one before
    negligible_cost: float = 1e-3  # invisible: rounding positions by 3% of a Gaussian's size
    uniform_share: float = 0.1  # of the cost of a lost Gaussian; the rest follows its solid angle
    max_blur: float = 0.5  # cost of a misplaced Gaussian, relative to a lost one
    visible: float = 1 / 64  # difference of a coefficient: about one of 255 steps of a colour
    coarse_error: float = 0.1  # RMS rounding error of a position, in sizes, that may show
    coarse_share: float = 0.25  # of such Gaussians, that is said: a few far ones do not show
    morton_bits: int = 21  # per axis; 63 in all


PACKING = PackingSettings()


def distances_of(means: Float32[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, " N"], float]:
    """Return the distance of each position, and the reach, which is positive."""
    xyz = means.astype(np.float64)
    distances = np.abs(xyz - np.median(xyz, axis=0)).max(axis=1)
    reach = float(np.median(distances))
    if reach == 0:  # at least half coincide
        positive = distances[distances > 0]
        reach = float(np.median(positive)) if len(positive) else 1.0
    return distances, reach


def shells_of(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the shell of each position."""
    distances, reach = distances_of(means)
    beyond = np.maximum(distances / (PACKING.first_shell * reach), 1.0)
    shells = np.ceil(np.log(beyond) / np.log(PACKING.shell_ratio))
    return np.asarray(shells, np.int64)


def morton_order(means: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """Return the order of positions along a Z curve, in cells that grow with the distance.

    sign(x) log(1 + |x|), with x in reaches from the median, is divided evenly, in the same steps
    along all axes: in a wide and flat model, neighbours along the curve are neighbours in space.
    """
    xyz = means.astype(np.float64)
    offsets = (xyz - np.median(xyz, axis=0)) / distances_of(means)[1]
    curved = np.sign(offsets) * np.log1p(np.abs(offsets))
    low = curved.min(axis=0)
    extent = float((curved.max(axis=0) - low).max()) or 1.0
    cells = ((curved - low) / extent * (2**PACKING.morton_bits - 1)).astype(np.uint64)
    code = np.zeros(len(xyz), np.uint64)
    for bit in range(PACKING.morton_bits):
        for axis in range(3):
            digit = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= digit << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def clipped_findings(
    suffix: str,
    gaussians: Gaussians,
    *,
    sizes: tuple[float, float] | None = None,
    first: tuple[float, float] | None = None,
    further: tuple[float, float] | None = None,
) -> Iterator[Finding]:
    """Yield findings on values that files with this suffix clip, by the ranges that they hold.

    ``sizes`` are log-scales (the thickness of a flat Gaussian does not matter), ``first`` and
    ``further`` coefficients of harmonics.
    """
    if sizes is not None:
        axes = np.sort(gaussians.scales, axis=1)
        beyond = (axes[:, 2] > sizes[1]) | (axes[:, 1] < sizes[0])
        if number := int(np.count_nonzero(beyond)):
            low, high = np.exp(sizes)
            yield Finding(
                "clipped-sizes",
                f"A {suffix} holds sizes from {low:.2g} to {high:.4g} units: "
                f"{counted(number, 'Gaussian')} {agreeing(number, 'was', 'were')} clipped.",
            )
    for what, values, limits in (
        ("colours", gaussians.sh0, first), ("view-dependent colours", gaussians.shN, further)
    ):  # fmt: skip
        if limits is None:
            continue
        lost = np.maximum(values - limits[1], limits[0] - values).reshape(len(values), -1)
        number = int(np.count_nonzero((lost > PACKING.visible).any(axis=1)))
        if number:
            yield Finding(
                "clipped-colors",
                f"A {suffix} holds {what} as harmonics from {limits[0]:.3g} to {limits[1]:.3g}: "
                f"those of {counted(number, 'Gaussian')} of {len(values):,} lie beyond and were "
                f"clipped, by up to {lost.max():.2g}, so that colours fade.",
            )


class Fit(NamedTuple):
    """An encoding of positions: the Gaussians it keeps, and the step at each or at all of them."""

    kept: Bool[np.ndarray, " N"]
    step: Float64[np.ndarray, " N"] | float


def best_fit(gaussians: Gaussians, fits: Sequence[Fit]) -> tuple[int, float, int]:
    """Choose the fit of least cost; return its index, lost share and number of coarse positions.

    The first fit of negligible cost wins. A Gaussian's weight is its opacity times its solid angle
    seen from the median position, plus a small uniform share. A dropped Gaussian costs its weight;
    a rounded one costs its weight times the squared error relative to its size, up to ``max_blur``.
    A position is coarse if its rounding error is more than ``coarse_error`` of the size.
    """
    distances, reach = distances_of(gaussians.means)
    sizes = np.exp(np.median(gaussians.scales, axis=1).astype(np.float64))
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-gaussians.opacities.astype(np.float64)))
    visible = opacity * np.minimum(sizes / np.maximum(distances, reach), 1) ** 2
    even = np.full(len(visible), 1 / len(visible))
    visible = visible / visible.sum() if visible.any() else even
    weights = (1 - PACKING.uniform_share) * visible + PACKING.uniform_share * even
    costs = []
    for i, (kept, step) in enumerate(fits):
        error = step / np.sqrt(12) / sizes  # RMS error of rounding to steps
        blurred = float((weights * np.minimum(error**2, PACKING.max_blur))[kept].sum())
        lost = float(weights[~kept].sum())
        costs.append((lost + blurred, i, lost))
        if lost + blurred <= PACKING.negligible_cost:
            break
    _, best, lost = min(costs)
    kept, step = fits[best]
    errors = (step / np.sqrt(12) / sizes)[kept]
    return best, lost, int(np.count_nonzero(errors > PACKING.coarse_error))


def coarse_findings(
    suffix: str, coarse: int, kept: Bool[np.ndarray, " N"], steps: str = ""
) -> list[Finding]:
    """Report positions that are rounded coarsely, if they are more than a few."""
    number = int(np.count_nonzero(kept))
    if coarse <= PACKING.coarse_share * number:
        return []
    text = f"A {suffix} holds positions {steps}too coarsely for this model: those of "
    text += f"{counted(coarse, 'Gaussian')} of {number:,} are rounded by more than a tenth of "
    text += "their size."
    fix = "Export another format, or move the model to the origin."
    return [Finding("coarse-positions", text, fix=fix)]


def left_out_finding(suffix: str, kept: Bool[np.ndarray, " N"], where: str) -> Finding:
    """Return the finding on distant Gaussians left out of a file with this suffix."""
    number = int(np.count_nonzero(~kept))
    distant = (
        f"{counted(number, 'Gaussian')} of {len(kept):,} {agreeing(number, 'is', 'are')} {where}"
    )
    return Finding(
        "distant-gaussians",
        f"{distant} and {agreeing(number, 'was', 'were')} left out: in a {suffix} "
        f"{agreeing(number, 'it', 'they')} would reduce the precision of all other positions.",
    )
