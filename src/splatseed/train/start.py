"""The Gaussians that a run begins with.

Notation: seeds and views are in the training frame, but for ``gaussians_of_scene``, which is in the
world's. Promise: NumPy alone, so that the same start can be written for other trainers without
PyTorch; a run begins with exactly what is written.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32

from splatseed.pointcloud import PointCloud
from splatseed.splat.gaussians import Gaussians, initial_gaussians, stray_views, training_frame
from splatseed.train.near_depths import near_depths
from splatseed.train.settings import TrainSettings
from splatseed.views.view import View


def first_gaussians(
    seeds: PointCloud, views: Sequence[View], settings: TrainSettings
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """One Gaussian per seed, and its near depth [N].

    Args:
        seeds: Finite points, in the training frame.
        views: The training views, likewise.
        settings: Their schedule gives sizes and opacities; they also say what is fitted.

    Raises:
        PointCloudError: Fewer than two distinct points.
    """
    lengths, schedule = near_depths(seeds.xyz, views), settings.schedule
    harmonics = None
    if settings.seed_colors:
        from splatseed.splat.appearance import fit_harmonics  # noqa: PLC0415  (kernels load with use)

        harmonics = fit_harmonics(seeds, views)
    gaussians = initial_gaussians(
        seeds,
        sh_degree=settings.sh_degree,
        opacity=schedule.opacity,
        scale_factor=schedule.scale_factor,
        largest=schedule.largest * lengths,
        flatness=schedule.flatness,
        harmonics=harmonics,
    )
    return gaussians, lengths


def gaussians_of_scene(
    cloud: PointCloud, views: Sequence[View], settings: TrainSettings
) -> Gaussians:
    """The initial Gaussians of training from a cloud, in the scene's world.

    Args:
        cloud: Seeds in the world; those without finite coordinates are left out.
        views: Photographs with their cameras.
        settings: As for ``first_gaussians``.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    frame, strays = training_frame(views), stray_views(views)
    near = [frame.view(view) for view in views if view.name not in strays]
    seeds = frame.cloud_from_world(cloud.select(cloud.finite))
    return frame.gaussians_to_world(first_gaussians(seeds, near, settings)[0])
