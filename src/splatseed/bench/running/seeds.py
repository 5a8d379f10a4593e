"""The seeds of a run: what its method makes of its scene, and how long that takes.

Promise: seeds are the points that ``splatseed upsample`` would write for the same scene, method,
ratio and seed: finite, and no two at one place. The time is that of upsampling alone, without the
compilation of kernels, which happens once on a machine.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatseed.bench.planning.records import SFM, RunSpec
from splatseed.bench.planning.scenes import open_scene
from splatseed.kernels.compilation import watched
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.upsample import chooses_number, configure, upsample

__all__ = ["make_seeds", "scene_of"]


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
    if spec.arm.method == SFM:
        return scene.points, 0.0
    method = configure(spec.arm.method, spec.arm.profile, **spec.parameters)
    ratio = None if chooses_number(spec.arm.method) else spec.arm.ratio
    with _compilation() as compiling:
        start = time.perf_counter()
        seeds = upsample(scene, method, ratio=ratio, seed=spec.repeat, progress=progress)
        seconds = time.perf_counter() - start
    return seeds.select(seeds.distinct), seconds - sum(compiling)


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
