"""``upsample``: new points for a scene, made, verified, completed and thinned.

Four steps, all but the first optional: a method makes points; ``verify`` checks interpolated ones
against the photographs; ``cover`` gives a seed to the parts of photographs that no point falls in;
a budget thins all.
Promise: without a budget the originals come first and unchanged; the same seed gives the same bytes
whatever the number of threads; every point is finite.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from splatseed.pointcloud import ATTRIBUTES, ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.photographs import MAX_SIZE, photographed, read_views, with_cover
from splatseed.seeding.thinning import frames_of, points_within, thin_to
from splatseed.upsample import Profile, Upsampler, upsample as add_points
from splatseed.upsample.method import NewPoints
from splatseed.upsample.registry import source_code

DEFAULT_METHOD, FALLBACK = "auto", "mls"
"""The default method, and its replacement for scenes without photographs."""
CELL = 8
"""Side in pixels of the cells by which coverage is measured."""

INTERPOLATING = ("linear", "triangle", "spline", "mls", "voronoi", "random")
"""Methods that interpolate between points; ``verify`` checks their points against the
photographs."""

FILLING = ("auto", "cover", "stereo")
"""Methods that look where there are points already."""

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
    beside: Upsampler | None = None,
    seed: int = 0,
    profile: Profile = "default",
    progress: Progress = silent,
    note: Note = lambda _: None,
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
        beside: Another method, such as ``Cloud().of("scan.laz")``, whose points come before those
            of ``method``; ``auto`` and ``cover`` take them into account.
        seed: The same seed gives the same bytes, whatever the number of threads.
        profile: "default", or "paper" for the paper's text to the letter.
        progress: Called with the stage and the fraction done.
        note: Called with what was left out or replaced, one sentence each.
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
    whole = scene if isinstance(scene, Scene) else Scene(scene)
    most = None if budget is None else points_within(whole, budget)
    if beside is None and DEFAULT_METHOD in {method, getattr(method, "name", None)}:
        method = method_for(scene, method, note)
        originals = whole.points.originals
        originals = originals.select(originals.distinct)
        plain = ratio is None and num_points is None and cover is None
        if plain and most is not None and len(originals) >= most:  # nothing else would stay
            note(
                f"There is room for {most:,} points, and there are {len(originals):,} already: "
                "they are thinned, and none are added."
            )
            return thin_to(whole, originals, most, CELL, 0, seed, progress)
    options: dict[str, Any] = {"seed": seed, "progress": progress, "note": note}
    # Measured points come first, so that the method fills what they leave.
    first = None if beside is None else add_points(whole, beside, **options)
    cloud = add_points(
        scene if first is None else _with(whole, first, method), method, ratio=ratio,
        num_points=num_points, profile=profile, **options, **parameters,
    )  # fmt: skip
    if first is not None:
        cloud = PointCloud.concatenate(first, cloud.select(cloud.source != ORIGINAL))
    if verify:
        cloud = add_verified(whole, cloud, progress=progress, note=note)
    if cover is not None:
        cloud = add_cover(whole, cloud, cell=cover, seed=seed, progress=progress)
    if most is not None:
        hold_out = getattr(method, "hold_out", parameters.get("hold_out", 0))
        cloud = thin_to(whole, cloud, most, cover or CELL, hold_out, seed, progress)
    return cloud


def _with(scene: Scene, points: PointCloud, method: str | Upsampler) -> Scene:
    """The scene with other points, for a method.

    Methods that fill gaps look at originals only, so for these all points are.
    """
    name = method if isinstance(method, str) else getattr(method, "name", None)
    return scene.replace(points=points.replace(source=None) if name in FILLING else points)


def add_cover(
    scene: Scene,
    cloud: PointCloud | None = None,
    *,
    cell: int = CELL,
    seed: int = 0,
    progress: Progress = silent,
) -> PointCloud:
    """A cloud plus a seed for each part of the photographs that it leaves empty.

    Args:
        scene: The scene with the photographs.
        cloud: The points; the scene's own when left out.
        cell: Side of a part in pixels, at the size that methods use.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: The side is below 1.
        PointCloudError: No point lies in any photograph.
        SceneNotFoundError: There are no photographs.
    """
    points = scene.points if cloud is None else cloud
    images = photographed(scene, without="do without cover")
    views = read_views(scene, images, MAX_SIZE, progress)
    return with_cover(views, points, cell, seed, progress)


def add_verified(
    scene: Scene, cloud: PointCloud, *, progress: Progress = silent, note: Note = lambda _: None
) -> PointCloud:
    """A cloud with its interpolated points checked against the photographs: moved, kept or dropped.

    Args:
        scene: The scene with the photographs.
        cloud: The points; those of ``INTERPOLATING`` methods are checked, the others stay.
        progress: Called with the stage and the fraction done.
        note: Called with how many met which fate, one sentence each.

    Raises:
        SceneNotFoundError: There are no photographs.
    """
    from splatseed.seeding.verify import verify  # noqa: PLC0415  (kernels load with use)
    from splatseed.views.visibility import find_visibility  # noqa: PLC0415  (loads with its use)

    codes = [source_code(name) for name in INTERPOLATING]
    guessed = np.isin(cloud.source, codes)
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
    known = {name: getattr(checked, name) for name in ATTRIBUTES}
    assert checked.source is not None  # noqa: S101  (it was given)
    kept = PointCloud(checked.xyz, checked.rgb, checked.source, **known)
    return PointCloud.concatenate(cloud.select(~guessed), kept)


def share_covered(scene: Scene, cloud: PointCloud, cell: int = CELL) -> float:
    """The fraction of the photographs' cells that hold a point, at the size that methods use.

    Args:
        scene: Provides the images; their files need not exist.
        cloud: The points.
        cell: Side of a cell in pixels.
    """
    from splatseed.seeding.coverage import covered_share  # noqa: PLC0415  (kernels load with use)

    return covered_share(frames_of(scene), cloud.xyz[cloud.finite], cell)


def method_for(
    scene: Scene | PointCloud, method: str | Upsampler = DEFAULT_METHOD, note: Note = lambda _: None
) -> str | Upsampler:
    """The default method, or its replacement if there are no photographs."""
    if isinstance(scene, Scene) and scene.has_photographs:
        return method
    note(f"Without photographs, method {FALLBACK} is used instead of {DEFAULT_METHOD}.")
    return FALLBACK
