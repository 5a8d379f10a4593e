"""Depth-guided lifting, from the images of a scene to new points.

Notation: every image gives *candidates*; a candidate is *sound* if enough views confirm it, none
looks through it, and no depth discontinuity is near. Promise: exactly the number asked for, or one
error that says how many are possible. Sound candidates come first, then those that too few views
confirm, then those near discontinuities; none that a view looks through is used, unless that is
allowed. A note says how many of the less certain ones were needed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.depth.alignment import reject_outliers
from splatseed.depth.candidates import NEAR_EDGE, UNCONFIRMED, choose, gather
from splatseed.depth.settings import Settings
from splatseed.depth.views import DepthView, Reader
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.literal import agreeing
from splatseed.progress import Progress, in_threads, silent
from splatseed.scene import Image, Scene
from splatseed.views.visibility import find_visibility

OVERSAMPLING = 1.4
"""Candidates per new point, when views are compared or points spread."""
MAX_OVERSAMPLING = 16.0
"""Most candidates per new point; a round of reading multiplies them by up to ``MAX_GROWTH``."""
MAX_GROWTH = 8.0
SURPLUS = 1.25
"""Candidates are overdrawn by this factor, to save another round."""
NAMED = 3
"""Most images that a note names."""


class Lifted(NamedTuple):
    """New points, and notes for the user."""

    xyz: Float32[np.ndarray, "M 3"]
    """World positions, float32 [M, 3], image after image."""
    rgb: UInt8[np.ndarray, "M 3"]
    """Colours, uint8 [M, 3]."""
    notes: tuple[str, ...]
    """What was left out or replaced, one sentence each."""


def lift(
    scene: Scene,
    num: int,
    settings: Settings,
    rng: np.random.Generator,
    progress: Progress = silent,
) -> Lifted:
    """Lift ``num`` pixels of a scene's images into its world.

    Each image and its map are read once, and again only if too few of the candidates are sound.

    Args:
        scene: A scene with images in a folder, and depth maps.
        num: How many points.
        settings: The method's choices.
        rng: The source of all random numbers.
        progress: Called with the stage and the fraction done.

    Raises:
        SceneNotFoundError: There are no maps or no photographs, or a file is gone.
        SceneFormatError: A file is damaged or does not fit, or no map can be aligned.
        PointCloudError: The maps cannot give so many points.
    """
    scene, center = _centered(scene)
    images = _images_with_maps(scene, settings.hold_out)
    reader = _reader(scene, settings)
    factor = OVERSAMPLING if settings.compares_views or settings.spread else SURPLUS
    views = _read_all(reader, images, factor * num, rng, progress)
    notes = _missing_notes(scene, len(images), settings.hold_out)
    images, views, more = _leave_out(images, views, settings.max_residual_ratio)
    candidates = gather(views, settings, progress)
    while (
        candidates.num_sound < num
        and factor < MAX_OVERSAMPLING
        and not all(v.exhausted for v in views)
    ):
        # In proportion to what was sound, so that one more round mostly suffices.
        growth = SURPLUS * num / max(candidates.num_sound, 1)
        factor = min(factor * min(growth, MAX_GROWTH), MAX_OVERSAMPLING)
        views = _read_all(reader, images, factor * num, rng, progress)
        candidates = gather(views, settings, progress)
    points = scene.points.originals
    originals = np.asarray(points.xyz[points.finite])
    chosen = choose(candidates, originals, num, settings, rng, progress)
    notes = (*notes, *more, *_relaxed_notes(candidates.tier[chosen], settings))
    xyz = candidates.xyz[chosen]
    np.add(xyz, center, out=xyz, casting="same_kind")  # in float64, then rounded
    return Lifted(xyz, candidates.rgb[chosen], notes)


def _centered(scene: Scene) -> tuple[Scene, Float64[np.ndarray, " 3"]]:
    """The scene with the mean of its cameras moved to the origin, and that mean.

    Candidates are float32, which far from the origin (UTM coordinates) would be too coarse to
    compare.
    """
    if not scene.images:
        return scene, np.zeros(3)
    center = np.mean([image.camera.center for image in scene.images], axis=0)
    images = tuple(
        replace(image, translation=image.translation + image.camera.cam_from_world[:3, :3] @ center)
        for image in scene.images
    )
    xyz = (scene.points.xyz - center).astype(np.float32)
    points = scene.points.replace(xyz=xyz)
    return scene.replace(points=points, images=images, tracks=scene.tracks), center


def _images_with_maps(scene: Scene, hold_out: int) -> list[Image]:
    """The images to lift from, in the order of the scene."""
    depths = scene.depths
    used = {image.name for image in (scene.split(hold_out)[0] if hold_out else scene.images)}
    images = [
        im for im in scene.images if im.name in used and depths is not None and im.name in depths
    ]
    if not images:
        raise SceneNotFoundError(
            "a scene with depth maps of its images",
            found=f"{len(scene.images)} images, and maps of none of them",
            fix="Name the folder with the maps: --depth DIR.",
        )
    return images


def _reader(scene: Scene, settings: Settings) -> Reader:
    folder = scene.source.image_dir if scene.source else None
    if folder is None or scene.depths is None:
        raise SceneNotFoundError(
            "a folder with the scene's photographs, from which points take their colours",
            found="none",
            fix="Put them beside the model in a folder named images.",
        )
    return Reader(folder, scene.depths, find_visibility(scene), settings)


def _read_all(
    reader: Reader,
    images: Sequence[Image],
    num: float,
    rng: np.random.Generator,
    progress: Progress,
) -> list[DepthView]:
    """The views of all images, which share the number of candidates equally."""
    per_image = math.ceil(num / len(images))
    # One seed per image, drawn in order, so that threads do not matter.
    seeds = rng.integers(0, 1 << 63, len(images))
    views: list[DepthView | None] = [None] * len(images)

    def work(start: int, stop: int) -> None:
        for i in range(start, stop):
            views[i] = reader.read(images[i], per_image, np.random.default_rng(seeds[i]))

    in_threads(work, len(images), 1, "read images", progress)
    return [view for view in views if view is not None]


def _leave_out(
    images: Sequence[Image], views: Sequence[DepthView], max_ratio: float | None
) -> tuple[list[Image], list[DepthView], tuple[str, ...]]:
    """The images and views whose maps are aligned, and notes on the others."""
    alignments = reject_outliers(
        {image.name: view.alignment for image, view in zip(images, views, strict=True)}, max_ratio
    )
    reasons = {name: a.rejected for name, a in alignments.items() if a.rejected is not None}
    if len(reasons) == len(alignments):
        name, reason = next(iter(reasons.items()))
        raise SceneFormatError(
            "depth maps that fit the SfM points of their images",
            found=f"none among {len(images)}; {name}: {reason}",
            fix="Look at them with splatseed info SCENE --depth DIR; check --depth-kind and "
            "--depth-scale.",
        )
    if not reasons:
        return list(images), list(views), ()
    named = "; ".join(f"{name}: {reason}" for name, reason in list(reasons.items())[:NAMED])
    more = ", ..." if len(reasons) > NAMED else ""
    note = f"{len(reasons)} of {len(images)} depth maps are left out ({named}{more})."
    kept = [i for i, image in enumerate(images) if image.name not in reasons]
    return [images[i] for i in kept], [views[i] for i in kept], (note,)


def _missing_notes(scene: Scene, num_used: int, hold_out: int) -> tuple[str, ...]:
    expected = len(scene.split(hold_out)[0] if hold_out else scene.images)
    if num_used >= expected:
        return ()
    lacking = expected - num_used
    what = agreeing(lacking, "has no depth map and gives", "have no depth map and give")
    return (f"{lacking} of {expected} images {what} no points.",)


def _relaxed_notes(tier: UInt8[np.ndarray, " M"], settings: Settings) -> tuple[str, ...]:
    """A sentence for each requirement that was relaxed."""
    unconfirmed, edge = (int(np.count_nonzero(tier == t)) for t in (UNCONFIRMED, NEAR_EDGE))
    notes = []
    if unconfirmed:
        notes.append(
            f"{unconfirmed:,} of {len(tier):,} new points are confirmed by fewer than "
            f"{settings.min_agreeing} other views: no others were left."
        )
    if edge:
        notes.append(f"{edge:,} of {len(tier):,} new points lie near depth discontinuities.")
    return tuple(notes)
