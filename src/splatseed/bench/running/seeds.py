"""The seeds of a run: its method's points on its scene, and how long that takes.

Promise: seeds are the points that ``splatseed upsample`` would write for the same scene, method,
ratio, budget and seed: finite and distinct. The time is that of upsampling and thinning, without
the compilation of kernels, which happens once per machine.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.bench.planning.records import CLOUD, SFM, WITH_CLOUD, RunSpec, plain
from splatseed.bench.planning.scenes import open_scene
from splatseed.bench.running.made import made_file, read_made, write_made
from splatseed.kernels.compilation import watched
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.advice import DEFAULT_METHOD
from splatseed.seeding.clouds.method import Cloud
from splatseed.seeding.upsampling import CELL, thin_to, upsample
from splatseed.upsample import Upsampler, chooses_number, configure

PLAIN = "linear"
"""The method used if no points are to be made; any would do."""


def scene_of(spec: RunSpec) -> Scene:
    """The scene of a run as it is before upsampling.

    Raises:
        SceneNotFoundError: It, or its depth maps, are not where the run says.
        SceneFormatError: A file is not what its format promises.
    """
    depth = Path(spec.depth_path) if spec.depth_path else None
    return open_scene(Path(spec.scene_path), images=spec.images, depth=depth)


def make_seeds(
    scene: Scene, spec: RunSpec, progress: Progress = silent, bench: Path | None = None
) -> tuple[PointCloud, float]:
    """The points that a run trains from, and the seconds that new ones took.

    Args:
        scene: The scene as opened by ``scene_of``.
        spec: The run.
        progress: Told the stages of upsampling.
        bench: The benchmark's folder, where points that several runs thin are stored; recomputed
            when left out. Their seconds count in each of these runs.

    Raises:
        SplatseedError: As ``splatseed.upsample``.
    """
    if spec.arm.method == SFM and spec.most_seeds is None:
        return scene.points, 0.0
    method, numbers = _asked(scene, spec)
    looks = spec.arm.method != SFM and chooses_number(plain(spec.arm.method))
    if bench is not None and looks and not is_full(scene, spec):
        return _thinned(scene, method, numbers, spec, bench, progress)
    with _compilation() as compiling:
        start = time.perf_counter()
        seeds = upsample(
            scene, method, **numbers, budget=spec.most_seeds, seed=spec.repeat, progress=progress
        )
        seconds = time.perf_counter() - start
    return seeds.select(seeds.distinct), max(seconds - sum(compiling), 0.0)


def is_full(scene: Scene, spec: RunSpec) -> bool:
    """Whether ``auto`` makes no points, as the originals fill the budget."""
    most = spec.most_seeds
    return spec.arm.method == DEFAULT_METHOD and most is not None and _num_original(scene) >= most


def _thinned(
    scene: Scene,
    method: Upsampler,
    given: dict[str, Any],
    spec: RunSpec,
    bench: Path,
    progress: Progress,
) -> tuple[PointCloud, float]:
    """The points that a method makes, new or stored, within the budget."""
    kept = made_file(bench, spec)
    made = read_made(kept)
    with _compilation() as compiling:
        start = time.perf_counter()
        if made is None:
            cloud = upsample(scene, method, **given, seed=spec.repeat, progress=progress)
            made = cloud, max(time.perf_counter() - start - sum(compiling), 0.0)
            write_made(kept, *made)
        start, before = time.perf_counter(), sum(compiling)
        seeds, seconds = made
        if spec.most_seeds is not None:
            hold_out = getattr(method, "hold_out", 0)
            seeds = thin_to(scene, seeds, spec.most_seeds, CELL, hold_out, spec.repeat, progress)
        seconds += time.perf_counter() - start - (sum(compiling) - before)
    return seeds.select(seeds.distinct), seconds


def _num_original(scene: Scene) -> int:
    return int(np.count_nonzero(scene.points.originals.distinct))


def _asked(scene: Scene, spec: RunSpec) -> tuple[Upsampler, dict[str, Any]]:
    """The method of a run, and how many points it should make or what it comes beside.

    Under a budget, a method without a ratio fills the room that the originals leave.
    """
    arm, most = spec.arm, spec.most_seeds
    if arm.method == SFM:
        return configure(PLAIN), {"ratio": 1.0}
    if arm.method == CLOUD:
        return Cloud(**spec.parameters).of(spec.cloud_path), {}
    if arm.method in WITH_CLOUD:
        begin = f"{CLOUD}."
        own = {name: v for name, v in spec.parameters.items() if not name.startswith(begin)}
        cloud = {n.removeprefix(begin): v for n, v in spec.parameters.items() if n not in own}
        extra = Cloud(**cloud).of(spec.cloud_path)
        return configure(plain(arm.method), arm.profile, **own), {"extra_method": extra}
    method = configure(arm.method, arm.profile, **spec.parameters)
    if chooses_number(arm.method):
        return method, {}
    if arm.ratio or most is None:
        return method, {"ratio": arm.ratio}
    return method, {"num_points": most} if most > _num_original(scene) else {"ratio": 1.0}


@contextmanager
def _compilation() -> Iterator[list[float]]:
    """A list that receives the seconds of each of Numba's compilations while the block runs."""
    spans: list[float] = []
    running: list[float] = []

    def watch(begins: bool) -> None:
        if begins:
            running.append(time.perf_counter())
            return
        begun = running.pop()
        if not running:  # else it is nested in another, which counts it
            spans.append(time.perf_counter() - begun)

    with watched(watch):
        yield spans
