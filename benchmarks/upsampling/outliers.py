"""Planted outliers: how many the isolation rule of the default profile finds, and what it costs.

Notation: the made room stands inside a background that thins out with distance; *planted* points
are uniform in the room's bounding box. Shares are of planted points caught, and of the room's and
the background's own points lost. Promise: the rule is the package's own (``sound_bases``), beside
the usual global filter: drop points whose mean distance to 16 neighbours exceeds the cloud's mean
by some standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from benchmarks.common.clouds import REAL_SCENES, load_cloud, room
from benchmarks.common.markdown import table

from splatseed import PointCloud
from splatseed.errors import SplatseedError
from splatseed.methods.neighbors import PreparedCloud, prepare, sound_bases
from splatseed.synthetic.surfaces import Sphere

__all__ = ["outlier_table"]

ROOM_POINTS = 20_000
BACKGROUND_POINTS = 4_000
BACKGROUND_RADII = (6.0, 9.0, 14.0, 20.0, 30.0)
"""Metres: shells around the room, each with as many points, so that the density falls outward."""
PLANTED_SHARE = 0.02
NEIGHBORS = 16
SEEDS = 3

Keep = Callable[[PreparedCloud], np.ndarray]


@dataclass(frozen=True, eq=False)
class Planted:
    """A cloud with labelled points: the name of each label and the points' labels [N]."""

    cloud: PointCloud
    names: tuple[str, ...]
    labels: np.ndarray

    def lost(self, keep: Keep) -> list[float]:
        """Share of each label's points that a rule drops."""
        prepared = prepare(self.cloud)
        kept = keep(prepared)
        # Nothing coincides or is infinite here, so ranks are the points' own indices.
        labels = self.labels[prepared.rank]
        return [float(1.0 - kept[labels == i].mean()) for i in range(len(self.names))]


def isolation(k: int) -> Keep:
    """The package's rule, seen through k neighbours."""
    return lambda cloud: sound_bases(cloud, cloud.neighbors(k)) > 0


def global_filter(deviations: float) -> Keep:
    """Mean distance to 16 neighbours within so many standard deviations of the cloud's mean."""

    def keep(cloud: PreparedCloud) -> np.ndarray:
        mean_distance = cloud.neighbors(NEIGHBORS).distance.mean(axis=1)
        return mean_distance <= mean_distance.mean() + deviations * mean_distance.std()

    return keep


RULES: dict[str, Keep] = {
    "isolated, k = 8 (linear, triangle)": isolation(8),
    "isolated, k = 16 (mls)": isolation(16),
    "isolated, k = 25 (spline, voronoi)": isolation(25),
    "global filter, 1 deviation": global_filter(1.0),
    "global filter, 2 deviations": global_filter(2.0),
}


def planted_room(seed: int) -> Planted:
    """The room, a far background, and planted points."""
    rng = np.random.default_rng(seed)
    near = room(ROOM_POINTS, seed).xyz
    per_shell = BACKGROUND_POINTS // len(BACKGROUND_RADII)
    shells = [Sphere(np.zeros(3), radius).sample(per_shell, rng) for radius in BACKGROUND_RADII]
    return _plant([near, np.concatenate(shells)], ("room", "background"), near, rng)


def _plant(
    parts: list[np.ndarray], names: tuple[str, ...], region: np.ndarray, rng: np.random.Generator
) -> Planted:
    """Add points that are uniform in the bounding box of ``region``, as the last label."""
    num = round(PLANTED_SHARE * sum(map(len, parts)))
    planted = rng.uniform(region.min(axis=0), region.max(axis=0), (num, 3))
    every = [*parts, planted]
    xyz = np.concatenate(every).astype(np.float32)
    labels = np.repeat(np.arange(len(every)), [len(part) for part in every])
    return Planted(PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8)), (*names, "planted"), labels)


def outlier_table() -> str:
    """Caught and lost by each rule, means over the seeds; real captures where there are any."""
    header = ["rule", "planted caught", "room lost", "background lost", *_real_header()]
    rows = [[name, *_room_cells(keep), *_real_cells(keep)] for name, keep in RULES.items()]
    return table(header, rows)


def _room_cells(keep: Keep) -> list[str]:
    lost = np.mean([planted_room(seed).lost(keep) for seed in range(SEEDS)], axis=0)
    near, far, caught = lost
    return [f"{100 * share:.1f}%" for share in (caught, near, far)]


def _real_clouds() -> dict[str, PointCloud]:
    try:
        return {name: load_cloud(name) for name in REAL_SCENES}
    except SplatseedError:  # no captures on this machine: the table has fewer columns
        return {}


def _real_header() -> list[str]:
    return [f"{name} lost" for name in _real_clouds()]


def _real_cells(keep: Keep) -> list[str]:
    """Share of a real cloud's points that a rule drops; how many of them are bad is unknown."""
    return [f"{100 * (1.0 - keep(prepare(c)).mean()):.1f}%" for c in _real_clouds().values()]
