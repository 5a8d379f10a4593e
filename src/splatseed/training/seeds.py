"""What a run starts from: its points, its first Gaussians, and the depths that ``grow`` uses.

Notation: N points; a *near depth* is the smallest depth at which a training view sees a point, the
unit of its Gaussian's size and learning rate. A length divided by it is an angle, so a rate or size
in near depths looks the same in the photographs wherever a Gaussian is: in front of closely spaced
cameras, on a table between them, or far behind both. 3DGS uses the cameras' extent for all.
Promise: points that are left out are reported; the same points, cameras and settings give the same
bytes, whatever the number of threads and the clock; test views have no part. No PyTorch, so that
the same start can be written for other trainers: a run begins with exactly what is written.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float32

from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.seeds import saw_all_photographs, was_upsampled
from splatseed.io.staging import atomic_file
from splatseed.photos.view import NEAR_PLANE, View
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Image, Scene
from splatseed.seeding.advice import AS_IT_IS, advice_for
from splatseed.splat.gaussians import (
    Gaussians,
    TrainingFrame,
    fit_harmonics,
    initial_gaussians,
    training_frame,
)
from splatseed.training.settings import AS_3DGS, BUDGET, TrainSettings

SEEDS_SHARE = {"default": 0.7, "mcmc": 0.7}
"""Most seeds as a fraction of the cap, for strategies that add Gaussians; others may use it all."""
MOST_PROJECTIONS = 20_000_000
"""Limit on points times views: beyond it, an even subset of the views is used."""
LEAST_VIEWS = 64
"""But never fewer views than this."""
MARGIN = 0.1
"""A point outside the photograph by up to this fraction of its size counts as seen: a large
Gaussian there reaches in."""
PER_RENDERED = {"cpu": 0.06, "cuda": 0.01}
"""Most pixels compared per pixel rendered in training, by the device that renders: on the CPU,
stereo then takes at most a tenth of training's seconds (bonsai and treehill at 1,500 steps: 7%).
Comparing always runs on the CPU, some 0.7 million pixels a second and core. The number for a GPU is
an estimate: 150 million pixels rendered a second, beside 8 cores; benchmarks/gpu measures both."""
LEAST_SIZE = {"cpu": 64, "cuda": 200}
"""Smallest size that is returned, in pixels; on the CPU it is not below the size that is trained
either, which on a GPU is the photographs' own."""
LEAST_COMPARED = 48
"""Growth has this many views compared, if there are as many, however short the run: fewer may not
overlap."""

SWEEPS = 2
"""PatchMatch iterations for growth. Two more take 1.6 times as long, know the depth of 1% more of
the pixels (bonsai, treehill, fox), and gain nothing beyond noise."""


def most_seeds(settings: TrainSettings, cap: int) -> int:
    """How many seeds a run begins with at most, if there may be ``cap`` Gaussians."""
    return max(2, round(SEEDS_SHARE.get(settings.densification, 1.0) * cap))


def seeded(
    scene: Scene,
    settings: TrainSettings,
    device: str,
    note: Callable[[str], None],
    progress: Progress,
) -> tuple[Scene, StereoResult | None]:
    """The scene with the points that method ``auto`` makes, if the settings or the advice say so.

    Also returns the stereo result behind them, if any: growth uses its depth maps too. The
    settings' cap limits the points; ``note`` is called with what was made, and how to do without.
    """
    if saw_all_photographs(scene):
        note(
            "The seeds were made from all photographs, test views included, which may flatter the "
            "score: train the scene itself, or seed without test views: `auto.test_every=8`."
        )
    if settings.seeding == "scene" or why_not_seeded(scene, settings):
        return scene, None
    if settings.seeding == "advised":
        most = most_seeds(settings, settings.cap or BUDGET)
        advice = advice_for(scene, most, strategy=settings.densification)
        if advice.method == AS_IT_IS:
            note(f"Seeds: {advice.sentence}. {advice.reasons[-1]}")
            return scene, None
    from splatseed.seeding.photo_methods import Auto  # noqa: PLC0415  (loads with its use)
    from splatseed.seeding.upsampling import upsample  # noqa: PLC0415  (kernels load with use)

    start = time.perf_counter()
    size = stereo_size(scene.split(settings.test_every)[0], settings, device)
    stereo: list[StereoResult] = []
    cloud = upsample(
        scene,
        Auto(test_every=settings.test_every, max_size=size),
        budget=None if settings.cap is None else most_seeds(settings, settings.cap),
        progress=progress,
        note=note,
        on_stereo=stereo.append,
    )
    made, without, kept = f"{len(cloud):,} points", "", cloud.num_original
    if len(scene.points):
        made = f"{kept:,} points of the scene and {len(cloud) - kept:,} new ones"
        without = " `seeding='scene'` starts from the scene's points alone."
    note(f"Seeds by method auto: {made}, in {time.perf_counter() - start:.0f} s.{without}")
    return scene.replace(points=cloud), stereo[0] if stereo else None


