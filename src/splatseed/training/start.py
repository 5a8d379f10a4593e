"""A run that continues from trained Gaussians instead of points (setting ``start``).

Notation: the *start* is a model of the scene by any trainer, perhaps edited, cropped, or merged
from several. Promise: its file is only read; a start in the frame of gsplat's examples, nerfstudio
or graphdeco is moved to the scene's, with a note; a start of more Gaussians than the budget keeps
those that contribute most to the training photographs.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.findings import Finding
from splatseed.photos.view import View
from splatseed.progress import Note
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import move_to_scene_frame, move_to_scene_origin
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.initialization import min_view_depths
from splatseed.training.parameters import MAX_LOGIT, make_parameters
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.grow import contributions

ABSENT = -20.0
"""Logit of an opacity that renders nothing, in place of a file's opacity of 0."""


def read_start(path: Path, scene: Scene, note: Note, *, same_poses: bool = False) -> Gaussians:
    """Read the Gaussians of a file, in the scene's frame.

    With ``same_poses`` they were trained at the scene's poses, and need no search for their frame.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no Gaussians, or they belong to another scene.
    """
    gaussians = move_to_scene_origin(path, scene, read_gaussians(path, note), note)
    if not same_poses:  # else mcmc's clones could look like another frame
        gaussians = move_to_scene_frame(path, scene, gaussians, note)
    if gaussians.antialiased:
        text = f"{path} was trained with antialiasing; this run continues without it, so small "
        note(Finding("antialiased-model", f"{text}Gaussians are too opaque at first."))
    # Some trainers write opacities of 0 and 1, whose logits are infinite.
    opacities = gaussians.opacities.clip(ABSENT, MAX_LOGIT)
    return dataclasses.replace(gaussians, opacities=opacities, antialiased=False)


def start_facts(gaussians: Gaussians) -> dict[str, Any]:
    """Return what a run's config records of its start, in place of its seeds."""
    arrays = (np.ascontiguousarray(array).tobytes() for array in gaussians.arrays().values())
    return {"count": len(gaussians), "digest": fingerprint(*arrays)}


def continued_gaussians(
    gaussians: Gaussians,
    views: Sequence[View],
    frame: TrainingFrame,
    settings: TrainSettings,
    device: torch.device,
    note: Note,
) -> tuple[Gaussians, Float32[np.ndarray, " N"]]:
    """Move the start to the training frame, within the budget; also return its min view depths [N].

    ``gaussians`` and training views are in the scene's frame.
    """
    gaussians = frame.gaussians_from_world(_of_degree(gaussians, settings.sh_degree))
    views = [frame.view(view) for view in views if view.name not in frame.strays]
    cap, count = settings.cap, len(gaussians)
    if cap is not None and count > cap:
        gaussians = gaussians.select(_largest_contributors(gaussians, views, cap, device))
        text = f"The {cap:,} of {count:,} Gaussians that contribute most are kept: the budget "
        note(Finding("thinned-start", f"{text}allows no more.", "info"))
    return gaussians, min_view_depths(gaussians.means, views)


def _of_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the Gaussians with harmonics of exactly this degree; missing coefficients are 0."""
    wanted = (degree + 1) ** 2 - 1
    harmonics = np.zeros((len(gaussians), wanted, 3), np.float32)
    known = min(wanted, gaussians.shN.shape[1])
    harmonics[:, :known] = gaussians.shN[:, :known]
    return dataclasses.replace(gaussians, shN=harmonics)


def _largest_contributors(
    gaussians: Gaussians, views: Sequence[View], cap: int, device: torch.device
) -> np.ndarray:
    """Return the ascending indices of the ``cap`` Gaussians with the most pixels in the views."""
    params = make_parameters(gaussians, device)
    total = torch.zeros_like(params["opacities"].detach())
    for view in views:
        total += contributions(params, view, total.new_zeros((view.height, view.width)))[0]
    return np.sort(total.topk(cap).indices.cpu().numpy())
