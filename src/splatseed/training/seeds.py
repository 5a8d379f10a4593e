"""The points that a run starts from: made by ``auto``, thinned to the budget, fingerprinted.

Promise: points that are left out are reported; test views have no part; the bytes depend neither on
threads nor on the clock. No PyTorch.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from splatseed.depth.stereo.maps import StereoResult
from splatseed.findings import Finding
from splatseed.io.seeds import saw_all_photographs, was_upsampled
from splatseed.methods import source_code
from splatseed.photos.view import View
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Note, Progress
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.seeding.advice import AS_IT_IS, MIN_ROOM, advice_for
from splatseed.seeding.diagnostics import empty_regions
from splatseed.seeding.photo_methods import Auto
from splatseed.seeding.thinning import thin
from splatseed.seeding.upsampling import upsample_checked
from splatseed.training.depths import stereo_size
from splatseed.training.settings import BUDGET, TrainSettings


def seeded(
    scene: Scene,
    settings: TrainSettings,
    device: str,
    note: Note,
    progress: Progress,
    *,
    triangulated: bool = False,
) -> tuple[Scene, StereoResult | None]:
    """Add the points of method ``auto`` to a scene, if the settings or the advice say so.

    The settings' budget limits the points; a run that continues from Gaussians needs none. Also
    return the depth maps that ``auto`` made, for ``grow``; None if it made none. Where the points
    were ``triangulated`` while poses were refined, ``auto`` adds to them: on held-out training
    views of two phones' walks it gained 0.34 and 0.96 dB under strategy ``grow``
    (docs/known_poses.md), as bare walls have no features.
    """
    if settings.start is not None:
        return scene, None
    if saw_all_photographs(scene) and scene.split(settings.test_every)[1]:
        text = "The seeds were made from all photographs, test views included, which may flatter "
        text += "the score: train the scene itself, or seed without test views: "
        note(Finding("seeds-of-test-views", f"{text}`auto.test_every=8`."))
    if settings.seeding == "scene" or no_seeding_reason(scene, settings):
        return scene, None
    why = ""
    if settings.seeding == "advised" and settings.region is None and not triangulated:
        limit = settings.max_seeds(settings.cap or BUDGET)
        why_not, room = settings.traits.why_no_seeds, len(scene.points) * MIN_ROOM <= limit
        regions = empty_regions(scene, progress) if why_not and room else None
        empty = None if regions is None else regions.mean
        advice = advice_for(scene, limit, why_no_seeds=why_not, empty=empty)
        if advice.method == AS_IT_IS:
            text = f"Seeds: {advice.sentence}. {advice.reasons[-1]}"
            note(Finding("seeds", text, "info"))
            return scene, None
        why = f" {advice.reasons[-1]}" if len(scene.points) else ""
    start = time.perf_counter()
    size = stereo_size(scene.split(settings.test_every)[0], settings, device)
    stereo: list[StereoResult] = []
    cloud = upsample_checked(
        scene,
        Auto(test_every=settings.test_every, max_size=size, dense=False),
        budget=None if settings.cap is None else settings.max_seeds(settings.cap),
        region=settings.region,
        progress=progress,
        note=note,
        on_stereo=stereo.append,
    )
    made, alternative, kept = f"{len(cloud):,} points", "", cloud.num_original
    if len(scene.points):
        made = f"{kept:,} points of the scene and {len(cloud) - kept:,} new ones"
        alternative = "`seeding='scene'` starts from the scene's points alone."
    guessed = np.count_nonzero(cloud.source == source_code("cover"))
    made = f"{made}, {guessed:,} of them guessed from neighbours"
    text = f"Seeds by method auto: {made}, in {time.perf_counter() - start:.0f} s.{why}"
    note(Finding("seeds", text, "info", fix=alternative))
    return scene.replace(points=cloud), stereo[0] if stereo else None


def no_seeding_reason(scene: Scene, settings: TrainSettings) -> str:
    """Explain why a run starts from the scene's points even with seeding ``auto``; else empty."""
    if settings.as_3dgs:
        return f"strategy {settings.strategy} starts from the scene's points as they are"
    if was_upsampled(scene):
        return "its points are upsampled already, and training starts from them as they are"
    return ""


def usable_seeds(
    points: PointCloud, settings: TrainSettings, note: Note, views: Sequence[View] = ()
) -> PointCloud:
    """Select the finite points, thin them to the budget, and drop attributes that are not used.

    Points in crowded parts of the training views (without views, of space) go first, and new points
    before originals; of originals alone every n-th is kept. Strategies with a ``seed_share`` below
    1 are left room for Gaussians that they add (``TrainSettings.max_seeds``).
    """
    seeds, cap = points.select(points.finite), settings.cap
    if len(seeds) < len(points):
        text = f"{len(points) - len(seeds):,} points without finite coordinates were left out."
        note(Finding("non-finite-points", text))
    if cap is not None and len(seeds) > cap:
        # Thinning takes the earlier of equals: originals first.
        crowd = seeds.select(np.argsort(seeds.source != ORIGINAL, kind="stable"))
        first, limit = crowd.num_original, settings.max_seeds(cap)
        seeds = crowd.select(thin(crowd.xyz, views, limit, first=first, priority=crowd.confidence))
        kept = f", {seeds.num_original:,} of them originals" if first else ""
        room = "" if limit == cap else f"; strategy {settings.traits.name} adds the rest"
        text = f"{len(crowd):,} seeds were thinned to {limit:,}{kept}: the limit is {cap:,} "
        note(Finding("thinned-seeds", f"{text}Gaussians{room}.", "info"))
    used = {"sizes": settings.seed_sizes, "normals": settings.seed_normals}
    for name, is_used in used.items():
        if is_used and np.isnan(seeds.attributes.get(name, np.nan)).all():
            text = f"seed_{name} has no effect: no seed has known {name}."
            note(Finding("unused-setting", text))
    return seeds.replace(**dict.fromkeys(n for n in seeds.attributes if not used.get(n)))


def seeds_facts(seeds: PointCloud) -> dict[str, Any]:
    """Return what a run's config records of its seeds."""
    return {"count": len(seeds), "digest": seeds_digest(seeds)}


def seeds_digest(seeds: PointCloud) -> str:
    """Return a fingerprint of positions, colours and attributes."""
    own = (name.encode() + values.tobytes() for name, values in seeds.attributes.items())
    return fingerprint(seeds.xyz.tobytes(), seeds.rgb.tobytes(), *own)
