"""``upsample``: a scene's points and new ones, made, checked, completed and thinned.

Four steps, of which all but the first are asked for: a method makes points; ``verify`` holds interpolated ones
against the photographs; ``cover`` gives the parts of photographs that no point falls in a seed; a budget thins all.
Promise: without a budget the originals come first and unchanged; the same seed gives the same bytes whatever the number
of threads; every point is finite.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from splatseed.pointcloud import ATTRIBUTES, ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.photographs import MAX_SIZE, cover_cloud, photographed, read_views
from splatseed.upsample import Profile, Upsampler, upsample as add_points
from splatseed.upsample.registry import source_code
from splatseed.views.view import View, data_factor, poses_of

__all__ = [
    "CELL",
    "DEFAULT_METHOD",
    "FALLBACK",
    "add_cover",
    "method_for",
    "share_covered",
    "upsample",
]

DEFAULT_METHOD, FALLBACK = "auto", "mls"
"""What makes the points, and what does where there are no photographs to look at."""
CELL = 8
"""Side in pixels of the cells by which coverage is measured."""
COVER = source_code("cover")
MOST_COVER = 0.25
"""Part of a budget that cover's guesses may take, at most; their cells grow until they fit."""
COARSER = 1.25

Note = Callable[[str], None]


def upsample(
    scene: Scene | PointCloud,
    method: str | Upsampler = DEFAULT_METHOD,
    *,
    ratio: float | None = None,
    num_points: int | None = None,
    budget: int | str | None = None,
    cover: int | None = None,
    verify: bool = False,
    seed: int = 0,
    profile: Profile = "default",
    progress: Progress = silent,
    note: Note = lambda _: None,
    **parameters: Any,
) -> PointCloud:
    """Better seeds for a scene.

    Args:
        scene: A scene, or a bare cloud. Points with ``source`` other than 0 are put aside: new
            points are made from originals only, and replace earlier new ones.
        method: A key of ``METHODS``, or a method with its parameters. ``auto``, the default, looks at the
            photographs; where there are none, ``mls`` is taken, and ``note`` is told.
        ratio: Points in all, as a multiple of the originals (r N), for methods that interpolate;
            4 when neither is given. The photographs say how many ``auto``, ``stereo`` and ``cover`` make.
        num_points: Points in all, instead of ``ratio``.
        budget: Most points in all: a number, or a string such as "0.25rho", Gaussians per pixel of one
            photograph. May be below the number of originals.
        cover: Side in pixels of the parts of the photographs that get a seed where no point falls in.
        verify: Hold interpolated points against the photographs: slide them onto the surface, drop what
            does not fit.
        seed: The same seed gives the same bytes, whatever the number of threads.
        profile: "default", or "paper" for the paper's text to the letter.
        progress: Told each stage and the fraction done.
        note: Told what was left out or made do with, one sentence each.
        parameters: Fields of the method, such as ``k=12``.

    Returns:
        The N originals, then the new points; ``source`` tells them apart. A budget takes points of both.

    Raises:
        ParameterError: An unknown method, profile or parameter, or a value or size out of range.
        PointCloudError: Too few distinct finite points for the method.
        SceneNotFoundError: The method needs photographs or depth maps that are not there.
        SceneFormatError: One of these files is damaged, or they do not fit the scene.

    Example:
        >>> import numpy as np, splatseed as ss
        >>> rng = np.random.default_rng(0)
        >>> xyz, rgb = rng.random((100, 3)), rng.integers(0, 255, (100, 3), np.uint8)
        >>> seeds = ss.upsample(ss.PointCloud(xyz, rgb), method="mls", ratio=8, seed=0)
        >>> len(seeds), seeds.num_original
        (800, 100)
    """
    if method == DEFAULT_METHOD or getattr(method, "name", None) == DEFAULT_METHOD:
        method = method_for(scene, method, note)
    cloud = add_points(
        scene, method, ratio=ratio, num_points=num_points, seed=seed, profile=profile,
        progress=progress, note=note, **parameters,
    )  # fmt: skip
    if not verify and cover is None and budget is None:
        return cloud
    whole = scene if isinstance(scene, Scene) else Scene(scene)
    if verify:
        cloud = _verified(whole, cloud, progress, note)
    if cover is not None:
        cloud = add_cover(whole, cloud, cell=cover, seed=seed, progress=progress)
    if budget is not None:
        hold_out = getattr(method, "hold_out", parameters.get("hold_out", 0))
        cloud = _thinned(whole, cloud, budget, cover or CELL, hold_out, seed, progress)
    return cloud


