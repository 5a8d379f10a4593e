"""Depth-guided lifting, from the images of a scene to new points.

Notation: images give C *candidates* in all. A candidate is *sound* (``tier`` 0) if enough views
confirm it, no view sees through it, and no depth discontinuity is near. Promise: ``lift`` returns
exactly the requested number, or raises one error with the number that is possible. Sound candidates
come first, then those that too few views confirm, then those near discontinuities; findings count
the latter two. Points that a view sees through are used only if the settings allow it. Within a
tier, points are spread evenly in space, or images give equal numbers as far as they can. Results do
not depend on threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64, UInt8

from splatseed.depth.alignment import lift_pixels, reject_other_units, reject_outliers
from splatseed.depth.comparison import choose_neighbors, find_support, synchronize_scales
from splatseed.depth.kinds import with_fitting_kind
from splatseed.depth.settings import PER_POINT, DepthSettings
from splatseed.depth.thinning import spread_evenly
from splatseed.depth.views import DepthView, read_view
from splatseed.depthmap import in_scene_units
from splatseed.errors import PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.origin import translated_image
from splatseed.io.photograph_checks import with_photographs
from splatseed.io.regions import Region
from splatseed.photos.sizes import default_factor
from splatseed.photos.visibility import Visibility, find_visibility
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image, Scene
from splatseed.text import agreeing

SOUND, UNCONFIRMED, NEAR_EDGE, SEEN_THROUGH, OUTSIDE = range(5)
"""Tiers, in the order in which they are used; the last two are never used."""
POINTS_PER_PIXEL = 0.25
"""Points for a scene without any, per pixel of a photograph at the size that is trained."""
VIEWS_PER_TASK = 4
MAX_NAMED = 3
"""Images that a note names."""
MIN_AGREEMENT = 0.5
"""Smallest share that is confirmed of the candidates that others confirm or see through, where maps
are not aligned to points: 0.99 and more on three captures, 0.36 and less with maps in another unit
or poses with other camera axes."""
MIN_SHOWN = 0.02
"""Smallest share of candidates that others confirm or see through for that to mean something: views
that hardly overlap have a few at their edges."""


@dataclass(frozen=True)
class _Oversampling:
    """Candidates drawn per new point."""

    compared: float = 1.4  # at first, if views are compared or points spread
    plain: float = 1.25  # at first otherwise, and the surplus of a further round
    limit: float = 16.0
    max_growth: float = 8.0  # of a further round


OVERSAMPLING = _Oversampling()


def lift(
    scene: Scene,
    num: int,
    settings: DepthSettings,
    rng: np.random.Generator,
    progress: Progress = silent,
    within: Region | None = None,
) -> tuple[Float32[np.ndarray, "M 3"], UInt8[np.ndarray, "M 3"], tuple[Finding, ...]]:
    """Lift ``num`` pixels of a scene's images into its world, or into the region ``within``.

    Each image and its map are read once, and again only if too few candidates are sound.

    Returns:
        World positions and colours, image after image, and findings for the user.

    Raises:
        SceneNotFoundError: There are no maps or no photographs, or a file is gone.
        SceneFormatError: A file is damaged or does not fit, no map can be aligned, or maps that are
            not aligned contradict each other.
        PointCloudError: The maps cannot give that many points.
    """
    settings = _settings_without_points(scene, settings)
    scene, center = _centered(scene)
    visibility, findings = find_visibility(scene), list[Finding]()
    if settings.align:
        scene, findings = with_fitting_kind(scene, visibility)
    images = _images_with_maps(scene, settings, findings)
    factor = OVERSAMPLING.plain
    if settings.compares_views or settings.spread:
        factor = OVERSAMPLING.compared
    views = _read_views(scene, images, visibility, factor * num, settings, rng, progress)
    images, views = _leave_out(images, views, settings, findings)
    candidates = _gather(views, settings, progress)
    if not settings.align and settings.min_agreeing:  # nothing else checks unit and poses
        _check_agreement(candidates, len(views))
    _mark_outside(candidates, center, within)
    limit = OVERSAMPLING.limit if within is None else math.inf  # it may be small
    while (
        (sound := int(np.count_nonzero(candidates.tier == SOUND))) < num
        and factor < limit
        and not all(v.exhausted for v in views)
    ):
        # In proportion to the sound ones, so that one more round mostly suffices.
        growth = OVERSAMPLING.plain * num / max(sound, 1)
        factor = min(factor * min(growth, OVERSAMPLING.max_growth), limit)
        views = _read_views(scene, images, visibility, factor * num, settings, rng, progress)
        candidates = _gather(views, settings, progress)
        _mark_outside(candidates, center, within)
    progress("choose points", 0.0)
    points = scene.points.originals
    chosen = _choose(candidates, np.asarray(points.xyz[points.finite]), num, settings, rng)
    progress("choose points", 1.0)
    tier = candidates.tier[chosen]
    if unconfirmed := np.count_nonzero(tier == UNCONFIRMED):
        text = (
            f"{unconfirmed:,} of {num:,} new points are confirmed by fewer than "
            f"{settings.min_agreeing} other views: no others were left."
        )
        findings.append(Finding("unconfirmed-points", text))
    if edge := np.count_nonzero(tier == NEAR_EDGE):
        text = f"{edge:,} of {num:,} new points lie near depth discontinuities."
        findings.append(Finding("points-near-edges", text))
    xyz = candidates.xyz[chosen]
    np.add(xyz, center, out=xyz, casting="same_kind")  # in float64, then rounded
    return xyz, candidates.rgb[chosen], tuple(findings)


def suggested_number(scene: Scene, settings: DepthSettings) -> int:
    """Return a number of points for a scene without any: a quarter per pixel of a photograph.

    It is limited to what the maps can give. Raises as ``lift``.
    """
    settings = _settings_without_points(scene, settings)
    images = _images_with_maps(scene, settings, [])
    factor, depths = default_factor(images), scene.depths
    assert depths is not None  # noqa: S101  (these images have maps)
    sizes = [(im.camera.width // factor) * (im.camera.height // factor) for im in images]
    number, known = round(POINTS_PER_PIXEL * float(np.median(sizes))), 0
    for image in images:
        values = depths.read(image.name).reliable(settings.min_confidence).values
        known += int(np.count_nonzero(np.isfinite(values)))
        if known >= PER_POINT * number:
            return number
    return max(1, known // PER_POINT)


def _settings_without_points(scene: Scene, settings: DepthSettings) -> DepthSettings:
    """Return the settings, without alignment if there are no points to align to."""
    if not settings.align or scene.points.originals.finite.any():
        return settings
    if not in_scene_units(scene.depths):
        raise PointCloudError(
            "at least one original point with finite coordinates, to whose scale maps are fitted",
            found=f"none of {len(scene.points):,}" if len(scene.points) else "none",
            fix="Triangulate some (splatseed sfm --poses-from), or pass `depth.align=False` if the "
            "maps are in the unit of the poses.",
        )
    return replace(settings, align=False)


def _images_with_maps(
    scene: Scene, settings: DepthSettings, findings: list[Finding]
) -> list[Image]:
    """Images with a depth map and a photograph, without test images; reports the others."""
    depths, used = scene.depths, scene.images
    if settings.test_every or scene.listed:
        used = scene.split(settings.test_every)[0]
    images = [image for image in used if depths is not None and image.name in depths]
    if depths is None or not images:
        raise SceneNotFoundError(
            "a scene with depth maps of its images",
            found=f"{len(scene.images)} images, and maps of none of them",
            fix="Name the folder of the maps with `depth` (in Python: scene.with_depths).",
        )
    if lacking := tuple(image.name for image in used if image.name not in depths):
        verbs = agreeing(len(lacking), "has no depth map and gives", "have no depth map and give")
        text = f"{len(lacking)} of {len(used)} images {verbs} no points."
        findings.append(Finding("missing-depth-maps", text, subjects=lacking))
    with_photographs(scene)  # raises if too few are there
    return [image for image in images if image.has_photograph]


def _read_views(
    scene: Scene,
    images: list[Image],
    visibility: Visibility,
    num: float,
    settings: DepthSettings,
    rng: np.random.Generator,
    progress: Progress,
) -> list[DepthView]:
    depths = scene.depths
    assert depths is not None  # noqa: S101  (these images have maps)
    views: dict[int, DepthView] = {}
    # A seed per image, drawn in order, so that threads do not matter.
    seeds, per_image = rng.integers(0, 1 << 63, len(images)), math.ceil(num / len(images))

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            views[i] = read_view(
                images[i], depths, visibility, settings, per_image,
                np.random.default_rng(seeds[i]),
            )  # fmt: skip

    in_threads(work, len(images), 1, "read images", progress)
    return [views[i] for i in range(len(images))]


def _centered(scene: Scene) -> tuple[Scene, Float64[np.ndarray, " 3"]]:
    """Move the mean of the cameras to the origin; returns the scene and that mean.

    Candidates are float32: far from the origin (UTM coordinates) they would be too coarse.
    """
    if not scene.images:
        return scene, np.zeros(3)
    center = np.mean([image.camera.center for image in scene.images], axis=0)
    images = tuple(translated_image(image, center) for image in scene.images)
    points = scene.points.replace(xyz=(scene.points.xyz - center).astype(np.float32))
    return scene.replace(points=points, images=images, tracks=scene.tracks), center


def _leave_out(
    images: list[Image], views: list[DepthView], settings: DepthSettings, findings: list[Finding]
) -> tuple[list[Image], list[DepthView]]:
    """Keep the images and views whose maps are aligned; reports the others."""
    alignments = {image.name: view.alignment for image, view in zip(images, views, strict=True)}
    if settings.align:
        alignments = reject_other_units(alignments, settings.min_points)
    alignments = reject_outliers(alignments, settings.max_residual_ratio)
    reasons = {name: a.rejected for name, a in alignments.items() if a.rejected is not None}
    if len(reasons) == len(alignments):
        name, reason = next(iter(reasons.items()))
        raise SceneFormatError(
            "depth maps that fit the SfM points of their images",
            found=f"none among {len(images)}; {name}: {reason}",
            fix="View them with splatseed info SCENE --depth DIR; check `depth_kind` and "
            "`depth_scale`.",
        )
    if reasons:
        named = "; ".join(f"{name}: {reason}" for name, reason in list(reasons.items())[:MAX_NAMED])
        more = ", ..." if len(reasons) > MAX_NAMED else ""
        text = f"{len(reasons)} of {len(images)} depth maps are left out ({named}{more})."
        findings.append(Finding("unfit-depth-maps", text, subjects=tuple(reasons)))
    kept = [i for i, image in enumerate(images) if image.name not in reasons]
    return [images[i] for i in kept], [views[i] for i in kept]


class _Candidates(NamedTuple):
    """Candidates of all views, view after view."""

    xyz: Float32[np.ndarray, "C 3"]
    rgb: UInt8[np.ndarray, "C 3"]
    footprint: Float32[np.ndarray, " C"]  # size of a pixel at their depth, scene units
    tier: UInt8[np.ndarray, " C"]
    confirmed: Bool[np.ndarray, " C"]  # by one other view at least
    view_idx: Int64[np.ndarray, " C"]


def _gather(views: Sequence[DepthView], settings: DepthSettings, progress: Progress) -> _Candidates:
    """Lift the views' candidates, and compare them with other views if the settings ask for it."""
    counts = np.array([len(view) for view in views])
    neighbors = choose_neighbors(views, settings.num_neighbors, progress)
    factors = np.ones(len(views))
    if settings.synchronizes:
        factors = synchronize_scales(views, neighbors, progress)
    copies = [
        view.reduced and view.reduced._replace(factor=view.reduced.factor * factor)
        for view, factor in zip(views, factors.tolist(), strict=True)
    ]
    stop_of = np.cumsum(counts)
    candidates = _Candidates(
        np.empty((stop_of[-1], 3), np.float32),
        np.concatenate([view.rgb for view in views]),
        np.empty(stop_of[-1], np.float32),
        np.empty(stop_of[-1], np.uint8),
        np.zeros(stop_of[-1], np.bool_),
        np.repeat(np.arange(len(views)), counts),
    )

    def work(first: int, last: int) -> None:
        for i in range(first, last):
            view, own, factor = views[i], copies[i], float(factors[i])
            xyz, _, footprint, tier, confirmed, _ = (
                column[stop_of[i] - counts[i] : stop_of[i]] for column in candidates
            )
            xyz[:] = lift_pixels(view.pixel, view.z, view.camera, factor)
            # A pixel at depth z is z / focal wide.
            np.multiply(view.z, factor / view.camera.K[0, 0], out=footprint)
            tier[:] = SOUND
            seen_through: Bool[np.ndarray, " C"] | None = None
            if settings.compares_views and own is not None:
                others = [copy for j in neighbors[i] if j >= 0 and (copy := copies[j]) is not None]
                confirming, seen_through = find_support(xyz, own, others, settings)
                tier[confirming < settings.min_agreeing] = UNCONFIRMED
                confirmed[:] = confirming > 0
            tier[view.edge] = NEAR_EDGE  # the worst tier counts
            if seen_through is not None and not settings.see_through:
                tier[seen_through] = SEEN_THROUGH

    in_threads(work, len(views), VIEWS_PER_TASK, "compare views", progress)
    return candidates


