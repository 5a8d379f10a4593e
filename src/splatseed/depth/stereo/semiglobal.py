"""A depth for every pixel of a few photographs: semi-global matching in two rounds.

Two or three photographs confirm a quarter of each other's pixels; the rest must be inferred, and
what only one photograph sees most of all. The second round knows the maps of the first: a
hypothesis that another view sees past costs more there, and one that lies behind what it sees costs
as much as one outside its frame: where it is, it can match nothing. So pixels that are occluded
elsewhere take the depth of neighbours on the same surface, not that of a chance match.

Notation: as in ``_kernels.semiglobal``. Promise: each view is matched by one thread, so the same
photographs give the same bytes, whatever the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int64
from scipy.ndimage import median_filter

from splatseed.depth.stereo._kernels.semiglobal import (
    aggregate,
    cheapest,
    combine,
    correlate,
    place,
)
from splatseed.depth.stereo.matching import DepthPrior, grey_image, other_from_view
from splatseed.photos.sources import elsewhere
from splatseed.photos.view import View
from splatseed.progress import Progress, in_threads, num_threads
from splatseed.projection import camera_centers
from splatseed.runtime.memory import check_memory

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))
NO_MAP = np.empty((0, 0), np.float32)


@dataclass(frozen=True)
class SemiglobalSettings:
    """Constants; chosen on validation photographs (benchmarks/tried.md). A cost is at most 1."""

    num_hypotheses: int = 128  # of inverse depth, evenly spaced
    num_sources: int = 4  # nearest views that a view is compared with
    radius: int = 3  # of the windows, pixels
    noise: float = 4.0  # variance, squared grey levels
    best_weight: float = 0.2  # of the best source; the rest is the mean's
    unseen: float = 0.6  # cost of a hypothesis that no source sees
    in_front: float = 0.6  # added where a hypothesis is in front of what a source sees
    tolerance: float = 0.03  # relative difference of depth that counts as seen
    small: float = 0.08  # P1
    large: float = 3.0  # P2 between equal grey levels
    contrast: float = 25.0  # grey levels by which P2 falls to its e-th part
    median: int = 3  # side of the filter of inverse depth, pixels


SEMIGLOBAL = SemiglobalSettings()


def semiglobal_depths(
    views: Sequence[View], xyz: Float64[np.ndarray, "M 3"], progress: Progress
) -> list[Float32[np.ndarray, "H W"]]:
    """Return the planar depth of every pixel of two or more views.

    Args:
        views: The photographs, pinhole.
        xyz: Points of the scene, in the frame of the views' poses; each view's search extends a
            little beyond those that it sees or nearly sees.
        progress: Called with the stage and the fraction done.

    Raises:
        PointCloudError: The costs do not fit into memory.
    """
    _check_memory(views)
    greys = [grey_image(view.photograph).astype(np.float32) for view in views]
    hypotheses = [_hypotheses(view, xyz) for view in views]

    def matched(
        maps: Sequence[Float32[np.ndarray, "H W"]], stage: str
    ) -> list[Float32[np.ndarray, "H W"]]:
        found = [NO_MAP] * len(views)

        def work(start: int, stop: int) -> None:
            for i in range(start, stop):
                found[i] = _depth(i, views, greys, hypotheses[i], maps)

        in_threads(work, len(views), 1, stage, progress)
        return found

    first = matched([NO_MAP] * len(views), "compare photographs")
    return matched(first, "compare depths")


def _hypotheses(view: View, xyz: Float64[np.ndarray, "M 3"]) -> Float32[np.ndarray, " D"]:
    """Return the inverse depths to try, by the points within a frame's size of a view's frame.

    Points farther aside lie at any depth, down to 0; without others, their distances count.
    """
    uv, depth = view.camera.project(xyz)
    size = np.array([view.width, view.height])
    near = (depth > 0) & ((uv >= -size) & (uv < 2 * size)).all(axis=1)
    if not near.any():
        near[:], depth = True, np.linalg.norm(xyz - view.camera.center, axis=1)
    low, high = DepthPrior.from_points(uv[near], 1.0 / depth[near]).bounds
    return np.linspace(low, high, SEMIGLOBAL.num_hypotheses, dtype=np.float32)


def _depth(
    i: int,
    views: Sequence[View],
    greys: Sequence[Float32[np.ndarray, "H W"]],
    hypotheses: Float32[np.ndarray, " D"],
    maps: Sequence[Float32[np.ndarray, "H W"]],
) -> Float32[np.ndarray, "H W"]:
    """Return the map of view i, given the maps of the others, if there are any yet."""
    chosen, grey = SEMIGLOBAL, greys[i]
    costs = _costs(i, views, greys, hypotheses, maps)
    total = np.zeros_like(costs)
    for down, across in DIRECTIONS:
        aggregate(
            costs, grey, down, across, np.float32(chosen.small), chosen.large, chosen.contrast,
            total,
        )  # fmt: skip
    depth = np.empty_like(grey)
    cheapest(total, hypotheses, depth)
    # The median of depth is that of inverse depth.
    return np.asarray(median_filter(depth, chosen.median))


def _nearest(cam_from_world: Float64[np.ndarray, "V 4 4"], i: int) -> Int64[np.ndarray, " K"]:
    """Return the views at other places than view i, the nearest first.

    Of several at a place, as the parts of a panorama, the first is that which looks most alike.
    """
    centers, axes = camera_centers(cam_from_world), cam_from_world[:, 2, :3]
    gap = np.linalg.norm(centers[:, None] - centers, axis=2)
    others = elsewhere(gap, i)
    distance = np.round(gap[i, others] / gap.max(), 9)
    return others[np.lexsort([-(axes @ axes[i])[others], distance])]


def _costs(
    i: int,
    views: Sequence[View],
    greys: Sequence[Float32[np.ndarray, "H W"]],
    hypotheses: Float32[np.ndarray, " D"],
    maps: Sequence[Float32[np.ndarray, "H W"]],
) -> Float32[np.ndarray, "H W D"]:
    """Return the cost of each hypothesis at each pixel of view i."""
    chosen, shape = SEMIGLOBAL, greys[i].shape
    others = _nearest(np.stack([view.cam_from_world for view in views]), i)[: chosen.num_sources]
    warps = [np.ascontiguousarray(other_from_view(views[i], views[j])) for j in others]
    sampled, sums = np.empty(shape, np.float32), np.empty((5, shape[1]))
    each = np.empty((len(others), *shape), np.float32)
    places = np.empty(each.shape, np.uint8)
    combined = np.empty(shape, np.float32)
    costs = np.empty((*shape, len(hypotheses)), np.float32)
    for d, w in enumerate(hypotheses):
        for k, j in enumerate(others):
            place(warps[k], w, greys[j], maps[j], chosen.tolerance, sampled, places[k])
            correlate(greys[i], sampled, chosen.radius, chosen.noise, sums, each[k])
        combine(each, places, chosen.best_weight, chosen.unseen, chosen.in_front, combined)
        costs[:, :, d] = combined
    return costs


def _check_memory(views: Sequence[View]) -> None:
    """Refuse photographs whose costs, two volumes a thread, do not fit into memory."""
    largest = max(view.width * view.height for view in views)
    check_memory(
        largest * min(num_threads(), len(views)),
        2 * 4 * SEMIGLOBAL.num_hypotheses,
        "pixels held at once",
        found=f"photographs of up to {largest:,} pixels",
        fix="Choose smaller photographs, or free some memory.",
    )
