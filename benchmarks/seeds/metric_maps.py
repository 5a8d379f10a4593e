"""What depth maps that come with a capture are worth, to stereo's start and to seeds.

A seed's error is its distance from the nearest point of the maps, relative to its distance from the
nearest camera that sees it; of maps with a confidence only high confidence counts. It favours seeds
from the maps, but says how far guesses are off. Prints Markdown; see README.md.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from scipy.spatial import cKDTree

import splatseed as ss
from splatseed.depth.stereo.maps import StereoResult
from splatseed.errors import SplatseedError
from splatseed.methods import source_name
from splatseed.photos.visibility import points_in_image
from splatseed.scene import Scene

__all__: list[str] = []

MAX_PIXELS = 10_000
"""Pixels of a map that seeds are compared with."""
HIGH = 2
ARMS: Mapping[str, Mapping[str, Any]] = {
    "`auto`, photographs alone": {"method": "auto", "dense": False, "depth_maps": False},
    "`auto`": {"method": "auto", "dense": False},
    "`auto`, high confidence only": {"method": "auto", "dense": False, "min_confidence": HIGH},
    "`depth`": {"method": "depth"},
    "`depth`, any confidence": {"method": "depth", "min_confidence": 0},
}


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    scenes: tuple[Path, ...]
    """Captures with depth maps."""
    first: int = 24
    """Photographs of each."""
    budget: int | None = None
    """Seeds in all; by default as many as there are cells."""


def rows(path: Path, settings: Settings) -> Iterator[list[str]]:
    """By arm: seeds by their origin, shares of them near the maps, confirmed pixels, seconds."""
    scene = ss.load_scene(path, require_points=False)
    scene = scene.replace(images=scene.images[: settings.first])
    surface = cKDTree(points_of_maps(scene))
    for label, arm in ARMS.items():
        stereo: list[StereoResult] = []
        before = seconds()
        cloud = ss.upsample(scene, budget=settings.budget, on_stereo=stereo.append, **arm)
        taken = seconds() - before
        errors = surface.query(cloud.xyz)[0] / nearest_depths(scene, cloud.xyz)
        codes, counts = np.unique(cloud.source, return_counts=True)
        made = ", ".join(
            f"{count:,} {source_name(code)}"
            for code, count in zip(codes.tolist(), counts.tolist(), strict=True)
        )
        shares = [f"{(errors < limit).mean():.3f}" for limit in (0.01, 0.02, 0.05)]
        share = "".join(
            f"{np.mean([each.confirmed(i).mean() for i in range(len(each.views))]):.0%}"
            for each in stereo
        )
        yield [path.name, label, made, *shares, share, f"{taken:.0f}"]


def points_of_maps(scene: Scene) -> np.ndarray:
    """World points [N, 3] of the maps, where they are sure."""
    parts = []
    for image in scene.images:
        assert scene.depths is not None  # noqa: S101  (captures with depth maps)
        depth = scene.depths.read(image.name).reliable(HIGH)
        row, column = np.nonzero(np.isfinite(depth.values))
        some = slice(None, None, max(1, len(row) // MAX_PIXELS))
        uv, z = np.stack([column, row], axis=1)[some] + 0.5, depth.values[row, column][some]
        parts.append(depth.camera(image.camera).unproject(uv, z.astype(np.float64)))
    return np.concatenate(parts)


def nearest_depths(scene: Scene, xyz: np.ndarray) -> np.ndarray:
    """The smallest depth of each point in the images that it lies in; infinite outside of all."""
    depths = np.full(len(xyz), np.inf)
    for image in scene.images:
        seen = points_in_image(image.camera, xyz)
        depths[seen.point_idx] = np.minimum(depths[seen.point_idx], seen.depth)
    return depths


def seconds() -> float:
    """Processor seconds of this process so far."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def main(settings: Settings) -> None:
    """Measure and print the table."""
    warn_if_busy()
    header = ["capture", "seeds", "number", "in 1%", "in 2%", "in 5%", "confirmed", "CPU s"]
    print(f"{describe()}\n")
    print(table(header, (row for path in settings.scenes for row in rows(path, settings))))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
