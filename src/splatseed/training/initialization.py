"""The first Gaussians of a run, and the unit of each one's size and learning rate.

Notation: the *min view depth* of a point is its smallest depth in the training views that see it. A
length divided by it is an angle, so a rate or size in this unit looks alike in the photographs
wherever a Gaussian is: in front of closely spaced cameras, on a table between them, or far behind.
3DGS uses the extent of the cameras for all Gaussians. Promise: the same points, cameras and
settings give the same bytes, whatever the number of threads. No PyTorch, so that other trainers can
be given the same start.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32

from splatseed.photos.view import NEAR_PLANE, View
from splatseed.photos.visibility import points_in_image
from splatseed.pointcloud import PointCloud
from splatseed.sampling import evenly_spaced
from splatseed.splat.from_seeds import fit_harmonics, initial_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.training_frame import TrainingFrame, training_frame
from splatseed.training.settings import TrainSettings

MAX_PROJECTIONS, MIN_VIEWS = 20_000_000, 64
"""Beyond this many points times views, evenly spaced views are used, at least ``MIN_VIEWS``."""
MARGIN = 0.1
"""A point outside the photograph by up to this fraction of its size counts as seen: a large
Gaussian there reaches in."""


def first_gaussians(
    seeds: PointCloud, views: Sequence[View], frame: TrainingFrame, settings: TrainSettings
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """Make one Gaussian per seed, in the training frame; also return their min view depths [N].

    Seeds (finite) and training views are in the scene's frame; stray cameras are ignored.
    """
    seeds = frame.cloud_from_world(seeds)
    views = [frame.view(view) for view in views if view.name not in frame.strays]
    depths, schedule = min_view_depths(seeds.xyz, views), settings.schedule
    gaussians = initial_gaussians(
        seeds,
        sh_degree=settings.sh_degree,
        opacity=schedule.opacity,
        scale_factor=schedule.scale_factor,
        max_sizes=schedule.max_size * depths,
        flatness=schedule.flatness,
        harmonics=fit_harmonics(seeds, views) if settings.seed_colors else None,
    )
    return gaussians, depths


def gaussians_of_scene(
    cloud: PointCloud, views: Sequence[View], settings: TrainSettings
) -> Gaussians:
    """Return the Gaussians that training starts from, in the scene's frame, as the cloud is.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    seeds = cloud.select(cloud.finite)
    frame = training_frame(views, seeds.references.xyz)
    gaussians, _ = first_gaussians(seeds, views, frame, settings)
    return frame.gaussians_to_world(gaussians)


def min_view_depths(
    xyz: Float[np.ndarray, "N 3"], views: Sequence[View]
) -> Float32[np.ndarray, " N"]:
    """Return each point's smallest depth in the views that see it; the median if none does."""
    nearest = np.full(len(xyz), np.inf)
    xyz = np.asfortranarray(xyz, np.float64)
    limit = max(MIN_VIEWS, MAX_PROJECTIONS // max(1, len(xyz)))
    for view in [views[i] for i in evenly_spaced(len(views), limit)]:
        rows, _, depth = points_in_image(view.camera, xyz, near=view.near, margin=MARGIN)
        nearest[rows] = np.minimum(nearest[rows], depth)
    known = np.isfinite(nearest)
    # A point that no view sees gets no gradient; any positive depth will do.
    nearest[~known] = np.median(nearest[known]) if known.any() else 1.0
    near_plane = min((view.near for view in views), default=NEAR_PLANE)
    return np.asarray(np.maximum(nearest, near_plane), np.float32)
