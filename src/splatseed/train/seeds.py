"""The points that a run starts from.

Promise: points that are left out are reported; which ones are kept depends on the seed alone; of what
is known of them they have what the run uses, and nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np

from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.train.settings import TrainSettings

__all__ = ["seeds_digest", "usable_seeds"]


def usable_seeds(
    points: PointCloud, settings: TrainSettings, note: Callable[[str], None]
) -> PointCloud:
    """The finite points, thinned out at random if there are more than the cap, for a run to begin with.

    Originals stay as long as they fit: they lie where something was seen.

    Args:
        points: Those of the scene.
        settings: Whose cap and seed count, and which say if sizes and normals are used.
        note: Told what was left out, and what is asked for and not known.
    """
    seeds = _without_unused(points, settings, note).select(points.finite)
    if len(seeds) < len(points):
        note(f"{len(points) - len(seeds):,} points without finite coordinates were left out.")
    if settings.cap is None or len(seeds) <= settings.cap:
        return seeds
    kept = min(seeds.num_original, settings.cap)
    note(
        f"{len(seeds):,} seeds were thinned out at random to --cap-max {settings.cap:,}, "
        f"{kept:,} of them originals."
        + (" They leave densification no room." if settings.densification == "default" else "")
    )
    rng = np.random.default_rng([settings.seed, settings.cap])
    rank = rng.permutation(len(seeds))
    rank[seeds.source == ORIGINAL] -= len(seeds)  # ahead of all others
    return seeds.select(np.sort(np.argsort(rank)[: settings.cap]))


def _without_unused(
    points: PointCloud, settings: TrainSettings, note: Callable[[str], None]
) -> PointCloud:
    """The points without the attributes that a run with these settings does not look at."""
    used = {"sizes": settings.seed_sizes, "normals": settings.seed_normals}
    for name, asked in used.items():
        if asked and np.isnan(points.attributes.get(name, np.nan)).all():
            note(f"--seed-{name} changes nothing: the {name} of no seed are known.")
    return points.replace(**dict.fromkeys(n for n in points.attributes if not used.get(n)))


def seeds_digest(seeds: PointCloud) -> str:
    """A fingerprint of positions, colours and attributes."""
    digest = hashlib.blake2b(seeds.xyz.tobytes(), digest_size=16)
    digest.update(seeds.rgb.tobytes())
    for name, values in seeds.attributes.items():
        digest.update(name.encode() + values.tobytes())
    return digest.hexdigest()
