"""``upsample``: add points to a scene by a method, fill gaps, thin them to a budget.

``cover`` puts a seed into every cell of the photographs that holds no point, and a budget thins the
result. Both are optional.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.checkup.choices import UnfitPoints
from splatseed.checkup.examination import with_fitting_points
from splatseed.errors import ParameterError
from splatseed.findings import Finding
from splatseed.io.regions import Region, parse_region
from splatseed.methods import (
    Profile,
    Upsampler,
    add_points,
    check_seed,
    resolve,
    source_code,
    traits_of,
)
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Note, Progress, log_note, silent, silent_note
from splatseed.scene import Scene
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.seeding.budget import points_within
from splatseed.seeding.clouds.point_colors import with_colors
from splatseed.seeding.cover import covered_share
from splatseed.seeding.photo_methods import (
    CELL,
    MAX_SIZE,
    PhotographMethod,
    frames_of,
    photographed,
    read_views,
    with_cover,
)
from splatseed.seeding.thinning import thin_to
from splatseed.text import agreeing, counted

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoResult

FILLING = ("auto", "cover", "stereo")
"""Methods that add points where there are none yet."""


def upsample(
    scene: Scene | PointCloud,
    method: str | Upsampler = DEFAULT_METHOD,
    *,
    ratio: float | None = None,
    num_points: int | None = None,
    budget: int | str | None = None,
    cover: int | None = None,
    region: str | Region | None = None,
    extra_method: Upsampler | None = None,
    seed: int = 0,
    profile: Profile = "default",
    unfit_points: UnfitPoints = "drop",
    progress: Progress = silent,
    note: Note = log_note,
    on_stereo: Callable[[StereoResult], None] | None = None,
    **parameters: Any,
) -> PointCloud:
    """Add points to a scene.

    Points that the photographs contradict are left out first.

    Args:
        scene: A scene or a cloud. New points start from originals (``source`` 0) and replace all
            points that were added before, which a note counts: add points of your own to the
            result.
        method: A key of ``METHODS``, a place such as "my_method.py:Jitter", or a configured method
            or function. "auto" compares the photographs; without photographs "mls" replaces it,
            with a note.
        ratio: Points in all, as a multiple of the originals, for methods that interpolate; 4 if
            neither it nor ``num_points`` is given. "auto", "stereo" and "cover" choose the number
            themselves and accept neither.
        num_points: Points in all, instead of ``ratio``.
        budget: Maximum number of points in all, or a string such as "0.25rho" for Gaussians per
            pixel of one photograph. It may be below the number of originals. "auto" and "stereo"
            make up to that many where photographs confirm them (``dense=False``: only thin).
        cover: Side in pixels of the photographs' cells that get a seed if they hold no point.
        region: Where new points are made: "x0,y0,z0,x1,y1,z1" for a box and others of
            ``parse_region``, or a function from positions [N, 3] to booleans [N]. The originals
            stay everywhere; ``ratio`` multiplies those within, and only new points within fill the
            budget. Photographs are compared as without it.
        extra_method: A second method, such as ``Cloud().of("scan.laz")``. Its points come before
            those of ``method``, and "auto", "stereo" and "cover" only fill the gaps between them.
        seed: Seed of all random draws; the same seed gives the same bytes on any number of threads.
        profile: "default", or "paper" for the parameters and equations of the paper's text.
        unfit_points: What to do with points that photographs contradict: "drop" them, "move" them
            by the similarity that fits, or "keep" them, as methods that interpolate always do.
        progress: Called with the stage and the fraction done.
        note: Called with a ``Finding`` for each thing that was chosen, replaced or left out; by
            default they are logged. Before photographs are compared again, ``second-comparison``
            gives its time and memory.
        on_stereo: Called with stereo's depth maps and views if the method compares photographs and
            the budget leaves room for new points.
        parameters: Fields of the method, such as ``k=12``.

    Returns:
        The N originals, unchanged, then the new points; ``source`` distinguishes them. A budget
        removes points of both kinds. Originals that lack colours get those of the photographs.

    Raises:
        ParameterError: Unknown method (an UnknownNameError, which is a KeyError, too), profile or
            parameter, or a value out of range.
        PointCloudError: Too few distinct finite points for the method.
        SceneNotFoundError: The method needs photographs or depth maps that do not exist.
        SceneFormatError: A photograph or depth map is damaged or does not fit the scene, or poses
            are of another convention.

    Example:
        >>> import numpy as np, splatseed as ss
        >>> rng = np.random.default_rng(0)
        >>> xyz, rgb = rng.random((100, 3)), rng.integers(0, 255, (100, 3), np.uint8)
        >>> seeds = ss.upsample(ss.PointCloud(xyz, rgb), method="mls", ratio=8, seed=0)
        >>> len(seeds), seeds.num_original
        (800, 100)
    """
    scene = _as_scene(scene)
    check_seed(seed)
    region = _as_region(region)
    chosen = resolve(method, profile)[1]
    if "test_every" in parameters and isinstance(chosen, PhotographMethod):
        chosen = dataclasses.replace(chosen, test_every=parameters["test_every"])
    scene, findings = checked_points(scene, chosen, unfit_points, progress)
    for finding in findings:
        note(finding)
    return upsample_checked(
        scene, method, ratio=ratio, num_points=num_points, budget=budget, cover=cover,
        region=region, extra_method=extra_method, seed=seed, profile=profile, progress=progress,
        note=note, on_stereo=on_stereo, **parameters,
    )  # fmt: skip


def checked_points(
    scene: Scene, method: Upsampler, unfit_points: UnfitPoints, progress: Progress
) -> tuple[Scene, tuple[Finding, ...]]:
    """Examine a scene, and leave out or move points that do not fit; also return findings.

    Points that a method interpolates are not left out.
    """
    if unfit_points == "drop" and "points" in traits_of(method).needs:
        unfit_points = "keep"
    test_every = getattr(method, "test_every", 0)
    return with_fitting_points(scene, unfit_points, progress, test_every=test_every)


def upsample_checked(
    scene: Scene,
    method: str | Upsampler = DEFAULT_METHOD,
    *,
    ratio: float | None = None,
    num_points: int | None = None,
    budget: int | str | None = None,
    cover: int | None = None,
    region: str | Region | None = None,
    extra_method: Upsampler | None = None,
    seed: int = 0,
    profile: Profile = "default",
    progress: Progress = silent,
    note: Note = silent_note,
    on_stereo: Callable[[StereoResult], None] | None = None,
    **parameters: Any,
) -> PointCloud:
    """Add points to a scene whose points have been examined: see ``upsample``."""
    if added := len(scene.points) - scene.points.num_original:
        verb = agreeing(added, "is", "are")
        text = f"{counted(added, 'point')} added before upsampling {verb} left out."
        note(Finding("earlier-seeds-replaced", text, "info"))
    limit = None if budget is None else points_within(scene, budget)
    if extra_method is None and DEFAULT_METHOD in {method, getattr(method, "name", None)}:
        method = method_for(scene, method, note)
    name, chosen = resolve(method, profile, parameters)
    scene = with_colors(scene, getattr(chosen, "test_every", 0), note, progress)
    only_default = name == DEFAULT_METHOD and ratio is None and num_points is None and cover is None
    inside = _usable_region(region, scene, chosen)
    base, measured, room = scene, None, limit
    if extra_method is not None:
        # Measured points come first, so that the method fills the gaps between them.
        extra_name, extra = resolve(extra_method)
        measured = add_points(scene, extra_name, extra, seed=seed, progress=progress, note=note)
        known = measured.replace(source=None) if name in FILLING else measured
        base = scene.with_points(known)
        room = _room_beside(measured, limit, inside)
    elif only_default and limit is not None:
        originals = scene.points.originals
        originals = originals.select(originals.distinct)
        if len(originals) >= limit:
            note(_no_room(limit, len(originals)))
            return thin_to(scene, originals, limit, None, seed, progress)
    cloud = add_points(
        base, name, chosen, ratio=ratio, num_points=num_points, budget=room, region=inside,
        seed=seed, progress=progress, note=note, on_stereo=on_stereo,
    )  # fmt: skip
    if measured is not None:
        cloud = PointCloud.concatenate(measured, cloud.select(cloud.source != ORIGINAL))
    if cover is not None:
        cloud = add_cover(
            scene, cloud, cell=cover, test_every=getattr(chosen, "test_every", 0), seed=seed,
            progress=progress,
        )  # fmt: skip
    cloud, beyond = _bounded(cloud, inside, note)
    if limit is not None:
        cloud = thin_to(
            scene, cloud, limit, chosen, seed, progress, cell=cover, region=inside, beyond=beyond
        )
    return cloud


def _as_region(region: object) -> Region | None:
    """Parse a region if it is text."""
    if region is None or callable(region):
        return region
    if isinstance(region, str):
        return parse_region(region)
    raise ParameterError(
        "`region` as text, such as 'x0,y0,z0,x1,y1,z1' for a box, or a function of positions",
        found=repr(region),
        fix="The central part of photographs, of method depth, is `depth.central_fraction`."
        if isinstance(region, int | float)
        else "",
    )


def _usable_region(region: str | Region | None, scene: Scene, method: Upsampler) -> Region | None:
    """Parse a region, and check that a method that needs points alone finds some there."""
    region = _as_region(region)
    if region is not None and traits_of(method).needs == {"points"}:
        _check_reached(region, scene.points.originals, "points of the scene")
    return region


def _room_beside(measured: PointCloud, limit: int | None, region: Region | None) -> int | None:
    """Return a limit that points measured outside of a region, to be left out, do not fill."""
    if limit is None or region is None:
        return limit
    new = measured.select(measured.source != ORIGINAL)
    return limit + int(np.count_nonzero(~region(new.xyz)))


def _bounded(
    cloud: PointCloud, region: Region | None, note: Note
) -> tuple[PointCloud, PointCloud | None]:
    """Leave out new points outside of a region; also return those of them that were measured."""
    if region is None:
        return cloud, None
    own, inside = cloud.source == ORIGINAL, region(cloud.xyz)
    new = int(np.count_nonzero(~own))
    if new:
        _check_reached(region, cloud.select(~own), "new points")
    text = (
        f"{np.count_nonzero(inside & ~own):,} of {counted(new, 'new point')} are in the region, "
        f"the others are left out; {counted(cloud.num_original, 'point')} of the scene stay, "
        f"{np.count_nonzero(inside & own):,} of them in the region."
    )
    note(Finding("seeds-of-region", text, "info"))
    beyond = ~inside & ~own & (cloud.source != source_code("cover"))
    return cloud.select(inside | own), cloud.select(beyond)


def _check_reached(region: Region, points: PointCloud, what: str) -> None:
    """Raise a ``ParameterError`` if none of some points lies in a region."""
    xyz = points.xyz[points.finite]
    if region(xyz).any():
        return
    ends = (end(xyz, axis=0) for end in (np.min, np.max)) if len(xyz) else ()
    lie = " to ".join(" ".join(f"{value:.4g}" for value in end) for end in ends)
    raise ParameterError(
        f"`region` to hold {what}",
        found=f"none of {len(xyz):,}{f', which lie from {lie}' if lie else ''}",
        fix="Choose a larger region, in the coordinates of splatseed info SCENE.",
    )


def _as_scene(scene: Scene | PointCloud) -> Scene:
    """Return the scene; of a cloud, one without images."""
    if isinstance(scene, PointCloud):
        return Scene(scene)
    if not isinstance(scene, Scene):
        raise ParameterError(
            "`scene` as a Scene or a PointCloud",
            found=type(scene).__name__,
            fix="Load it first with load_scene.",
        )
    return scene


def _no_room(limit: int, num_original: int) -> Finding:
    text = (
        f"The budget allows {limit:,} points, and the scene has {num_original:,}: they are "
        "thinned, and none are added."
    )
    return Finding("no-room-for-seeds", text, "info")


def add_cover(
    scene: Scene,
    cloud: PointCloud | None = None,
    *,
    cell: int = CELL,
    test_every: int = 0,
    seed: int = 0,
    progress: Progress = silent,
) -> PointCloud:
    """Add a seed for every cell of the photographs that holds no point.

    Args:
        scene: The scene whose photographs are used, at most ``MAX_SIZE`` pixels a side.
        cloud: The points to complete; the scene's own if None.
        cell: Side of a cell in pixels.
        test_every: Leave out every n-th photograph by name; 0 for none.
        seed: Seed of all random draws.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: ``cell`` is below 1.
        PointCloudError: No point lies in any photograph.
        SceneNotFoundError: There are no photographs.
    """
    points = scene.points if cloud is None else cloud
    images = photographed(scene, test_every, without="do without cover")
    views = read_views(scene, images, MAX_SIZE, progress)
    return with_cover(views, points, cell, seed, progress)


def share_covered(scene: Scene, cloud: PointCloud, cell: int = CELL) -> float:
    """Return the share, 0 to 1, of the photographs' cells that hold a point."""
    return covered_share(frames_of(scene), cloud.xyz[cloud.finite], cell)
