"""``upsample``: new points for a scene, made, verified, completed and thinned to a budget.

A method makes points; if asked, ``verify`` checks interpolated ones against the photographs,
``cover`` gives a seed to the parts of photographs that no point falls in, and a budget thins all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.errors import ParameterError
from splatseed.methods import (
    NewPoints,
    Profile,
    Upsampler,
    add_points,
    as_cloud,
    check_seed,
    configure,
    source_code,
)
from splatseed.photos.view import TRAINED_SIDE, View, at_file_size, data_factor, poses_of
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.advice import DEFAULT_METHOD, method_for
from splatseed.seeding.photo_methods import MAX_SIZE, photographed, read_views, with_cover

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoResult

RHO = "rho"  # the unit of Gaussians per pixel of a photograph
MOST = 10**12  # more points than any trainer holds
CELL = 8  # side in pixels of the cells by which coverage is measured
INTERPOLATING = ("linear", "triangle", "spline", "mls", "voronoi", "random")
"""Methods whose points ``verify`` checks against the photographs."""
FILLING = ("auto", "cover", "stereo")  # methods that look where there are points already
COVER, CLOUD = source_code("cover"), source_code("cloud")
MOST_COVER, COARSER = 0.1, 1.25
"""Largest part of a budget for cover's guesses, whose cells grow by a factor until they fit."""

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
    extra_method: Upsampler | None = None,
    seed: int = 0,
    profile: Profile = "default",
    progress: Progress = silent,
    note: Note = lambda _: None,
    on_stereo: Callable[[StereoResult], None] | None = None,
    **parameters: Any,
) -> PointCloud:
    """Better seeds for a scene.

    Args:
        scene: A scene, or a bare cloud. Points with ``source`` other than 0 are set aside: new
            points are made from originals only, and replace earlier new ones.
        method: A key of ``METHODS``, or a method with its parameters. ``auto``, the default, uses
            the photographs; if there are none, ``mls`` takes its place, and ``note`` is told.
        ratio: Points in all, as a multiple of the originals (r N), for methods that interpolate; 4
            when neither is given. For ``auto``, ``stereo`` and ``cover`` the photographs determine
            the number.
        num_points: Points in all, instead of ``ratio``.
        budget: Most points in all: a number, or a string such as "0.25rho" for Gaussians per pixel
            of one photograph. May be below the number of originals.
        cover: Side in pixels of the parts of the photographs that get a seed if no point falls in.
        verify: Check interpolated points against the photographs: slide them onto the surface, drop
            those that do not fit.
        extra_method: Another method, such as ``Cloud().of("scan.laz")``, whose points come before
            those of ``method``; ``auto`` and ``cover`` take them into account.
        seed: The same seed gives the same bytes, whatever the number of threads.
        profile: "default", or "paper" for the paper's text to the letter.
        progress: Called with the stage and the fraction done.
        note: Called with what was left out or replaced, one sentence each.
        on_stereo: Called with the depth maps and views of stereo, if the method compares
            photographs and the budget leaves room for new points.
        parameters: Fields of the method, such as ``k=12``.

    Returns:
        The N originals, then the new points; ``source`` tells them apart. A budget removes points
        of both kinds.

    Raises:
        ParameterError: An unknown method, profile or parameter, or a value or size out of range.
        PointCloudError: Too few distinct finite points for the method.
        SceneNotFoundError: The method needs photographs or depth maps that do not exist.
        SceneFormatError: One of these files is damaged, or they do not fit the scene.

    Example:
        >>> import numpy as np, splatseed as ss
        >>> rng = np.random.default_rng(0)
        >>> xyz, rgb = rng.random((100, 3)), rng.integers(0, 255, (100, 3), np.uint8)
        >>> seeds = ss.upsample(ss.PointCloud(xyz, rgb), method="mls", ratio=8, seed=0)
        >>> len(seeds), seeds.num_original
        (800, 100)
    """
    if isinstance(scene, Scene):
        scene = at_file_size(scene)
    whole = scene if isinstance(scene, Scene) else Scene(scene)
    check_seed(seed)
    most = None if budget is None else points_within(whole, budget)
    if extra_method is None and DEFAULT_METHOD in {method, getattr(method, "name", None)}:
        method = method_for(scene, method, note)
    made = configure(method, profile, **parameters) if isinstance(method, str) else method
    fills = extra_method is None and getattr(made, "name", None) == DEFAULT_METHOD
    if fills and ratio is None and num_points is None and cover is None:
        full = _full_already(whole, most, seed, progress, note)
        if full is not None:
            return full
    options: dict[str, Any] = {"seed": seed, "progress": progress, "note": note}
    # Measured points come first, so that the method fills what they leave.
    first = None if extra_method is None else add_points(whole, extra_method, **options)
    cloud = add_points(
        scene if first is None else _with(whole, first, method), method, ratio=ratio,
        num_points=num_points, profile=profile, on_stereo=on_stereo, **options, **parameters,
    )  # fmt: skip
    if first is not None:
        cloud = PointCloud.concatenate(first, cloud.select(cloud.source != ORIGINAL))
    if verify:
        cloud = _add_verified(whole, cloud, progress, note)
    if cover is not None:
        held = getattr(made, "test_every", 0)
        cloud = add_cover(whole, cloud, cell=cover, test_every=held, seed=seed, progress=progress)
    if most is not None:
        cloud = thin_to(whole, cloud, most, made, seed, progress, cell=cover)
    return cloud


