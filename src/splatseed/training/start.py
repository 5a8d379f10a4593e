"""A run that goes on from trained Gaussians instead of points (``train --start``).

Notation: the *start* is a model, of any trainer, that belongs to the scene: trained on it, edited,
cropped, or merged from several. Promise: its file is only read; a start in the world of gsplat's
examples, nerfstudio or graphdeco is brought into the scene's, and that is told; one that has more
Gaussians than the budget keeps those that contribute most to the training photographs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.photos.view import View
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import Gaussians, TrainingFrame
from splatseed.splat.world import around_scene, in_scene_world
from splatseed.training.growing import OPAQUE, contributions
from splatseed.training.parameters import make_parameters
from splatseed.training.seeds import near_depths
from splatseed.training.settings import TrainSettings

ABSENT = -20.0
"""Logit of an opacity that renders nothing, for those that a file gives as 0."""


def read_start(
    path: Path, scene: Scene, note: Callable[[str], None], *, trained: bool = False
) -> Gaussians:
    """The Gaussians of a file, in the scene's world; ``trained``: on just these poses.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no Gaussians, or they belong to another scene.
    """
    gaussians, told = around_scene(path, scene, read_gaussians(path, note), note), ""
    if not trained:  # where mcmc's clones may seem to be in another world
        gaussians, told = in_scene_world(path, scene, gaussians)
    if told:
        note(told)
    if gaussians.antialiased:
        note(
            f"{path} was trained with antialiasing; this run goes on without, so small Gaussians "
            "are too opaque at first."
        )
    # Some trainers write opacities of 0 and 1, whose logits are infinite.
    opacities = gaussians.opacities.clip(ABSENT, OPAQUE)
    return dataclasses.replace(gaussians, opacities=opacities, antialiased=False)


def start_facts(gaussians: Gaussians) -> dict[str, Any]:
    """What a run's config says of its start, in place of its seeds."""
    arrays = (np.ascontiguousarray(array).tobytes() for array in gaussians.arrays().values())
    return {"count": len(gaussians), "digest": fingerprint(*arrays)}


def started_gaussians(
    gaussians: Gaussians,
    views: Sequence[View],
    frame: TrainingFrame,
    settings: TrainSettings,
    device: torch.device,
    note: Callable[[str], None],
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """The Gaussians that a run begins with, in the training frame, and their near depths [N].

    ``gaussians`` and training views are in the world.
    """
    gaussians = frame.gaussians_from_world(_of_degree(gaussians, settings.sh_degree))
    views = [frame.view(view) for view in views if view.name not in frame.strays]
    cap, count = settings.cap, len(gaussians)
    if cap is not None and count > cap:
        gaussians = gaussians.select(_contributing_most(gaussians, views, cap, device))
        note(
            f"Of {count:,} Gaussians the {cap:,} that contribute most are kept: the budget allows "
            "no more."
        )
    return gaussians, near_depths(gaussians.means, views)


def _of_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """With harmonics of exactly this degree; coefficients that are missing are 0."""
    wanted = (degree + 1) ** 2 - 1
    harmonics = np.zeros((len(gaussians), wanted, 3), np.float32)
    known = min(wanted, gaussians.shN.shape[1])
    harmonics[:, :known] = gaussians.shN[:, :known]
    return dataclasses.replace(gaussians, shN=harmonics)


def _contributing_most(
    gaussians: Gaussians, views: Sequence[View], cap: int, device: torch.device
) -> np.ndarray:
    """Indices of the ``cap`` Gaussians with the most pixels over the views, ascending."""
    params = make_parameters(gaussians, device)
    total = torch.zeros_like(params["opacities"].detach())
    for view in views:
        total += contributions(params, view, total.new_zeros((view.height, view.width)))[0]
    return np.sort(total.topk(cap).indices.cpu().numpy())
