"""The accuracy of a cloud: distances to known surfaces, or else from new points to originals.

Notation: h is a cloud's spacing: the mean over its points of the mean distance to the 6 nearest
others. All scores are in units of h of the *originals*, so that scenes of any size compare.
Promise: exact duplicates and non-finite points do not count as neighbours; nothing is random unless
a ``rng`` is passed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError

NEIGHBORS = 6
"""Neighbours whose mean distance is the spacing: those of a point in a hexagonal pattern."""

FAR_SPACINGS = 3.0
"""A new point is far from the originals beyond this many spacings of the nearest one."""

Distance = Callable[[np.ndarray], np.ndarray]


class _Measurable(Protocol):
    def distance(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]: ...


@dataclass(frozen=True)
class GeometryScore:
    """Geometric quality of upsampled points, in units of the originals' spacing h.

    Args:
        error: Mean distance from a new point to the surface; NaN without new points. A few
            mismatched originals can make up most of it.
        median: Median of the same.
        p95: 95th percentile of the same.
        coverage: Mean distance from a surface sample to the nearest of all points.
        share_far: Share of new points far from every original (see ``far_share``).
    """

    error: float
    median: float
    p95: float
    coverage: float
    share_far: float


def measure(
    new_xyz: Float[np.ndarray, "M 3"],
    all_xyz: Float[np.ndarray, "N 3"],
    surfaces: _Measurable | Distance,
    surface_samples: Float[np.ndarray, "S 3"],
    h: float,
) -> GeometryScore:
    """Compare points with known surfaces.

    To score only the originals, pass them as both ``new_xyz`` and ``all_xyz``.

    Args:
        new_xyz: The new points, world, [M, 3].
        all_xyz: The whole cloud, [N, 3]: originals first, the new points last.
        surfaces: The ground truth: anything with ``distance(xyz)``, or such a function itself.
        surface_samples: Points spread evenly on the surfaces, [S, 3].
        h: The unit of the result, usually ``spacing(originals)``.

    Raises:
        PointCloudError: There are no points, or ``h`` is not positive.
    """
    if len(all_xyz) == 0 or not h > 0:
        raise PointCloudError(
            "at least one point and a spacing above zero to measure with",
            found=f"{len(all_xyz)} points and a spacing of {h}",
            fix="Pass the whole cloud and spacing(originals).",
        )
    distance = surfaces if callable(surfaces) else surfaces.distance
    errors = distance(new_xyz) / h if len(new_xyz) else np.array([np.nan])
    coverage = cKDTree(all_xyz).query(surface_samples)[0].mean() / h
    originals = all_xyz[: len(all_xyz) - len(new_xyz)]
    share = far_share(originals, new_xyz) if len(originals) and len(new_xyz) else 0.0
    median, p95 = (float(value) for value in np.percentile(errors, [50, 95]))
    return GeometryScore(float(errors.mean()), median, p95, float(coverage), share)


def spacing(xyz: Float[np.ndarray, "N 3"]) -> float:
    """h: the mean over the points of their local spacing, in scene units.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    finite = _finite(xyz)
    h = float(local_spacing(finite).mean()) if len(finite) else 0.0
    if not h > 0:
        raise PointCloudError(
            "at least two distinct finite points to take a spacing of",
            found=f"{len(xyz)} points, {len(finite)} of them finite",
            fix="Check that the cloud was read correctly.",
        )
    return h


def local_spacing(
    xyz: Float[np.ndarray, "N 3"],
    at: Float[np.ndarray, "M 3"] | None = None,
    tree: cKDTree | None = None,
) -> Float64[np.ndarray, " M"]:
    """Mean distance to the 6 nearest others, in scene units, [M]; 0 if there are no others.

    Args:
        xyz: The cloud, finite, [N, 3].
        at: The points of the cloud to evaluate, [M, 3]; all when left out.
        tree: A tree of the cloud, if one exists already.
    """
    tree = cKDTree(xyz) if tree is None else tree
    distances, _ = tree.query(xyz if at is None else at, k=NEIGHBORS + 1)
    # The point itself and exact duplicates have distance 0, missing neighbours inf.
    counts = (distances > 0) & np.isfinite(distances)
    total = np.where(counts, distances, 0.0).sum(axis=1)
    return np.asarray(total / np.maximum(counts.sum(axis=1), 1))


def far_share(
    originals_xyz: Float[np.ndarray, "N 3"],
    new_xyz: Float[np.ndarray, "M 3"],
    max_sample: int = 50_000,
    rng: np.random.Generator | None = None,
) -> float:
    """Share 0..1 of new points farther than 3 h from any original, h local to the nearest one.

    Args:
        originals_xyz: The originals, [N, 3].
        new_xyz: The new points, [M, 3]; a non-finite one counts as far.
        max_sample: If there are more new points, a sample of this size is judged.
        rng: Draws the sample; evenly spaced points are taken when left out.

    Raises:
        PointCloudError: There are new points but no finite original.
    """
    if len(new_xyz) == 0:
        return 0.0
    originals = _finite(originals_xyz)
    if len(originals) == 0:
        raise PointCloudError(
            "finite original points to compare the new ones with",
            found=f"none among {len(originals_xyz)}",
            fix="Check that the cloud was read correctly.",
        )
    sample = _sample(new_xyz, max_sample, rng)
    finite = _finite(sample)
    # An unbalanced tree is built several times faster, and only few queries follow.
    tree = cKDTree(originals, balanced_tree=False, compact_nodes=False)
    to_original, nearest = tree.query(finite)
    h = local_spacing(originals, originals[nearest], tree)
    near = np.count_nonzero(to_original <= FAR_SPACINGS * h)
    return float(1.0 - near / len(sample))


def _finite(xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "K 3"]:
    return np.asarray(xyz[np.isfinite(xyz).all(axis=1)])


def _sample(
    xyz: Float[np.ndarray, "N 3"], limit: int, rng: np.random.Generator | None
) -> Float[np.ndarray, "K 3"]:
    if len(xyz) <= limit:
        return xyz
    if rng is None:
        return xyz[np.linspace(0, len(xyz) - 1, limit).astype(np.int64)]
    return xyz[rng.choice(len(xyz), limit, replace=False)]
