"""A trained model and the test views of its scene, in the world of that scene.

Notation: the training frame is that of the scene's training cameras (``splat.frame``). Promise: a
model is rendered in that frame whoever trained it, so that the near plane is the same as in
training and single precision suffices for a distant world; the background is black.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.errors import SceneNotFoundError
from splatseed.evaluate.lpips import Lpips
from splatseed.evaluate.metrics import Covisible, Render, evaluate_views
from splatseed.evaluate.ssim import WINDOW
from splatseed.evaluate.world import (
    NO_TRANSFORM,
    check_world,
    find_transform,
    view_in,
)
from splatseed.export import read_model
from splatseed.io import load_scene
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.scores import NOT_ASKED, EvalResult
from splatseed.splat.frame import TrainingFrame, training_frame
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.pictures import beside_photograph, picture_name, write_picture
from splatseed.splat.rendering import render_view
from splatseed.views.view import View, load_views, poses_of


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """Gaussians and the views to score them on.

    Args:
        gaussians: The model, in the scene's world.
        views: The scene's test views, in its world.
        render: Renders the Gaussians from a view in the world.
        scene: The scene.
        doubt: Why the Gaussians may not be in its world after all; empty if they surely are.
    """

    gaussians: Gaussians
    views: Sequence[View]
    render: Render
    scene: Scene
    doubt: str = ""


def load_model(
    path: Path,
    scene_path: Path,
    *,
    data_factor: int = 1,
    test_every: int = 8,
    transform: str | None = None,
    device: torch.device | None = None,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> TrainedModel:
    """Read Gaussians that any trainer wrote, and the test views of their scene.

    Args:
        path: A file of Gaussians in any format that ``export.read_model`` reads.
        scene_path: The scene.
        data_factor: The factor by which photographs are downsampled.
        test_every: Every n-th image, sorted by name, is a test view.
        transform: From the scene's world to the model's, if they differ: a file, or a word, as for
            ``find_transform``. When left out, the model must be in the scene's own world.
        device: Where to render; the CPU when left out.
        cache_dir: Where smaller photographs are cached; nowhere when left out.
        progress: Called with the stage and the fraction done.

    Raises:
        SceneNotFoundError: The model, the scene or its images are missing.
        SceneFormatError: One of them is not what its format promises, or the model's Gaussians are
            not where the scene's points are.
        ParameterError: The transform cannot be computed.
    """
    gaussians = read_model(path)
    scene = load_scene(scene_path, require_points=False)
    train, test = scene.split(test_every)
    if not train or not test:
        raise SceneNotFoundError(
            f"{scene_path} to have images, some to train on and some to test on",
            found=f"{len(scene.images)}",
            fix="Name the scene with its cameras and photographs.",
        )
    views = load_views(
        scene,
        test,
        data_factor=data_factor,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=cache_dir,
        progress=progress,
    )
    world = None if transform is None else find_transform(transform, scene)
    doubt = "" if transform == NO_TRANSFORM else check_world(path, scene, gaussians, world)
    frame = training_frame([view_in(world, view) for view in poses_of(train)])
    render = gaussian_renderer(gaussians, frame, device)
    return TrainedModel(gaussians, views, lambda view: render(view_in(world, view)), scene, doubt)


def evaluate_model(
    model: TrainedModel,
    *,
    lpips: Lpips | None = None,
    lpips_reason: str = NOT_ASKED,
    covisible: Covisible | None = None,
    progress: Progress = silent,
) -> EvalResult:
    """Score a model on its test views, and count its Gaussians; see ``evaluate_views``.

    Raises:
        ParameterError: A render is not finite.
    """
    result = evaluate_views(
        model.render,
        model.views,
        lpips=lpips,
        lpips_reason=lpips_reason,
        covisible=covisible,
        progress=progress,
    )
    return dataclasses.replace(
        result, num_gaussians=len(model.gaussians), model_bytes=model.gaussians.num_bytes
    )


def gaussian_renderer(
    gaussians: Gaussians, frame: TrainingFrame, device: torch.device | None = None
) -> Render:
    """A function that renders views in the world, without gradients.

    Args:
        gaussians: In world coordinates.
        frame: The frame to render in.
        device: Where to render; the CPU when left out.
    """
    in_frame = dataclasses.replace(
        gaussians,
        means=frame.points_from_world(gaussians.means),
        scales=gaussians.scales + np.float32(math.log(frame.scale)),
    )
    tensors = {k: torch.tensor(array, device=device) for k, array in in_frame.arrays().items()}
    sh_degree = math.isqrt(1 + gaussians.shN.shape[1]) - 1

    @torch.no_grad()
    def render(view: View) -> Float[Tensor, "H W 3"]:
        return render_view(tensors, frame.view(view), sh_degree)[0]

    return render


def frame_of_scene(scene: Scene, test_every: int = 8) -> TrainingFrame:
    """The frame that a scene is trained in, from the poses alone.

    Args:
        scene: A scene with at least two images.
        test_every: As used in training.
    """
    train, _ = scene.split(test_every)
    return training_frame(poses_of(train))


def write_renders(model: TrainedModel, folder: Path, progress: Progress = silent) -> None:
    """Write a picture of each test view: photograph, render, error map.

    Raises:
        OutputError: A file cannot be written.
    """
    for done, view in enumerate(model.views):
        picture = beside_photograph(view.photograph, model.render(view).cpu().numpy())
        write_picture(folder / picture_name(view.name), picture)
        progress("write", (done + 1) / len(model.views))
