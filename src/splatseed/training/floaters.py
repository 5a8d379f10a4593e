"""Floaters: Gaussians in free space that no photograph needs.

Notation: a *suspect* is a Gaussian that at least two training views see past at its centre, and
more than confirm it: stereo finds the surface clearly behind it
(``seeding.clouds.photo_consistency``). E is the sum of the training views' squared errors, a the
opacity of a suspect. Every suspect is reduced to a quarter of its opacity, so that one hardly hides
another; the photographs need it if dE/da is negative. Promise: only suspects that are not needed
are floaters, so thin, soft and transparent things stay. Test views have no part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float32
from numpy.lib.stride_tricks import sliding_window_view
from torch import Tensor

from splatseed.depth.stereo.maps import StereoSettings
from splatseed.errors import MissingDependencyError, SceneFormatError
from splatseed.io import load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.masks import with_masks
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.camera_check import reference_points
from splatseed.photos.loading import load_views, user_cache_dir
from splatseed.photos.sizes import factor_for_size as factor_for
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.seeding.clouds.photo_consistency import find_evidence
from splatseed.seeding.photo_methods import photographed
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.photographs import fill_masked, mask_tensor, photograph_tensor
from splatseed.splat.rendering import render_view
from splatseed.splat.training_frame import frame_of_model
from splatseed.training.config import without_dropped
from splatseed.training.depths import ImageDepths, known_depths
from splatseed.training.device import pick_device
from splatseed.training.folder import config_of
from splatseed.training.parameters import make_parameters
from splatseed.training.settings import TrainSettings
from splatseed.training.start import read_start

FADED = 0.25
"""The fraction of its opacity at which a suspect is tested. At half, 101 of 4,000 Gaussians of the
synthetic room went with 200 opaque ones that were put before them, at a quarter 38, at a tenth
66."""
MIN_KNOWN = 5
"""Minimum known depths among the nine pixels of a map around a centre."""
MIN_CONFIRMED, MIN_CONFIRMED_OF_ALL = 0.1, 0.02
"""A model belongs to another scene if views confirm at most the first fraction of the Gaussians at
a known depth or in front of it, or the second of all: models of six captures have 0.33 to 0.99 and
0.09 to 0.81."""
NO_SURFACE = np.full((1, 1), np.inf, np.float32)  # colours are not compared


def floaters_of_model(
    path: Path,
    scene_path: Path,
    *,
    data_factor: float | None = None,
    test_every: int = 8,
    masks: str | None = None,
    excluded: Sequence[str] = (),
    progress: Progress = silent,
) -> Bool[np.ndarray, " N"]:
    """Find the floaters of a file, in its order.

    Args:
        path: A file of Gaussians of any trainer, also in the frame of gsplat's examples, nerfstudio
            or graphdeco.
        scene_path: The scene that it was trained on.
        data_factor: The factor by which photographs are downsampled; when left out, to the size at
            which stereo compares them.
        test_every: Every n-th image, sorted by name, is a test view.
        masks: Which masks, as for ``io.masks.with_masks``.
        excluded: Photographs to leave out, as for ``exclude``, beside those that the run left out.
        progress: Called with the name of a stage and its fraction done.

    Raises:
        SceneNotFoundError: The model, the scene or its photographs are missing.
        SceneFormatError: One of them is damaged, or the model belongs to another scene.
        ParameterError: A number is out of range.
    """
    settings = TrainSettings(strategy="grow", data_factor=data_factor or 1, test_every=test_every)
    scene = without_dropped(load_scene(scene_path, require_points=False), config_of(path))
    scene = with_photographs(with_masks(exclude(scene, excluded), masks))
    images = photographed(scene, test_every, without="leave `clean` out")
    gaussians = read_start(path, scene, lambda _: None)
    if data_factor is None:
        settings = replace(settings, data_factor=factor_for(images, StereoSettings.max_size))
    factor, cache = settings.factor, user_cache_dir()
    views = load_views(scene, images, data_factor=factor, cache_dir=cache, progress=progress)
    frame, device = (
        frame_of_model(views, reference_points(scene), gaussians),
        render_device(progress),
    )
    depths, _ = known_depths(scene, frame.scale, settings, device.type, progress=progress)
    views = tuple(frame.view(view) for view in views)
    return find_floaters(frame.gaussians_from_world(gaussians), views, depths, device, progress)


def render_device(progress: Progress) -> torch.device:
    """Return a GPU if gsplat has kernels for it; the CPU finds the same floaters."""
    try:
        return pick_device("auto", progress)
    except MissingDependencyError:
        return torch.device("cpu")


def find_floaters(
    gaussians: Gaussians,
    views: Sequence[View],
    depths: ImageDepths,
    device: torch.device,
    progress: Progress = silent,
) -> Bool[np.ndarray, " N"]:
    """Find floaters among Gaussians.

    Args:
        gaussians: In the training frame.
        views: The training views, in the training frame.
        depths: As of ``known_depths``.
        device: Where to render.
        progress: Called with the name of a stage and its fraction done.

    Raises:
        SceneFormatError: Hardly any Gaussian lies at a depth that stereo finds.
    """
    compared = [view for view in views if view.name in depths]
    rays, surfaces = (
        [_free_depth(depths[view.name]) for view in compared],
        [NO_SURFACE] * len(compared),
    )
    evidence = find_evidence(compared, gaussians.means, surfaces, 1, rays, progress)
    measured = int(np.count_nonzero(evidence.violations + evidence.confirmations))
    confirmed = int(np.count_nonzero(evidence.confirmations))
    if confirmed <= max(MIN_CONFIRMED * measured, MIN_CONFIRMED_OF_ALL * len(gaussians)):
        raise SceneFormatError(
            "Gaussians at the depths that stereo finds in the photographs",
            found=f"{confirmed:,} of {len(gaussians):,}, and {measured - confirmed:,} in front of "
            "them",
            fix="Name the scene that the model was trained on; a model whose Gaussians do not lie "
            "on surfaces cannot be cleaned.",
        )
    suspects = evidence.free_space_violation
    return np.asarray(suspects & ~_needed(gaussians, suspects, views, device, progress))


def _free_depth(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return the minimum depth of the 3 x 3 pixels; infinite where too few are known."""
    known = np.where(depth > 0, depth, np.inf)
    around = sliding_window_view(np.pad(known, 1, constant_values=np.inf), (3, 3), axis=(0, 1))
    enough = (depth > 0) & (np.isfinite(around).sum(axis=(2, 3)) >= MIN_KNOWN)
    return np.where(enough, around.min(axis=(2, 3)), np.inf).astype(np.float32)


def _needed(
    gaussians: Gaussians,
    suspects: Bool[np.ndarray, " N"],
    views: Sequence[View],
    device: torch.device,
    progress: Progress,
) -> Bool[np.ndarray, " N"]:
    """Find the Gaussians whose opacity the photographs would raise, with suspects faded."""
    params: dict[str, Tensor] = {
        name: value.detach() for name, value in make_parameters(gaussians, device).items()
    }
    faded, logits = torch.from_numpy(suspects).to(device), params["opacities"]
    logits[faded] = torch.logit(FADED * torch.sigmoid(logits[faded]))
    logits.requires_grad_()
    degree = round((1 + gaussians.shN.shape[1]) ** 0.5) - 1
    slope = torch.zeros_like(logits)
    for i, view in enumerate(views if suspects.any() else ()):
        photograph = photograph_tensor(view, device)
        render = render_view(params, view, degree)[0]
        error = fill_masked(render, photograph, mask_tensor(view, device)) - photograph
        slope += torch.autograd.grad(error.square().sum(), logits)[0]
        progress("look for floaters", (i + 1) / len(views))
    return np.asarray((slope < 0).cpu().numpy())