def add_cover(
    scene: Scene,
    cloud: PointCloud | None = None,
    *,
    cell: int = CELL,
    seed: int = 0,
    progress: Progress = silent,
) -> PointCloud:
    """A cloud, and a seed for each part of the photographs that it leaves empty.

    Args:
        scene: Whose photographs are looked at.
        cloud: The points; the scene's own when left out.
        cell: Side of a part, in pixels of the photographs at the size that methods look at.
        seed: The same seed gives the same bytes.
        progress: Told how far it is.

    Raises:
        ParameterError: The side is below 1.
        PointCloudError: No point lies in any photograph.
        SceneNotFoundError: There are no photographs.
    """
    points = scene.points if cloud is None else cloud
    views = read_views(scene, photographed(scene), MAX_SIZE, progress)
    return _with_cover(views, points, cell, seed, progress)


def share_covered(scene: Scene, cloud: PointCloud, cell: int = CELL) -> float:
    """The share of the photographs' cells that hold a point, at the size that methods look at.

    Args:
        scene: Its images; their files need not be there.
        cloud: The points.
        cell: Side of a cell in pixels.
    """
    from splatseed.seeding.coverage import covered_share  # noqa: PLC0415  (kernels load with use)

    return covered_share(_frames(scene), cloud.xyz[cloud.finite], cell)


def method_for(
    scene: Scene | PointCloud, method: str | Upsampler = DEFAULT_METHOD, note: Note = lambda _: None
) -> str | Upsampler:
    """The default method, or what stands in for it where there are no photographs."""
    if isinstance(scene, Scene) and scene.has_photographs:
        return method
    note(f"There are no photographs to look at: method {FALLBACK} instead of {DEFAULT_METHOD}.")
    return FALLBACK


def _frames(scene: Scene) -> tuple[View, ...]:
    """The views of a scene without their pixels, at the size that methods look at."""
    return poses_of(scene.images, data_factor(scene.images, MAX_SIZE))


def _thinned(
    scene: Scene,
    cloud: PointCloud,
    budget: int | str,
    cell: int,
    hold_out: int,
    seed: int,
    progress: Progress,
) -> PointCloud:
    """At most so many of the points, originals before others where both would do.

    Cover is made anew for what thinning leaves: a guess fills a gap, and must not take the place of a
    point that is known.
    """
    from splatseed.seeding.budget import median_pixels, parse_budget  # noqa: PLC0415  (as below)

    photographs = poses_of(scene.images)
    num = parse_budget(budget, median_pixels(photographs) if photographs else 0)
    if len(cloud) <= num:
        return cloud
    points = cloud.select(cloud.distinct)
    guessed = points.source == COVER
    if not guessed.any() or guessed.all():
        return _keep(scene, points, num)
    known = points.select(~guessed)
    views = read_views(scene, photographed(scene, hold_out), MAX_SIZE, progress)
    room = max(num - len(known), round(MOST_COVER * num))
    kept = _keep(scene, known, num - room)
    while True:
        filled = _with_cover(views, kept, cell, seed, progress)
        extra = len(filled) - len(kept)
        if extra <= room:
            break
        cell = math.ceil(COARSER * cell)
    return PointCloud.concatenate(
        _keep(scene, known, num - extra), filled.select(slice(len(kept), None))
    )


def _keep(scene: Scene, points: PointCloud, num: int) -> PointCloud:
    """So many of the points, by the views that see them."""
    from splatseed.seeding.budget import thin  # noqa: PLC0415  (kernels load with use)

    if num <= 0 or len(points) <= num:
        return points.select(slice(max(num, 0)))
    first = int((points.source == ORIGINAL).sum())
    views = _frames(scene) if scene.images else ()
    kept = thin(points.xyz, views, num, first=first, priority=points.confidence)
    return points.select(kept)


def _with_cover(
    views: Sequence[View], points: PointCloud, cell: int, seed: int, progress: Progress
) -> PointCloud:
    """The points, and a seed in each cell of the views that they leave empty."""
    new = cover_cloud(views, points, cell, np.random.default_rng([seed, COVER]), progress)
    source = np.full(len(new.xyz), COVER, np.uint8)
    known = {name: getattr(new, name) for name in ATTRIBUTES}
    return PointCloud.concatenate(points, PointCloud(new.xyz, new.rgb, source, **known))