def _mark_outside(
    candidates: _Candidates, center: Float64[np.ndarray, " 3"], within: Region | None
) -> None:
    """Mark candidates outside of a region of the scene."""
    if within is not None:
        candidates.tier[~within(candidates.xyz + center)] = OUTSIDE


def _check_agreement(candidates: _Candidates, num_views: int) -> None:
    """Raise ``SceneFormatError`` if the maps of three views or more contradict one another."""
    confirmed = int(np.count_nonzero(candidates.confirmed))
    contradicted = np.count_nonzero((candidates.tier == SEEN_THROUGH) & ~candidates.confirmed)
    shown = confirmed + int(contradicted)
    overlap = shown >= MIN_SHOWN * len(candidates.tier) or not confirmed
    if num_views < 3 or not overlap or confirmed >= MIN_AGREEMENT * max(shown, 1):
        return
    which = f"{confirmed / shown:.0%} of the pixels that others show" if shown else "no pixel"
    raise SceneFormatError(
        "depth maps that agree with each other at the scene's poses, as they are not aligned to "
        "points",
        found=f"maps that confirm the depth of {which}",
        fix="Check the poses, and whether the maps are in their unit (splatseed info SCENE compares"
        " the photographs), or pass `depth.min_agreeing=0` to use the maps as they are.",
    )


