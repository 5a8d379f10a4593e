"""The points that a run starts from.

Promise: points that are left out are reported; which ones are kept depends on the seed alone.
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
    """The finite points, thinned out at random if there are more than the cap.

    Originals stay as long as they fit: they lie where something was seen.

    Args:
        points: Those of the scene.
        settings: Whose cap and seed count.
        note: Told what was left out.
    """
    seeds = points.select(points.finite)
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


def seeds_digest(seeds: PointCloud) -> str:
    """A fingerprint of positions and colours."""
    digest = hashlib.blake2b(seeds.xyz.tobytes(), digest_size=16)
    digest.update(seeds.rgb.tobytes())
    return digest.hexdigest()
