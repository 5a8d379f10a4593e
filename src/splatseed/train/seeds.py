"""The points that a run starts from, and its first Gaussians.

Notation: N points; a *near depth* is the smallest depth at which a training view sees a point, the
unit of its Gaussian's size and learning rate. A length divided by it is an angle, so a rate or size
in near depths looks the same in the photographs wherever a Gaussian is: in front of closely spaced
cameras, on a table between them, or far behind both. 3DGS uses the cameras' extent for all.
Promise: points that are left out are reported; which ones are kept depends only on points and
cameras; the same bytes whatever the number of threads. No PyTorch, so that the same start can be
written for other trainers: a run begins with exactly what is written.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32

from splatseed.io.seeds import saw_all_photographs, was_upsampled
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress
from splatseed.scene import Scene
from splatseed.splat.gaussians import (
    Gaussians,
    fit_harmonics,
    initial_gaussians,
    stray_views,
    training_frame,
)
from splatseed.train.depths import stereo_size
from splatseed.train.settings import AS_3DGS, TrainSettings
from splatseed.views.view import View

if TYPE_CHECKING:
    from splatseed.depth.stereo.maps import StereoResult

SEEDS_SHARE: Mapping[str, float] = MappingProxyType({"default": 0.7, "mcmc": 0.7})
"""Most seeds as a fraction of the cap, for strategies that add Gaussians; others may use it all."""
MOST_PROJECTIONS = 20_000_000
"""Limit on points times views: beyond it, an even subset of the views is used."""
LEAST_VIEWS = 64
"""But never fewer views than this."""
MARGIN = 0.1
"""A point outside the photograph by up to this fraction of its size counts as seen: a large
Gaussian there reaches in."""
NEAREST = 0.01
"""The rasteriser's near plane: nothing nearer is drawn."""


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
    from splatseed.seeding.upsampling import upsample_with_stereo  # noqa: PLC0415  (kernels load with use)

    start = time.perf_counter()
    size = stereo_size(scene.split(settings.test_every)[0], settings, device)
    cloud, stereo = upsample_with_stereo(
        scene,
        Auto(hold_out=settings.test_every, max_size=size),
        None if settings.cap is None else most_seeds(settings, settings.cap),
        progress=progress,
        note=note,
    )
    seconds, kept = time.perf_counter() - start, cloud.num_original
    if len(scene.points):
        made = (
            f"{kept:,} points of the scene and {len(cloud) - kept:,} new ones, in {seconds:.0f} s"
        )
        note(f"Seeds by method auto: {made}. --seeds scene begins with the scene's points alone.")
    else:
        note(f"Seeds by method auto: {len(cloud):,} points, in {seconds:.0f} s.")
    return scene.replace(points=cloud), stereo


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
    seeds = points.select(points.finite)
    if len(seeds) < len(points):
        note(f"{len(points) - len(seeds):,} points without finite coordinates were left out.")
    if settings.cap is not None and len(seeds) > settings.cap:
        seeds = _thinned(seeds, settings, settings.cap, note, views)
    used = {"sizes": settings.seed_sizes, "normals": settings.seed_normals}
    for name, asked in used.items():
        if asked and np.isnan(seeds.attributes.get(name, np.nan)).all():
            note(f"seed_{name} has no effect: no seed has known {name}.")
    return seeds.replace(**dict.fromkeys(n for n in seeds.attributes if not used.get(n)))


def _thinned(
    points: PointCloud,
    settings: TrainSettings,
    cap: int,
    note: Callable[[str], None],
    views: Sequence[View],
) -> PointCloud:
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


def seeds_digest(seeds: PointCloud) -> str:
    """A fingerprint of positions, colours and attributes."""
    digest = hashlib.blake2b(seeds.xyz.tobytes(), digest_size=16)
    digest.update(seeds.rgb.tobytes())
    for name, values in seeds.attributes.items():
        digest.update(name.encode() + values.tobytes())
    return digest.hexdigest()


def first_gaussians(
    seeds: PointCloud, views: Sequence[View], settings: TrainSettings
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """One Gaussian per seed, and its near depth [N].

    Args:
        seeds: Finite points, in the training frame.
        views: The training views, likewise.
        settings: Their schedule gives sizes and opacities; they also say what is fitted.

    Raises:
        PointCloudError: Fewer than two distinct points.
    """
    lengths, schedule = near_depths(seeds.xyz, views), settings.schedule
    harmonics = None
    if settings.seed_colors:
        harmonics = fit_harmonics(seeds, views)
    gaussians = initial_gaussians(
        seeds,
        sh_degree=settings.sh_degree,
        opacity=schedule.opacity,
        scale_factor=schedule.scale_factor,
        largest=schedule.largest * lengths,
        flatness=schedule.flatness,
        harmonics=harmonics,
    )
    return gaussians, lengths


def gaussians_of_scene(
    cloud: PointCloud, views: Sequence[View], settings: TrainSettings
) -> Gaussians:
    """The initial Gaussians of training from a cloud, in the scene's world.

    Args:
        cloud: Seeds in the world; those without finite coordinates are left out.
        views: Photographs with their cameras.
        settings: As for ``first_gaussians``.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    frame, strays = training_frame(views), stray_views(views)
    near = [frame.view(view) for view in views if view.name not in strays]
    seeds = frame.cloud_from_world(cloud.select(cloud.finite))
    return frame.gaussians_to_world(first_gaussians(seeds, near, settings)[0])


def near_depths(xyz: Float[np.ndarray, "N 3"], views: Sequence[View]) -> Float32[np.ndarray, " N"]:
    """The smallest depth of each point among the views that see it; the median if none does.

    Args:
        xyz: Points.
        views: The training views; see ``MOST_PROJECTIONS``.
    """
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
    return np.asarray(np.maximum(nearest, NEAREST), np.float32)


def _seen_depths(
    columns: Float[np.ndarray, "3 N"], view: View
) -> tuple[Float[np.ndarray, " N"], Bool[np.ndarray, " N"]]:
    """Depths in a view, and whether points are in front of it and roughly within its frame."""
    # Sums are written out: BLAS may add in another order when it has more threads.
    x, y, depths = (
        row[0] * columns[0] + row[1] * columns[1] + row[2] * columns[2] + row[3]
        for row in view.cam_from_world[:3]
    )
    seen = depths > NEAREST
    for across, focal, center, size in (
        (x, view.K[0, 0], view.K[0, 2], view.width),
        (y, view.K[1, 1], view.K[1, 2], view.height),
    ):
        # Multiplied by the depth, so that nothing is divided by zero.
        seen &= focal * across >= (-MARGIN * size - center) * depths
        seen &= focal * across <= ((1 + MARGIN) * size - center) * depths
    return depths, seen