def _choose(
    candidates: _Candidates,
    originals: Float32[np.ndarray, "N 3"],
    num: int,
    settings: DepthSettings,
    rng: np.random.Generator,
) -> Int64[np.ndarray, " num"]:
    """Choose ``num`` candidates, ascending indices, away from the originals if spread."""
    usable = int(np.count_nonzero(candidates.tier < SEEN_THROUGH))
    if usable < num:
        more = [] if settings.see_through else ["`depth.see_through=True`"]
        more += ["a larger `depth.central_fraction`"] if settings.central_fraction < 1 else []
        inside = " in the region" if (candidates.tier == OUTSIDE).any() else ""
        seen = "" if settings.see_through else " that no other view sees through"
        allow = f", or allow more with {' or '.join(more)}" if more else ""
        raise PointCloudError(
            f"depth maps that can give {num:,} points",
            found=f"{usable:,}{seen}{inside}" if usable else f"none{inside}",
            fix=f"Ask for fewer{allow}.",
        )
    taken = np.zeros(len(candidates.tier), bool)
    for tier in range(SEEN_THROUGH):
        members, missing = candidates.tier == tier, num - int(np.count_nonzero(taken))
        if missing >= np.count_nonzero(members):
            taken |= members
        elif settings.spread:
            there = np.concatenate([originals, candidates.xyz[taken]])
            xyz, footprint = candidates.xyz, candidates.footprint
            return np.flatnonzero(
                taken | spread_evenly(xyz, footprint, members, there, missing, rng)
            )
        else:
            which = np.flatnonzero(members)
            taken[which[_even_shares(candidates.view_idx[which], missing, rng)]] = True
            break
    return np.flatnonzero(taken)


def _even_shares(
    view_idx: Int64[np.ndarray, " C"], num: int, rng: np.random.Generator
) -> Int64[np.ndarray, " num"]:
    """Choose ``num`` of C indices at random, in equal numbers from each view as far as they go."""
    order = rng.permutation(len(view_idx))
    order = order[np.argsort(view_idx[order], kind="stable")]
    counts = np.bincount(view_idx)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    # The first of each view, then the second of each view, and so on.
    return np.asarray(order[np.argsort(rank, kind="stable")[:num]])
