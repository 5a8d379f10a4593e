"""A scene's points within a budget: measured ones by visibility, then guesses.

Promise: no more points than the number, and exactly the number if there are enough; only the order
of the views in which ``cover`` fills gaps is random.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.seeding.amounts import parse_budget
from splatseed.seeding.photographs import MAX_SIZE, photographed, read_views, with_cover
from splatseed.upsample.registry import source_code
from splatseed.views.view import View, data_factor, poses_of

COVER, CLOUD = source_code("cover"), source_code("cloud")
MOST_COVER = 0.1
"""Largest part of a budget for cover's guesses; their cells grow until they fit."""
COARSER = 1.25
"""Growth factor of the cells."""


def points_within(scene: Scene, budget: int | str) -> int:
    """The number of points that a budget allows a scene.

    Args:
        scene: The scene whose photographs define rho.
        budget: A number, or a string such as "0.25rho".

    Raises:
        ParameterError: It is neither, or below one point.
    """
    from splatseed.seeding.budget import median_pixels  # noqa: PLC0415  (loads Numba)

    photographs = poses_of(scene.images)
    return parse_budget(budget, median_pixels(photographs) if photographs else 0)


def thin_to(
    scene: Scene,
    cloud: PointCloud,
    num: int,
    cell: int,
    hold_out: int,
    seed: int,
    progress: Progress,
) -> PointCloud:
    """At most ``num`` of a cloud's points, originals before others of equal use.

    Cover is recomputed for what thinning leaves: a guess fills a gap, and must not replace a
    measured point. If there are at least ``num`` originals, only originals stay: they are dense
    where there is detail, which is where few Gaussians are needed most. But a scan's points, which
    the user has asked for, are thinned together with them.

    Args:
        scene: The scene of the points.
        cloud: The points.
        num: How many, at least 1.
        cell: Smallest side of cover's cells, in pixels.
        hold_out: Photographs that cover must not use, as in ``PhotographMethod``.
        seed: Determines the order of the views.
        progress: Called with the stage and the fraction done.
    """
    if len(cloud) <= num:
        return cloud
    points = cloud.select(cloud.distinct)
    guessed = points.source == COVER
    if not guessed.any() or guessed.all():
        return _keep(scene, points, num)
    known = points.select(~guessed)
    if known.num_original >= num and not (known.source == CLOUD).any():
        return _keep(scene, known.originals, num)
    views = read_views(scene, photographed(scene, hold_out), MAX_SIZE, progress)
    # Guesses get what the measured points leave, and a tenth at least.
    room = max(num - len(known), round(MOST_COVER * num))
    kept = _keep(scene, known, num - room)
    while cell <= MAX_SIZE:
        filled = with_cover(views, kept, cell, seed, progress).select(slice(len(kept), None))
        if len(filled) <= room:
            return PointCloud.concatenate(_keep(scene, known, num - len(filled)), filled)
        cell = math.ceil(COARSER * cell)
    return _keep(scene, known, num)


def frames_of(scene: Scene) -> tuple[View, ...]:
    """The views of a scene without their pixels, at the size that methods use."""
    return poses_of(scene.images, data_factor(scene.images, MAX_SIZE)) if scene.images else ()


def _keep(scene: Scene, points: PointCloud, num: int) -> PointCloud:
    """At most ``num`` of the points, chosen by the views that see them."""
    from splatseed.seeding.budget import thin  # noqa: PLC0415  (kernels load with use)

    if len(points) <= num or num < 1:
        return points.select(slice(max(num, 0)))
    first = int(np.count_nonzero(points.source == ORIGINAL))
    kept = thin(points.xyz, frames_of(scene), num, first=first, priority=points.confidence)
    return points.select(kept)
