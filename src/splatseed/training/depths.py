"""Depth maps of the training views, on which strategy ``grow`` places Gaussians.

Stereo finds them, at a size and for as many views as the length of the run affords; a file keeps
them for other runs on the same photographs. Test views have no part. No PyTorch.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.depth.stereo import stereo_depths
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.findings import Finding
from splatseed.io.downsampling import reduced_size
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.staging import atomic_file
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.sampling import evenly_spaced
from splatseed.scene import Image, Scene
from splatseed.training.settings import TrainSettings

ImageDepths = dict[str, Float32[np.ndarray, "h w"]]
"""Planar depths by the names of their views."""


@dataclass(frozen=True)
class StereoCost:
    """How much of a run stereo may take on a device."""

    pixels: float
    """Pixels compared per pixel rendered in training. Comparing always runs on the CPU, some 0.7
    million pixels a second and core. The number for a GPU is an estimate: 150 million pixels
    rendered a second, beside 8 cores; benchmarks/gpu measures both."""
    min_size: int
    """Minimum side, px. On the CPU the trained size is a minimum, too; not on a GPU, where it is
    often the photographs' full size."""


COSTS: Mapping[str, StereoCost] = MappingProxyType(
    {"cpu": StereoCost(0.06, 64), "cuda": StereoCost(0.01, 200)}
)
MIN_VIEWS = 48
"""Minimum views to compare, if there are as many, however short the run: fewer may not overlap."""
_PLACING = 0.5
"""Fraction of ``StereoCost.pixels`` to spend on maps that only growth uses, if there are more than
``MIN_VIEWS`` views: it gains as much as from all of it (benchmarks/tried.md), in up to a fifth less
time."""
SWEEPS = 2
"""PatchMatch iterations. Two more take 1.6 times as long, find the depth of 1% more of the pixels
(bonsai, treehill, fox), and gain nothing beyond noise."""


@dataclass(frozen=True)
class DepthCache:
    """A file of depth maps that several runs on the same photographs and seed share."""

    path: Path | None = None  # None: maps are not kept
    seconds_counted: bool = False  # whether the time of the seeds includes that of the maps


NOT_CACHED = DepthCache()


def stereo_size(
    images: Sequence[Image], settings: TrainSettings, device: str, fraction: float = 1.0
) -> int:
    """Return the largest side, px, at which to compare photographs for a run of this length.

    At most the ``max_size`` of ``StereoSettings``, which long runs reach. ``device`` is where
    training runs, cpu or cuda; ``fraction`` scales what stereo may take (``StereoCost``).
    """
    full = StereoSettings().max_size
    if not images:
        return full
    cost = COSTS[device]
    longest = max(max(image.camera.width, image.camera.height) for image in images)
    pixels = sum(image.camera.width * image.camera.height for image in images)
    limit = min(full, longest)
    compared = pixels * (limit / longest) ** 2
    rendered = settings.max_steps * pixels / len(images) / settings.factor**2
    # The number of pixels is proportional to the square of the size.
    affordable = int(limit * math.sqrt(fraction * cost.pixels * rendered / compared))
    trained = reduced_size(longest, longest, settings.factor)[0] if device == "cpu" else 0
    return min(full, max(cost.min_size, trained, affordable))


def placing_views(
    images: Sequence[Image], settings: TrainSettings, device: str
) -> tuple[Sequence[Image], int]:
    """Select the training photographs to compare for growth, and their largest side then, px.

    As many as a run of this length affords: ``images`` are sorted by name, and the selected ones
    are evenly spaced.
    """
    fraction = _PLACING if len(images) > MIN_VIEWS else 1.0
    size = stereo_size(images, settings, device, fraction)
    # In pixels of the photographs, at the compared size and at the trained size.
    scales = [size / max(image.camera.width, image.camera.height) for image in images]
    scale = min(1.0, float(np.median(scales))) if scales else 1.0
    pixels = fraction * COSTS[device].pixels
    affordable = pixels * settings.max_steps / (scale * settings.factor) ** 2
    count = min(len(images), max(MIN_VIEWS, int(affordable)))
    return [images[i] for i in evenly_spaced(len(images), count)], size


def known_depths(
    scene: Scene,
    scale: float,
    settings: TrainSettings,
    device: str,
    *,
    stereo: StereoResult | None = None,
    cache: Path | None = None,
    note: Note = silent_note,
    progress: Progress = silent,
) -> tuple[ImageDepths, float]:
    """Find the depth maps on which ``grow`` places Gaussians; none if the settings use none.

    Args:
        scene: The scene, whose ``placing_views`` get a map.
        scale: Training units per unit of the scene.
        settings: How to train.
        device: Where to train, cpu or cuda.
        stereo: The maps that seeding has made, to be used instead.
        cache: A file of maps of the same photographs and seed; written if it is not there.
        note: Called with the share of the pixels that have a depth.
        progress: Called with the name of a stage and its fraction done.

    Returns:
        Maps in training units, 0 where other views confirm no depth, and the seconds that finding
        them took, in this run or in the run that wrote the file.
    """
    images = scene.split(settings.test_every)[0]
    if not settings.uses_stereo or len(images) < 2:
        return {}, 0.0
    found = _read(cache)
    if found is None:
        start = time.perf_counter()
        if stereo:
            maps = tuple(stereo.map(i) for i in range(len(stereo.views)))
        else:
            views, size = placing_views(images, settings, device)
            compared = scene.replace(images=views)
            maps = stereo_depths(
                compared, seed=settings.seed, progress=progress, max_size=size, sweeps=SWEEPS
            )
        found = {each.name: each.depth for each in maps}, time.perf_counter() - start
        if cache:
            _write(cache, *found)
    known, seconds = found
    share = np.mean([np.isfinite(depth).mean() for depth in known.values()])
    duration = "" if stereo else f" ({seconds:.0f} s)"
    text = f"Stereo found the depth of {share:.0%} of the pixels{duration}, where strategy "
    text += f"{settings.traits.name} places most new Gaussians."
    note(Finding("stereo-depths", text, "info", fix="With `placing='none'` it only splits them."))
    # Stereo's depths are in units of the scene; unknown ones, NaN, become 0.
    return {
        name: np.nan_to_num(depth * scale)
        for name, depth in known.items()
        if np.isfinite(depth).any()
    }, seconds


def _write(path: Path, maps: ImageDepths, seconds: float) -> None:
    arrays: dict[str, Any] = {f"depth_{i}": depth for i, depth in enumerate(maps.values())}
    names = np.array(list(maps), dtype=np.str_)
    with atomic_file(path) as partial, partial.open("wb") as file:
        np.savez(file, names=names, seconds=np.float64(seconds), **arrays)


def _read(path: Path | None) -> tuple[ImageDepths, float] | None:
    """Read the maps of ``_write``; None without a readable file."""
    if path is None:
        return None
    try:
        with np.load(path, allow_pickle=False) as file:
            maps = {str(name): file[f"depth_{i}"] for i, name in enumerate(file["names"])}
            return maps, float(file["seconds"])
    except ARCHIVE_FAILURES:
        return None
