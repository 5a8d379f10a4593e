"""Stereo's depth in the training views, for strategies that place Gaussians by it.

Notation: maps are smaller than the photographs and cover all of them; depths are planar, in
training units, 0 where other views do not confirm any. Promise: the test views are not used; the
same scene and seed give the same bytes, so that a resumed run has the maps it began with.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.io.output.staging import atomic_file
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.splat.gaussians import TrainingFrame
from splatseed.stereo.of_scene import stereo_depths
from splatseed.stereo.result import Stereo
from splatseed.train.settings import TrainSettings
from splatseed.train.stereo_size import stereo_size


def known_depths(
    scene: Scene,
    frame: TrainingFrame,
    settings: TrainSettings,
    device: torch.device,
    *,
    stereo: Stereo | None = None,
    kept: Path | None = None,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> Mapping[str, Float[Tensor, "h w"]]:
    """Depth maps of the training views by name; none if the settings do not use them.

    Args:
        scene: A scene with photographs.
        frame: The training frame.
        settings: Strategy, seed and test views are taken from here.
        device: Device of the maps.
        stereo: Maps that seeding has made already.
        kept: A file with the maps of the same photographs and seed, or a path at which to keep them
            for the next run.
        note: Called with the share of known depth.
        progress: Called with the stage and the fraction done.

    Raises:
        SceneFormatError: A photograph cannot be used.
    """
    images = scene.split(settings.test_every)[0]
    wanted = settings.densification == "grow" and settings.placing == "stereo"
    if not wanted or len(images) < 2:
        return {}
    start = time.perf_counter()
    known = _read(kept)
    if known is None:
        if stereo:
            maps = tuple(stereo.map(i) for i in range(len(stereo.views)))
        else:
            compared = scene.replace(images=images)
            size = stereo_size(images, settings, device.type)
            maps = stereo_depths(compared, seed=settings.seed, progress=progress, max_size=size)
        known = {each.name: each.depth for each in maps}
        _write(kept, known, time.perf_counter() - start)
    share = np.mean([np.isfinite(depth).mean() for depth in known.values()])
    took = "" if stereo else f" ({seconds_of(kept, time.perf_counter() - start):.0f} s)"
    note(
        f"Stereo knows the depth of {share:.0%} of the pixels{took}: strategy grow places most of "
        "what it adds there. --placing none only splits."
    )
    return {
        # Stereo's depths are in world units; unknown ones, NaN, become 0.
        name: torch.as_tensor(np.nan_to_num(depth * frame.scale)).to(device)
        for name, depth in known.items()
        if np.isfinite(depth).any()
    }


def seconds_of(kept: Path | None, took: float) -> float:
    """Seconds it took to make a file's maps, or, without a file, the seconds given.

    Args:
        kept: The file, if any.
        took: Seconds of this call.
    """
    if kept is None:
        return took
    try:
        with np.load(kept, allow_pickle=False) as file:
            return float(file["seconds"])
    except ARCHIVE_FAILURES:
        return took


def _read(kept: Path | None) -> dict[str, Float32[np.ndarray, "h w"]] | None:
    """Depth by name; None without a readable file."""
    if kept is None:
        return None
    try:
        with np.load(kept, allow_pickle=False) as file:
            return {str(name): file[f"depth_{i}"] for i, name in enumerate(file["names"])}
    except ARCHIVE_FAILURES:
        return None


def _write(
    kept: Path | None, known: Mapping[str, Float32[np.ndarray, "h w"]], seconds: float
) -> None:
    if kept is None:
        return
    arrays: dict[str, Any] = {f"depth_{i}": depth for i, depth in enumerate(known.values())}
    names = np.array(list(known), dtype=np.str_)
    kept.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(kept) as partial, partial.open("wb") as file:
        np.savez(file, names=names, seconds=np.float64(seconds), **arrays)
