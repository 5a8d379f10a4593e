"""Stereo's depth in the training views, at a size that a run can afford, for strategy ``grow``.

Notation: a pixel is *compared* once if stereo finds its depth, *rendered* once in each training
step that shows it; maps are smaller than the photographs and cover all of them. Promise: the test
views are not used; a resumed run has the maps it began with: the same scene and seed give the same
bytes, and sizes depend on the settings and the photographs' sizes alone, never on the clock.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.depth.stereo.maps import StereoResult, StereoSettings, stereo_depths
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import atomic_file
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.train.settings import TrainSettings

PER_RENDERED: Mapping[str, float] = MappingProxyType({"cpu": 0.13, "cuda": 0.01})
"""Most pixels compared per pixel rendered in training, by the device that renders: stereo then
takes about a quarter of training's seconds (on the CPU: fern, 0.045: 5 of 47 s; bonsai at 1,500
steps, 0.68: 83 of 64 s). Comparing always runs on the CPU, some 0.7 million pixels a second and
core. The number for a GPU is an estimate: 150 million pixels rendered a second, beside 8 cores;
benchmarks/gpu measures both."""
LEAST_SIZE: Mapping[str, int] = MappingProxyType({"cpu": 64, "cuda": 200})
"""Smallest size that is returned, in pixels; on the CPU it is not below the size that is trained
either, which on a GPU is the photographs' own."""

DepthMaps = dict[str, Float32[np.ndarray, "h w"]]
"""Planar depths by the names of their views."""


def stereo_size(images: Sequence[Image], settings: TrainSettings, device: str) -> int:
    """Most pixels a side at which photographs are compared, for a run of this length.

    ``StereoSettings``' own where training takes much longer than comparing, otherwise fewer.

    Args:
        images: The training photographs.
        settings: Steps, and the size that is trained.
        device: Where training renders: cpu or cuda.
    """
    full = StereoSettings().max_size
    if not images:
        return full
    longest = max(max(image.camera.width, image.camera.height) for image in images)
    pixels = sum(image.camera.width * image.camera.height for image in images)
    most = min(full, longest)
    compared = pixels * (most / longest) ** 2
    rendered = settings.max_steps * pixels / len(images) / settings.data_factor**2
    # Pixels go with the square of the size.
    affordable = int(most * math.sqrt(PER_RENDERED[device] * rendered / compared))
    least = max(LEAST_SIZE[device], longest // settings.data_factor if device == "cpu" else 0)
    return min(full, max(least, affordable))


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
    """Depth maps of the training views; none if the settings do not use them.

    Args:
        scene: A scene with photographs.
        scale: Training units per unit of the world.
        settings: Strategy, seed and test views are taken from here.
        device: Where training renders: cpu or cuda.
        stereo: Maps that seeding has made already.
        kept: A file with the maps of the same photographs and seed, or a path at which to keep them
            for the next run.
        note: Called with the share of known depth.
        progress: Called with the stage and the fraction done.

    Returns:
        Depths in training units, 0 where other views do not confirm any; and the seconds that it
        took to find them, here or in the run that kept them.

    Raises:
        SceneFormatError: A photograph cannot be used.
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
            compared = scene.replace(images=images)
            size = stereo_size(images, settings, device)
            maps = stereo_depths(compared, seed=settings.seed, progress=progress, max_size=size)
        found = {each.name: each.depth for each in maps}, time.perf_counter() - start
        _write(kept, *found)
    known, seconds = found
    share = np.mean([np.isfinite(depth).mean() for depth in known.values()])
    took = "" if stereo else f" ({seconds:.0f} s)"
    note(
        f"Stereo knows the depth of {share:.0%} of the pixels{took}: strategy grow places most of "
        "what it adds there. placing = none only splits."
    )
    # Stereo's depths are in world units; unknown ones, NaN, become 0.
    return {
        name: np.nan_to_num(depth * scale)
        for name, depth in known.items()
        if np.isfinite(depth).any()
    }, seconds


def _read(kept: Path | None) -> tuple[DepthMaps, float] | None:
    """What ``_write`` kept; None without a readable file."""
    if kept is None:
        return None
    try:
        with np.load(kept, allow_pickle=False) as file:
            maps = {str(name): file[f"depth_{i}"] for i, name in enumerate(file["names"])}
            return maps, float(file["seconds"])
    except ARCHIVE_FAILURES:
        return None


def _write(kept: Path | None, known: DepthMaps, seconds: float) -> None:
    if kept is None:
        return
    arrays: dict[str, Any] = {f"depth_{i}": depth for i, depth in enumerate(known.values())}
    names = np.array(list(known), dtype=np.str_)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(kept) as partial, partial.open("wb") as file:
        np.savez(file, names=names, seconds=np.float64(seconds), **arrays)