def why_not_seeded(scene: Scene, settings: TrainSettings) -> str:
    """Why a run begins with the scene's points even if ``auto`` is asked for; empty if not."""
    if settings.strategy.endswith(AS_3DGS):
        return f"strategy {settings.strategy} starts from the scene's points as they are"
    if was_upsampled(scene):
        return "its points are upsampled already, and training starts from them as they are"
    return ""


def usable_seeds(
    points: PointCloud,
    settings: TrainSettings,
    note: Callable[[str], None],
    views: Sequence[View] = (),
) -> PointCloud:
    """The finite points that a run begins with, thinned if there are more than the cap.

    Points in crowded parts of the training views (without these, of space) are dropped first, and
    new points before originals; of originals alone every n-th is kept. A strategy that adds
    Gaussians is left room for them (``SEEDS_SHARE``). ``note`` is told what was left out, and what
    was asked for but unknown.
    """
    seeds, cap = points.select(points.finite), settings.cap
    if len(seeds) < len(points):
        note(f"{len(points) - len(seeds):,} points without finite coordinates were left out.")
    if cap is not None and len(seeds) > cap:
        from splatseed.seeding.budget import thin  # noqa: PLC0415  (kernels load with use)

        # Thinning takes the earlier of equals: originals first.
        crowd = seeds.select(np.argsort(seeds.source != ORIGINAL, kind="stable"))
        first, most = crowd.num_original, most_seeds(settings, cap)
        seeds = crowd.select(thin(crowd.xyz, views, most, first=first, priority=crowd.confidence))
        kept = f", {seeds.num_original:,} of them originals" if first else ""
        room = "" if most == cap else f"; strategy {settings.densification} adds the rest"
        note(
            f"{len(crowd):,} seeds were thinned to {most:,}{kept}: the limit is {cap:,} Gaussians"
            f"{room}."
        )
    used = {"sizes": settings.seed_sizes, "normals": settings.seed_normals}
    for name, asked in used.items():
        if asked and np.isnan(seeds.attributes.get(name, np.nan)).all():
            note(f"seed_{name} has no effect: no seed has known {name}.")
    return seeds.replace(**dict.fromkeys(n for n in seeds.attributes if not used.get(n)))


def seeds_facts(seeds: PointCloud) -> dict[str, Any]:
    """What a run's config says of its seeds."""
    return {"count": len(seeds), "digest": seeds_digest(seeds)}


def seeds_digest(seeds: PointCloud) -> str:
    """A fingerprint of positions, colours and attributes."""
    own = (name.encode() + values.tobytes() for name, values in seeds.attributes.items())
    return fingerprint(seeds.xyz.tobytes(), seeds.rgb.tobytes(), *own)


