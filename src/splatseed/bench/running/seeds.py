"""The seeds of a run: what its method makes of its scene, and how long that takes.

Promise: seeds are the points that ``splatseed upsample`` would write for the same scene, method,
ratio, budget and seed: finite, and no two at one place. The time is that of upsampling and thinning
alone, without the compilation of kernels, which happens once on a machine.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.bench.planning.records import SFM, RunSpec
from splatseed.bench.planning.scenes import open_scene
from splatseed.kernels.compilation import watched
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.upsampling import upsample
from splatseed.upsample import Upsampler, chooses_number, configure

__all__ = ["make_seeds", "scene_of"]

PLAIN = "linear"
"""Any method does where no point is to be made."""


def scene_of(spec: RunSpec) -> Scene:
    """The scene of a run as it is before upsampling.

    Raises:
        SceneNotFoundError: It, or its depth maps, are not where the run says.
        SceneFormatError: A file is not what its format promises.
    """
    depth = Path(spec.depth_path) if spec.depth_path else None
    return open_scene(Path(spec.scene_path), images=spec.images, depth=depth)


def make_seeds(
    scene: Scene, spec: RunSpec, progress: Progress = silent
) -> tuple[PointCloud, float]:
    """The points that a run trains from, and the seconds that making new ones took.

    Args:
        scene: As ``scene_of`` opens it.
        spec: The run.
        progress: Told the stages of upsampling.

    Raises:
        SplatseedError: As ``splatseed.upsample``.
    """
    if spec.arm.method == SFM and spec.most_seeds is None:
        return scene.points, 0.0
    method, numbers = _asked(scene, spec)
    with _compilation() as compiling:
        start = time.perf_counter()
        seeds = upsample(
            scene, method, **numbers, budget=spec.most_seeds, seed=spec.repeat, progress=progress
        )
        seconds = time.perf_counter() - start
    return seeds.select(seeds.distinct), max(seconds - sum(compiling), 0.0)


def _asked(scene: Scene, spec: RunSpec) -> tuple[Upsampler, dict[str, Any]]:
    """The method of a run, and how many points it is to make.

    Under a budget, a method without a ratio fills what the originals leave of it.
    """
    arm, most = spec.arm, spec.most_seeds
    if arm.method == SFM:
        return configure(PLAIN), {"ratio": 1.0}
    method = configure(arm.method, arm.profile, **spec.parameters)
    if chooses_number(arm.method):
        return method, {}
    if arm.ratio or most is None:
        return method, {"ratio": arm.ratio}
    num_original = int(np.count_nonzero(scene.points.originals.distinct))
    return (method, {"num_points": most}) if most > num_original else (method, {"ratio": 1.0})


@contextmanager
def _compilation() -> Iterator[list[float]]:
    """A list that gets the seconds of each of Numba's compilations while the block runs."""
    spans: list[float] = []
    running: list[float] = []

    def watch(begins: bool) -> None:
        if begins:
            running.append(time.perf_counter())
            return
        begun = running.pop()
        if not running:  # else it is a part of the one that it came into
            spans.append(time.perf_counter() - begun)

    with watched(watch):
        yield spans
