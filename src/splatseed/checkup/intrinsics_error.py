"""What is wrong with focal lengths and lens distortion, by where photographs show the points.

A point that view i sees at p, and j at q, is found again in j at q + m (``Matches``). Let a
camera's focal length be 1 + s times what its record states, and its lens distort by k more, k the
coefficient of r^2. Then the place of a point is ``e(p) = (s + k r^2) (p - c)`` farther from the
principal point c than its record puts it, r the distance from c in focal lengths. With J the
Jacobian at p of the plane's map from i to j, ``m = e(q) - J e(p)``, linear in s and k of both
cameras. Points may be off along their rays, too: the motion of q as all depths change by one factor
is a further unknown. All are fitted robustly over all pairs, without a search; a small motion
counts where it is systematic.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera
from splatseed.checkup.consistency import Evidence, Fit, Hypothesis, Matches
from splatseed.depth._kernels import SIGMA_OF_MEDIAN
from splatseed.projection import normalized

Places = Float64[np.ndarray, "M 2"]

_STEP = 1e-3
"""Of the finite differences, as a fraction of the motion or depth."""
_TUKEY, _MAX_STEPS, _MIN_SIGMA = 4.685, 20, 0.05
"""Of the reweighting: standard deviations, steps, and pixels below which errors count alike."""


@dataclass(frozen=True, eq=False)
class IntrinsicsError:
    """What the records of C groups of cameras are off by."""

    focal: Float64[np.ndarray, " C"]  # s: the factor of the focal length is 1 + s
    radial: Float64[np.ndarray, " C"]  # k
    focal_sigma: Float64[np.ndarray, " C"]  # standard deviations; infinite without data
    radial_sigma: Float64[np.ndarray, " C"]
    miss: float  # median |m| where distortion matters most, in pixels; NaN without matches


def estimate_intrinsics_error(
    evidence: Evidence, fit: Fit, hypothesis: Hypothesis, groups: Sequence[int]
) -> IntrinsicsError:
    """Fit what the records are off by to the places at which points of a fit are found.

    Args:
        evidence: Of the capture.
        fit: How points fit it under ``hypothesis``.
        hypothesis: Poses, points and factors of focal lengths, which the result comes on top of.
        groups: For each view of the evidence the group of its camera, from 0.
    """
    count = max(groups) + 1
    rows, shifts, reach = list[np.ndarray](), list[np.ndarray](), list[np.ndarray]()
    for pair in fit.pairs:
        if not len(pair.matches.uv):
            continue
        cameras = evidence.cameras(pair.first, pair.second, hypothesis)
        columns, m = _motions(cameras, pair.matches)
        row = np.zeros((*m.shape, 2 * count + 1))
        for side, view in enumerate((pair.first, pair.second)):
            for term in (0, 1):
                row[..., term * count + groups[view]] += columns[side][term]
        row[..., -1] = columns[2][0]
        rows.append(row.reshape(-1, row.shape[-1]))
        shifts.append(m)
        reach.append(np.linalg.norm(columns[0][1] + columns[1][1], axis=1))
    if not rows:
        nothing, unknown = np.zeros(count), np.full(count, np.inf)
        return IntrinsicsError(nothing, nothing, unknown, unknown, np.nan)
    m = np.concatenate(shifts)
    solution, sigma = _robust(np.concatenate(rows), m.reshape(-1))
    far = np.concatenate(reach)
    outer = far >= np.percentile(far, 75)
    miss = float(np.median(np.linalg.norm(m[outer], axis=1)))
    of_focal, of_radial = slice(count), slice(count, 2 * count)
    return IntrinsicsError(
        solution[of_focal], solution[of_radial], sigma[of_focal], sigma[of_radial], miss
    )


def _motions(cameras: tuple[Camera, Camera], matches: Matches) -> tuple[list[list[Places]], Places]:
    """Return the motions of q, and m.

    They are per unit of s and k of the first camera, of those of the second, and of log depth.
    """
    first, second = cameras
    carry = _carrier(first, second)
    p, z = matches.uv, matches.depth
    q = carry(p, z)
    of_first = [(q - carry(p + _STEP * each, z)) / _STEP for each in _terms(first, p)]
    motions = [of_first, _terms(second, q), [(carry(p, z * (1 + _STEP)) - q) / _STEP]]
    return motions, carry(p + matches.shift, z) - q


def _terms(camera: Camera, p: Places) -> list[Places]:
    """Return p - c and r^2 (p - c)."""
    from_centre = p - camera.K[:2, 2]
    return [from_centre, (normalized(camera.K, p) ** 2).sum(axis=1)[:, None] * from_centre]


def _carrier(
    first: Camera, second: Camera
) -> Callable[[Places, Float64[np.ndarray, " M"]], Places]:
    """The map of pixels of one camera at planar depths to pixels of another."""
    relative = second.cam_from_world @ first.world_from_cam
    turned = second.K @ relative[:3, :3] @ np.linalg.inv(first.K)
    moved = second.K @ relative[:3, 3]

    def carry(p: Places, z: Float64[np.ndarray, " M"]) -> Places:
        places = z[:, None] * (np.column_stack([p, np.ones(len(p))]) @ turned.T) + moved
        return np.asarray(places[:, :2] / places[:, 2:])

    return carry


def _robust(
    rows: Float64[np.ndarray, "N P"], values: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, " P"], Float64[np.ndarray, " P"]]:
    """Solve rows x = values by least squares with Tukey's biweight; return x and its deviation.

    Unknowns without data are 0, with infinite deviation.
    """
    size = np.linalg.norm(rows, axis=0)
    known = size > 1e-9 * size.max()
    rows, size = rows[:, known] / size[known], size[known]
    weight = np.ones(len(values))
    for _ in range(_MAX_STEPS):
        root = np.sqrt(weight)
        x = np.linalg.lstsq(rows * root[:, None], values * root, rcond=None)[0]
        error = values - rows @ x
        sigma = max(SIGMA_OF_MEDIAN * float(np.median(np.abs(error))), _MIN_SIGMA)
        weight = (1 - np.minimum(np.abs(error) / (_TUKEY * sigma), 1) ** 2) ** 2
    covariance = np.linalg.pinv((rows * weight[:, None]).T @ rows) * sigma**2
    solution, deviation = np.zeros(len(known)), np.full(len(known), np.inf)
    solution[known], deviation[known] = x / size, np.sqrt(np.diag(covariance)) / size
    return solution, deviation
