"""Geometric quality of a cloud: its spacing, and the distances of new points from known surfaces.

Notation: the spacing of a point is its mean distance to its 6 nearest others, in scene units; h is
a cloud's: the mean over its points. Scores are in units of h of the *originals*, so that scenes of
any size compare. Exact duplicates and non-finite points do not count as neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.pointcloud import first_of_equals

NEIGHBORS = 6  # as in a hexagonal pattern
FAR_SPACINGS = 3.0  # spacings of the nearest original beyond which a new point is far from it
MAX_SAMPLE = 50_000  # new points that are tested for being far


@dataclass(frozen=True)
class GeometryScore:
    """Geometric quality of upsampled points, in units of the originals' spacing h.

    A few mismatched originals can dominate the mean error.
    """

    error: float  # mean distance from a new point to the surface; NaN without new points
    median: float  # of the same
    p95: float  # of the same
    coverage: float  # mean distance from a surface sample to the nearest of all points
    share_far: float  # fraction of new points far from every original (``far_share``)


def measure(
    new_xyz: Float[np.ndarray, "M 3"],
    all_xyz: Float[np.ndarray, "N 3"],
    surfaces: Any,
    surface_samples: Float[np.ndarray, "S 3"],
    h: float,
) -> GeometryScore:
    """Compare new points with known surfaces.

    Args:
        new_xyz: The new points; to score originals alone, pass them.
        all_xyz: Originals first, the new points last.
        surfaces: An object with ``distance(xyz)``.
        surface_samples: Points spread evenly over the surfaces.
        h: The unit, usually ``mean_spacing(originals)``.
    """
    if len(all_xyz) == 0 or not h > 0:
        raise PointCloudError(
            "at least one point and a spacing above zero to measure with",
            found=f"{len(all_xyz)} points and a spacing of {h}",
            fix="Pass the whole cloud and mean_spacing(originals).",
        )
    errors = surfaces.distance(new_xyz) / h if len(new_xyz) else np.array([np.nan])
    coverage = cKDTree(all_xyz).query(surface_samples)[0].mean() / h
    originals = all_xyz[: len(all_xyz) - len(new_xyz)]
    share = far_share(originals, new_xyz) if len(originals) else 0.0
    median, p95 = (float(value) for value in np.percentile(errors, [50, 95]))
    return GeometryScore(float(errors.mean()), median, p95, float(coverage), share)


def mean_spacing(xyz: Float[np.ndarray, "N 3"]) -> float:
    """Return h, the mean spacing of the points, in scene units."""
    finite = _distinct(xyz)
    h = float(_spacings(cKDTree(finite), finite).mean()) if len(finite) else 0.0
    if not h > 0:
        raise PointCloudError(
            "at least two distinct finite points to take a spacing of",
            found=f"{len(xyz)} points, {len(finite)} of them distinct and finite",
            fix="Check that the cloud was read correctly.",
        )
    return h


def _distinct(xyz: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
    finite = xyz[np.isfinite(xyz).all(axis=1)]
    distinct: Float[np.ndarray, "M 3"] = finite[first_of_equals(finite)]
    return distinct


def _spacings(tree: cKDTree, xyz: Float[np.ndarray, "M 3"]) -> Float64[np.ndarray, " M"]:
    """Return the spacing of some of a tree's points; 0 if there are no others."""
    distances, _ = tree.query(xyz, k=NEIGHBORS + 1)
    # The point itself has distance 0, missing neighbours inf.
    counts = (distances > 0) & np.isfinite(distances)
    total = np.where(counts, distances, 0.0).sum(axis=1)
    return np.asarray(total / np.maximum(counts.sum(axis=1), 1))


def far_share(originals_xyz: Float[np.ndarray, "N 3"], new_xyz: Float[np.ndarray, "M 3"]) -> float:
    """Return the fraction of new points farther than 3 h from the nearest original.

    h is the spacing of that original. Of many points a sample is tested; a non-finite one is far.
    """
    if len(new_xyz) == 0:
        return 0.0
    originals = _distinct(originals_xyz)
    if len(originals) == 0:
        raise PointCloudError(
            "finite original points to compare the new ones with",
            found=f"none among {len(originals_xyz)}",
            fix="Check that the cloud was read correctly.",
        )
    sample = new_xyz
    if len(sample) > MAX_SAMPLE:
        sample = sample[np.random.default_rng(0).choice(len(sample), MAX_SAMPLE, replace=False)]
    # An unbalanced tree is built several times faster, and only few queries follow.
    tree = cKDTree(originals, balanced_tree=False, compact_nodes=False)
    to_original, nearest = tree.query(sample[np.isfinite(sample).all(axis=1)])
    h = _spacings(tree, originals[nearest])
    return float(1.0 - np.count_nonzero(to_original <= FAR_SPACINGS * h) / len(sample))