def _full_already(
    scene: Scene, most: int | None, seed: int, progress: Progress, note: Note
) -> PointCloud | None:
    """The originals within a budget that leaves no room for others; None if it does."""
    originals = scene.points.originals
    originals = originals.select(originals.distinct)
    if most is None or len(originals) < most:
        return None
    note(
        f"There is room for {most:,} points, and there are {len(originals):,} already: "
        "they are thinned, and none are added."
    )
    return thin_to(scene, originals, most, None, seed, progress)


def _with(scene: Scene, points: PointCloud, method: str | Upsampler) -> Scene:
    """The scene with other points; methods that fill gaps look at originals only, so all are."""
    name = method if isinstance(method, str) else getattr(method, "name", None)
    return scene.replace(points=points.replace(source=None) if name in FILLING else points)


def add_cover(
    scene: Scene,
    cloud: PointCloud | None = None,
    *,
    cell: int = CELL,
    test_every: int = 0,
    seed: int = 0,
    progress: Progress = silent,
) -> PointCloud:
    """A cloud plus a seed for each part of the photographs that it leaves empty.

    Without a cloud, the scene's own; parts are ``cell`` pixels wide, at the size that methods use.
    Every ``test_every``-th photograph by name is left out; 0: none.

    Raises:
        ParameterError: The side is below 1.
        PointCloudError: No point lies in any photograph.
        SceneNotFoundError: There are no photographs.
    """
    points = scene.points if cloud is None else cloud
    images = photographed(scene, test_every, without="do without cover")
    views = read_views(scene, images, MAX_SIZE, progress)
    return with_cover(views, points, cell, seed, progress)


def _add_verified(scene: Scene, cloud: PointCloud, progress: Progress, note: Note) -> PointCloud:
    """A cloud with its interpolated points checked against the photographs; others stay."""
    from splatseed.photos.visibility import find_visibility  # noqa: PLC0415  (loads with its use)
    from splatseed.seeding.verify import verify  # noqa: PLC0415  (kernels load with use)

    guessed = np.isin(cloud.source, [source_code(name) for name in INTERPOLATING])
    if not guessed.any():
        note("There are no interpolated points to verify.")
        return cloud
    images = photographed(scene, without="do without verify")
    views = read_views(scene, images, MAX_SIZE, progress)
    points = cloud.select(guessed)
    new = NewPoints(points.xyz, points.rgb, (), source=points.source)
    checked = verify(views, images, find_visibility(scene), new, progress)
    for sentence in checked.notes:
        note(sentence)
    kept = as_cloud(checked, len(checked.xyz), 0)  # their sources are known
    return PointCloud.concatenate(cloud.select(~guessed), kept)


