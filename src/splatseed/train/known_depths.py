"""Stereo's depth in the training views, for strategies that place Gaussians by it.

Notation: maps are smaller than the photographs and cover all of them; depths are planar, in
training units, 0 where other views do not confirm any. Promise: the test views are not used; the
same scene and seed give the same bytes, so that a resumed run has the maps it began with.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.splat.frame import TrainingFrame
from splatseed.stereo.of_scene import stereo_depths
from splatseed.stereo.result import Stereo
from splatseed.train.settings import TrainSettings

__all__ = ["known_depths"]


def known_depths(
    scene: Scene,
    frame: TrainingFrame,
    settings: TrainSettings,
    device: torch.device,
    *,
    stereo: Stereo | None = None,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = silent,
) -> Mapping[str, Float[Tensor, "h w"]]:
    """Depth maps of the training views by name; none if the settings have no use for them.

    Args:
        scene: A scene with photographs.
        frame: The training frame.
        settings: Their strategy, seed and test views matter.
        device: Where the maps should be.
        stereo: The result of stereo, if seeding has it already.
        note: Told how much is known.
        progress: Told how far it is.

    Raises:
        SceneFormatError: A photograph cannot be used.
    """
    images = scene.split(settings.test_every)[0]
    wanted = settings.densification == "grow" and settings.placing == "stereo"
    if not wanted or len(images) < 2:
        return {}
    start = time.perf_counter()
    if stereo:
        maps = tuple(stereo.map(i) for i in range(len(stereo.views)))
    else:
        maps = stereo_depths(scene.replace(images=images), seed=settings.seed, progress=progress)
    share = np.mean([each.known_share for each in maps])
    took = "" if stereo else f" ({time.perf_counter() - start:.0f} s)"
    note(
        f"Stereo knows the depth of {share:.0%} of the pixels{took}: strategy grow places most of "
        "what it adds there. --placing none only splits."
    )
    return {
        each.name: torch.as_tensor(np.nan_to_num(each.depth * frame.scale)).to(device)
        for each in maps
        if each.known_share
    }
