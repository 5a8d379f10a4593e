"""The points that a run starts from.

Promise: points that are left out are reported; which ones are kept depends only on points and
cameras; the points have the attributes that the run uses, and no others.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.io.output.earlier import saw_all_photographs, was_upsampled
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.train.settings import AS_3DGS, TrainSettings
from splatseed.train.stereo_size import stereo_size
from splatseed.views.view import View

if TYPE_CHECKING:
    from splatseed.stereo.result import Stereo

SEEDS_SHARE: Mapping[str, float] = MappingProxyType({"default": 0.7, "mcmc": 0.7})
"""Most seeds as a fraction of the cap, for strategies that add Gaussians; others may use it all."""


def most_seeds(settings: TrainSettings, cap: int) -> int:
    """How many seeds a run begins with at most, if there may be ``cap`` Gaussians."""
    return max(2, round(SEEDS_SHARE.get(settings.densification, 1.0) * cap))


def seeded(
    scene: Scene,
    settings: TrainSettings,
    device: str,
    note: Callable[[str], None],
    progress: Progress,
) -> tuple[Scene, Stereo | None]:
    """The scene with the points that method ``auto`` makes, if the settings ask for them.

    Also returns the depth maps that it computed, if any: growth uses them too.

    Args:
        scene: A scene without points added by splatseed.
        settings: Their cap limits the points, and they say which photographs are held out.
        device: Where training renders; see ``stereo_size``.
        note: Called with what was made, and how to do without.
        progress: Called with the stage and the fraction done.

    Raises:
        SceneNotFoundError: Photographs are missing.
        SceneFormatError: One is damaged.
    """
    if saw_all_photographs(scene):
        note(
            "The seeds were made from all photographs, test views included, which may flatter the "
            "score: train the scene itself, or hold views out of them, as by --auto.hold-out 8."
        )
    if settings.seeding == "scene" or why_not_seeded(scene, settings):
        return scene, None
    from splatseed.seeding.photographs import Auto  # noqa: PLC0415  (loads with its use)
    from splatseed.seeding.upsampling import upsample  # noqa: PLC0415  (kernels load with use)

    results: list[Stereo] = []

    class Remembering(Auto):
        def find(self, *given: Any) -> Stereo:
            results.append(super().find(*given))
            return results[-1]

    start = time.perf_counter()
    size = stereo_size(scene.split(settings.test_every)[0], settings, device)
    cloud = upsample(
        scene,
        Remembering(hold_out=settings.test_every, max_size=size),
        budget=None if settings.cap is None else most_seeds(settings, settings.cap),
        progress=progress,
        note=note,
    )
    note(_made(scene, cloud, time.perf_counter() - start))
    return scene.replace(points=cloud), results[-1] if results else None


def why_not_seeded(scene: Scene, settings: TrainSettings) -> str:
    """Why a run begins with the scene's points even if ``auto`` is asked for; empty if not.

    Args:
        scene: The scene.
        settings: The run's.
    """
    if settings.strategy.endswith(AS_3DGS):
        return f"strategy {settings.strategy} begins with the scene's points as they are"
    if was_upsampled(scene):
        return "splatseed upsample made the points, and training begins with them as they are"
    return ""


def _made(scene: Scene, cloud: PointCloud, seconds: float) -> str:
    if not len(scene.points):
        return f"Seeds by method auto: {len(cloud):,} points, in {seconds:.0f} s."
    kept = cloud.num_original
    return (
        f"Seeds by method auto: {kept:,} points of the scene and {len(cloud) - kept:,} new ones, "
        f"in {seconds:.0f} s. --seeds scene begins with the scene's points as they are."
    )


def usable_seeds(
    points: PointCloud,
    settings: TrainSettings,
    note: Callable[[str], None],
    views: Sequence[View] = (),
) -> PointCloud:
    """The finite points that a run begins with, thinned if there are more than the cap.

    Points in crowded parts of the views are dropped first, and new points before originals. For a
    strategy that adds Gaussians, thinning leaves it the room for them (``SEEDS_SHARE``).

    Args:
        points: The scene's points.
        settings: Provide the cap, and say whether sizes and normals are used.
        note: Called with what was left out, and what was requested but unknown.
        views: The training views, for their cameras and sizes; when left out, crowding is measured
            in space.
    """
    finite = points.select(points.finite)
    if len(finite) < len(points):
        note(f"{len(points) - len(finite):,} points without finite coordinates were left out.")
    return _without_unused(_within_cap(finite, settings, note, views), settings, note)


def _within_cap(
    points: PointCloud,
    settings: TrainSettings,
    note: Callable[[str], None],
    views: Sequence[View],
) -> PointCloud:
    cap = settings.cap
    if cap is None or len(points) <= cap:
        return points
    from splatseed.seeding.budget import thin  # noqa: PLC0415  (kernels load with use)

    # Thinning takes the earlier of equals: originals first.
    points = points.select(np.argsort(points.source != ORIGINAL, kind="stable"))
    first, most = points.num_original, most_seeds(settings, cap)
    seeds = points.select(thin(points.xyz, views, most, first=first, priority=points.confidence))
    kept = f", {seeds.num_original:,} of them originals" if first else ""
    room = "" if most == cap else f"; strategy {settings.densification} adds the rest"
    note(
        f"{len(points):,} seeds were thinned to {most:,}{kept}: there may be {cap:,} Gaussians"
        f"{room}."
    )
    return seeds


def _without_unused(
    points: PointCloud, settings: TrainSettings, note: Callable[[str], None]
) -> PointCloud:
    """The points without the attributes that a run with these settings does not use."""
    used = {"sizes": settings.seed_sizes, "normals": settings.seed_normals}
    for name, asked in used.items():
        if asked and np.isnan(points.attributes.get(name, np.nan)).all():
            note(f"--seed-{name} has no effect: no seed has known {name}.")
    return points.replace(**dict.fromkeys(n for n in points.attributes if not used.get(n)))


def seeds_digest(seeds: PointCloud) -> str:
    """A fingerprint of positions, colours and attributes."""
    digest = hashlib.blake2b(seeds.xyz.tobytes(), digest_size=16)
    digest.update(seeds.rgb.tobytes())
    for name, values in seeds.attributes.items():
        digest.update(name.encode() + values.tobytes())
    return digest.hexdigest()