def share_covered(scene: Scene, cloud: PointCloud, cell: int = CELL) -> float:
    """The fraction of the photographs' cells that hold a point, at the size that methods use."""
    from splatseed.seeding.coverage import covered_share  # noqa: PLC0415  (kernels load with use)

    return covered_share(frames_of(scene), cloud.xyz[cloud.finite], cell)


def points_within(scene: Scene, budget: int | str) -> int:
    """``parse_budget`` with the photographs of a scene, at the size of training by default."""
    from splatseed.seeding.budget import median_pixels  # noqa: PLC0415  (loads Numba)

    images = at_file_size(scene).images
    photographs = poses_of(images, data_factor(images, TRAINED_SIDE)) if images else ()
    return parse_budget(budget, median_pixels(photographs) if photographs else 0)


def thin_to(
    scene: Scene,
    cloud: PointCloud,
    num: int,
    method: Upsampler | None,
    seed: int,
    progress: Progress,
    *,
    cell: int | None = None,
) -> PointCloud:
    """At most ``num`` of the points that a method has made, originals before others of equal use.

    Cover, whose cells are ``cell`` pixels wide at least (by default the method's own), is made
    again for what thinning leaves: a guess fills a gap, and must not replace a measured point. If
    there are at least ``num`` originals, only originals stay: they are dense where there is detail,
    which is where Gaussians are needed most. But a scan's points are thinned together with them.
    """
    if len(cloud) <= num:
        return cloud
    points = cloud.select(cloud.distinct)
    if points.num_original >= num and not (points.source == CLOUD).any():
        return _keep(scene, points.originals, num)
    guessed = points.source == COVER
    if not guessed.any() or guessed.all():
        return _keep(scene, points, num)
    known = points.select(~guessed)
    images = photographed(scene, getattr(method, "test_every", 0))
    views = read_views(scene, images, getattr(method, "max_size", MAX_SIZE), progress)
    cell = cell or int(getattr(method, "cell", CELL))
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
    images = at_file_size(scene).images
    return poses_of(images, data_factor(images, MAX_SIZE)) if images else ()


def _keep(scene: Scene, points: PointCloud, num: int) -> PointCloud:
    """At most ``num`` of the points, chosen by the views that see them."""
    from splatseed.seeding.budget import thin  # noqa: PLC0415  (kernels load with use)

    if len(points) <= num or num < 1:
        return points.select(slice(max(num, 0)))
    first = int(np.count_nonzero(points.source == ORIGINAL))
    kept = thin(points.xyz, frames_of(scene), num, first=first, priority=points.confidence)
    return points.select(kept)


def parse_budget(budget: str | float, pixels: float) -> int:
    """The number of points or Gaussians that a budget allows; rho are those per pixel of an image.

    Raises:
        ParameterError: It is neither, or allows none, or more than anything can hold.

    Example:
        >>> parse_budget("50k", 0), parse_budget("0.25rho", 800 * 600)
        (50000, 120000)
    """
    text = str(budget).strip().lower()
    units = {RHO: pixels, "k": 1e3, "m": 1e6}
    unit = next((each for each in units if text.endswith(each)), "")
    try:
        number = float(text.removesuffix(unit)) * units.get(unit, 1.0)
    except ValueError:
        number = math.nan
    if not (0.5 < number <= MOST) or (not unit and number < 1):
        fix = f"Did you mean {text}rho?" if not unit and 0 < number < 1 else "Give 1 or more."
        if unit == RHO and not pixels:
            fix = "Give a number of points: there are no photographs whose pixels could be counted."
        raise ParameterError(
            "a budget such as 50000, 50k, or 0.25rho (a quarter of the pixels of an image)",
            found=repr(budget),
            fix=fix,
        )
    return round(number)