def first_gaussians(
    seeds: PointCloud, views: Sequence[View], frame: TrainingFrame, settings: TrainSettings
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """One Gaussian per seed, in the training frame, and their near depths [N].

    Seeds, finite, and training views are in the world; stray cameras have no part.
    """
    seeds = frame.cloud_from_world(seeds)
    views = [frame.view(view) for view in views if view.name not in frame.strays]
    lengths, schedule = near_depths(seeds.xyz, views), settings.schedule
    gaussians = initial_gaussians(
        seeds,
        sh_degree=settings.sh_degree,
        opacity=schedule.opacity,
        scale_factor=schedule.scale_factor,
        largest=schedule.largest * lengths,
        flatness=schedule.flatness,
        harmonics=fit_harmonics(seeds, views) if settings.seed_colors else None,
    )
    return gaussians, lengths


def gaussians_of_scene(
    cloud: PointCloud, views: Sequence[View], settings: TrainSettings
) -> Gaussians:
    """The initial Gaussians of training from a cloud's finite points, both in the scene's world.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    seeds = cloud.select(cloud.finite)
    frame = training_frame(views, seeds.references.xyz)
    gaussians, _ = first_gaussians(seeds, views, frame, settings)
    return frame.gaussians_to_world(gaussians)


def near_depths(xyz: Float[np.ndarray, "N 3"], views: Sequence[View]) -> Float32[np.ndarray, " N"]:
    """The smallest depth of each point among the views that see it; the median if none does."""
    nearest = np.full(len(xyz), np.inf)
    columns = np.ascontiguousarray(xyz.T, np.float64)
    # Evenly spaced views, the first and the last among them.
    asked = max(LEAST_VIEWS, MOST_PROJECTIONS // max(1, len(xyz)))
    for i in np.unique(np.linspace(0, len(views) - 1, min(asked, len(views))).round().astype(int)):
        depths, seen = _seen_depths(columns, views[i])
        np.minimum(nearest, np.where(seen, depths, np.inf), out=nearest)
    known = np.isfinite(nearest)
    # A point that no view sees gets no gradient; any positive length will do.
    nearest[~known] = np.median(nearest[known]) if known.any() else 1.0
    least = min((view.near for view in views), default=NEAR_PLANE)
    return np.asarray(np.maximum(nearest, least), np.float32)


def _seen_depths(
    columns: Float[np.ndarray, "3 N"], view: View
) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Depths in a view, and whether points are in front of it and roughly within its frame."""
    # Sums are written out: BLAS may add in another order when it has more threads.
    x, y, depths = (
        row[0] * columns[0] + row[1] * columns[1] + row[2] * columns[2] + row[3]
        for row in view.cam_from_world[:3]
    )
    seen = depths > view.near  # nothing nearer is drawn
    for across, focal, center, size in (
        (x, view.K[0, 0], view.K[0, 2], view.width),
        (y, view.K[1, 1], view.K[1, 2], view.height),
    ):
        # Multiplied by the depth, so that nothing is divided by zero.
        seen &= focal * across >= (-MARGIN * size - center) * depths
        seen &= focal * across <= ((1 + MARGIN) * size - center) * depths
    return depths, seen


DepthMaps = dict[str, Float32[np.ndarray, "h w"]]
"""Planar depths by the names of their views."""


def stereo_size(images: Sequence[Image], settings: TrainSettings, device: str) -> int:
    """Most pixels a side at which training photographs are compared, for a run of this length.

    ``StereoSettings``' own where training on ``device``, cpu or cuda, takes much longer than
    comparing, otherwise fewer.
    """
    full = StereoSettings().max_size
    if not images:
        return full
    longest = max(max(image.camera.width, image.camera.height) for image in images)
    pixels = sum(image.camera.width * image.camera.height for image in images)
    most = min(full, longest)
    compared = pixels * (most / longest) ** 2
    rendered = settings.max_steps * pixels / len(images) / settings.factor**2
    # Pixels go with the square of the size.
    affordable = int(most * math.sqrt(PER_RENDERED[device] * rendered / compared))
    least = max(LEAST_SIZE[device], longest // settings.factor if device == "cpu" else 0)
    return min(full, max(least, affordable))


def compared_images(
    images: Sequence[Image], settings: TrainSettings, device: str
) -> Sequence[Image]:
    """The training photographs that growth has compared: all, or as many as a short run affords.

    ``images`` are in the order of their names; evenly spaced ones are chosen.
    """
    size = stereo_size(images, settings, device)
    # In pixels of the photographs, at the size that is compared and at the one that is trained.
    each = [size / max(image.camera.width, image.camera.height) for image in images]
    scale = min(1.0, float(np.median(each))) if each else 1.0
    affordable = PER_RENDERED[device] * settings.max_steps / (scale * settings.factor) ** 2
    count = min(len(images), max(LEAST_COMPARED, int(affordable)))
    places = np.linspace(0, len(images) - 1, count).round().astype(int)
    return [images[i] for i in places]


def known_depths(
    scene: Scene,
    scale: float,
    settings: TrainSettings,
    device: str,
    *,
    stereo: StereoResult | None = None,
    kept: Path | None = None,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> tuple[DepthMaps, float]:
    """Depth maps of the training views, in training units, ``scale`` per unit of the world.

    They are those of ``compared_images``, and 0 where other views do not confirm any; none are made
    if the settings do not use them, or seeding has made ``stereo``. ``kept`` is a file with the
    maps of the same photographs and seed, or a path at which to keep them for the next run. Also
    returns the seconds that it took to find them, here or in the run that kept them.
    """
    images = scene.split(settings.test_every)[0]
    wanted = settings.densification == "grow" and settings.placing == "stereo"
    if not wanted or len(images) < 2:
        return {}, 0.0
    found = _read(kept)
    if found is None:
        start = time.perf_counter()
        if stereo:
            maps = tuple(stereo.map(i) for i in range(len(stereo.views)))
        else:
            compared = scene.replace(images=compared_images(images, settings, device))
            size = stereo_size(images, settings, device)
            from splatseed.depth.stereo import stereo_depths  # noqa: PLC0415  (loads Numba)

            maps = stereo_depths(
                compared, seed=settings.seed, progress=progress, max_size=size, sweeps=SWEEPS
            )
        found = {each.name: each.depth for each in maps}, time.perf_counter() - start
        if kept:
            arrays: dict[str, Any] = {f"depth_{i}": each.depth for i, each in enumerate(maps)}
            names = np.array([each.name for each in maps], dtype=np.str_)
            with atomic_file(kept) as partial, partial.open("wb") as file:
                np.savez(file, names=names, seconds=np.float64(found[1]), **arrays)
    known, seconds = found
    share = np.mean([np.isfinite(depth).mean() for depth in known.values()])
    took = "" if stereo else f" ({seconds:.0f} s)"
    note(
        f"Stereo found the depth of {share:.0%} of the pixels{took}: strategy grow puts most of "
        'what it adds there. placing = "none" only splits.'
    )
    # Stereo's depths are in world units; unknown ones, NaN, become 0.
    return {
        name: np.nan_to_num(depth * scale)
        for name, depth in known.items()
        if np.isfinite(depth).any()
    }, seconds


def _read(kept: Path | None) -> tuple[DepthMaps, float] | None:
    """The maps that ``known_depths`` kept; None without a readable file."""
    if kept is None:
        return None
    try:
        with np.load(kept, allow_pickle=False) as file:
            maps = {str(name): file[f"depth_{i}"] for i, name in enumerate(file["names"])}
            return maps, float(file["seconds"])
    except ARCHIVE_FAILURES:
        return None
