"""Score Gaussians: compare renders with test photographs.

Values are sRGB in [0, 1]; renders are clamped, but not rounded to 8 bits. SSIM has an 11 x 11
Gaussian window (sigma 1.5) on images mirrored at their edges, as in torchmetrics and gsplat's
trainer. Models are rendered in the training frame of the scene's training cameras. Needs PyTorch
(``pip install ".[train]"``).
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float32

from splatseed.io.files import StrPath
from splatseed.requirements import require

require("torch", "flip_evaluator")  # before the imports below, for one clear error

import torch
from torch import Tensor

from splatseed.checkup.wrong_poses import WRONG_POSES
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io import load_scene
from splatseed.io.copies import COPIES
from splatseed.io.exclusion import EXCLUDED, excluded_finding, matching_names
from splatseed.io.masks import TRANSPARENT, with_masks
from splatseed.io.photograph import photographs_digest
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.camera_check import reference_points
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import default_factor
from splatseed.photos.view import View, camera_views
from splatseed.progress import Progress, silent
from splatseed.scene import BLACK, Color, Image, Scene
from splatseed.scores import NOT_REQUESTED, EvalResult, ViewScore
from splatseed.splat._kernels import WINDOW
from splatseed.splat.background import WHITE, background_of
from splatseed.splat.formats import read_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.lpips import LPIPS_NET, Lpips
from splatseed.splat.metrics import color_corrected, flip_map, mirrored_ssim, psnr
from splatseed.splat.model_frame import (
    NO_TRANSFORM,
    check_frame,
    find_transform,
    move_to_scene_origin,
    view_in_model_frame,
)
from splatseed.splat.photographs import fill_masked, mask_tensor, photograph_tensor
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import frame_of_model
from splatseed.text import agreeing, name_some

Covisible: TypeAlias = Mapping[str, Bool[np.ndarray, "H W"]]
"""The pixels of each test view, by name, that at least two training views see."""
Render: TypeAlias = Callable[[View], Float[Tensor, "H W 3"]]
OnView: TypeAlias = Callable[[View, Float32[np.ndarray, "H W 3"], Float32[np.ndarray, "H W"]], None]
"""Called with each view, its render clamped to [0, 1], and FLIP of each pixel."""
_COMPARED, _DIFFERENCE = 2, 1.0
"""Test views on which black and white are compared as backgrounds, and the decibels that matter."""


@torch.no_grad()
def evaluate_views(
    render: Render,
    views: Sequence[View],
    *,
    lpips: Lpips | None = None,
    lpips_reason: str = NOT_REQUESTED,
    covisible: Covisible | None = None,
    on_view: OnView = lambda *_: None,
    progress: Progress = silent,
) -> EvalResult:
    """Score renders of views against their photographs.

    Masked pixels have no part in scores; for FLIP and LPIPS the render takes the photograph's
    colours there. The first view is rendered once more, untimed, because a first call may compile.

    Args:
        render: Renders a view as float [H, W, 3], values about 0..1, on any device.
        views: One or more views.
        lpips: The LPIPS metric; without it LPIPS is not measured.
        lpips_reason: Why LPIPS is not measured, for the result.
        covisible: Pixels over which PSNR is also computed, for some or all views.
        on_view: Called with each view, its render and its FLIP.
        progress: Called with the name of a stage and its fraction done.

    Example:
        >>> import numpy as np, torch
        >>> from splatseed.camera import Camera
        >>> grey = np.full((16, 16, 3), 128, np.uint8)
        >>> view = View("grey.png", grey, Camera(np.eye(3), 16, 16, np.eye(4)))
        >>> result = evaluate_views(lambda view: torch.zeros(16, 16, 3), [view])
        >>> round(result.psnr, 2)
        5.99
    """
    if not views:
        raise ParameterError("views to score", found="none", fix="Choose test images (test_every).")
    render(views[0])
    scores = []
    for view in views:
        scores.append(_score(render, view, lpips, (covisible or {}).get(view.name), on_view))
        progress("score", len(scores) / len(views))
    return EvalResult(
        tuple(scores),
        lpips_net=LPIPS_NET if lpips else None,
        lpips_reason="" if lpips else lpips_reason,
    )


def _score(
    render: Render,
    view: View,
    lpips: Lpips | None,
    seen: Bool[np.ndarray, "H W"] | None,
    on_view: OnView,
) -> ViewScore:
    start = _now()
    image = render(view)
    seconds = _now() - start
    shape = [view.height, view.width, 3]
    if list(image.shape) != shape or not bool(torch.isfinite(image).all()):
        raise ParameterError(
            f"a render of {view.name} of shape {shape} and finite values",
            found="NaN or infinity" if list(image.shape) == shape else f"{list(image.shape)}",
            fix="Render finite values at the width and height of the view.",
        )
    photograph, mask = photograph_tensor(view, image.device), mask_tensor(view, image.device)
    clamped = image.clamp(0.0, 1.0)
    image = fill_masked(clamped, photograph, mask)
    errors = flip_map(image, photograph)
    within, share, flips = None, None, errors if view.mask is None else errors[view.mask]
    if seen is not None:
        share = float(seen.mean() if view.mask is None else seen[view.mask].mean())
        seen = seen if view.mask is None else seen & view.mask
        if seen.any():
            within = psnr(image, photograph, torch.from_numpy(seen).to(image.device))
    on_view(view, clamped.cpu().numpy(), errors)
    return ViewScore(
        view.name,
        psnr=psnr(image, photograph, mask),
        ssim=mirrored_ssim(image, photograph, mask),
        lpips=None if lpips is None else lpips(image, photograph),
        seconds=seconds,
        covisible_psnr=within,
        covisible_share=share,
        flip=float(flips.mean(dtype=np.float64)),
        cc_psnr=psnr(color_corrected(image, photograph, mask), photograph, mask),
    )


def _now() -> float:
    """Return the time after a GPU in use has finished its work."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """Gaussians, the test views of their scene, and a function that renders a view.

    ``findings`` list what was dropped or changed on reading, and whether the frame is uncertain.
    """

    gaussians: Gaussians
    views: Sequence[View]
    render: Render
    scene: Scene
    data_factor: float = 1
    findings: tuple[Finding, ...] = ()


def load_model(
    model: Gaussians | StrPath,
    scene: Scene | StrPath,
    *,
    data_factor: float | None = None,
    test_every: int = 8,
    transform: str | None = None,
    masks: str | None = None,
    exclude: Sequence[str] = (),
    trained_on: str | None = None,
    near_plane: float | None = None,
    background: str | None = None,
    device: torch.device | None = None,
    cache_dir: Path | None = None,
    progress: Progress = silent,
) -> TrainedModel:
    """Load the Gaussians of any trainer, and the test views of their scene.

    Args:
        model: A file that ``read_gaussians`` reads, or Gaussians in the scene's frame.
        scene: The scene, or its path.
        data_factor: The factor by which photographs are downsampled; by default that of ``train``.
        test_every: Every n-th image, sorted by name, is a test view.
        transform: From the scene's to the model's frame, as for ``find_transform``; by default they
            must be the same.
        masks: The masks, as for ``io.masks.with_masks``.
        exclude: Test views to leave out: names or patterns, as for ``io.exclusion.exclude``.
        trained_on: The ``photographs_digest`` of the run; if it equals the scene's, the frame is
            known to be right and not checked.
        near_plane: The run's, in the model's units; by default computed from the scene.
        background: Behind renders and transparent pixels, as for ``parse_background``; by default
            what the model's trainer recorded, else black.
        device: The device to render on, by default the CPU.
        cache_dir: A folder in which to cache downsampled photographs; by default none.
        progress: Called with the name of a stage and its fraction done.

    Raises:
        SceneNotFoundError: The model, the scene or its images are missing.
        SceneFormatError: A file is damaged, or the Gaussians are in another frame.
        ParameterError: The transform cannot be computed.
    """
    findings: list[Finding] = []
    path = None if isinstance(model, Gaussians) else Path(model)
    gaussians = (
        model if isinstance(model, Gaussians) else read_gaussians(Path(model), findings.append)
    )
    if not isinstance(scene, Scene):
        scene = load_scene(Path(scene), require_points=False)
    scene = with_masks(scene, masks)
    known = background_of(path, background, findings.append)
    scene = scene.replace(background=known or BLACK)
    reported = (TRANSPARENT, COPIES, WRONG_POSES, EXCLUDED)
    findings += [each for each in scene.findings if each.kind in reported]
    if scene.images:
        scene = _with_test_photographs(scene, test_every)
    explained = {name for finding in findings for name in finding.subjects}
    if gone := [name for name in scene.absent if name not in explained]:
        are = agreeing(len(gone), "image of the scene is", "images of the scene are")
        text = f"{len(gone)} {are} left out, without a photograph or a pose: {name_some(gone, 3)}."
        findings.append(Finding("missing-photographs", text, subjects=tuple(gone)))
    train, test = scene.split(test_every)
    if not train or not test:
        raise SceneNotFoundError(
            f"{scene.source.root or 'the scene'} to have images for training and testing",
            found=f"{len(scene.images)}",
            fix="Name the scene with its cameras and photographs.",
        )
    test, excluded = _without_excluded(scene, test, exclude)
    findings += excluded
    factor = data_factor or default_factor(scene.images)
    views = load_views(
        scene,
        test,
        data_factor=factor,
        min_side=WINDOW,  # smaller views have no SSIM
        cache_dir=cache_dir,
        progress=progress,
    )
    if transform is None and path is not None:
        gaussians = move_to_scene_origin(path, scene, gaussians, findings.append)
    world = None if transform is None else find_transform(transform, scene)
    same_scene = transform is None and trained_on == photographs_digest(scene)
    skip_check = same_scene or transform == NO_TRANSFORM
    if not skip_check:
        check_frame(path, scene, gaussians, world, findings.append)
    points = reference_points(scene)
    frame = frame_of_model(
        [view_in_model_frame(world, view) for view in camera_views(train)],
        points if world is None else world.points(points),
        gaussians,
    )
    if near_plane is not None:
        frame = dataclasses.replace(frame, near=near_plane * frame.scale)

    def renderer(background: Color) -> Render:
        image = ModelRenderer(gaussians, frame, device, background).image
        return lambda view: image(view_in_model_frame(world, view))

    render = renderer(scene.background)
    if known is None:
        findings += _better_on_white(renderer, scene, views, factor)
    return TrainedModel(gaussians, views, render, scene, factor, tuple(findings))


def _without_excluded(
    scene: Scene, test: Sequence[Image], patterns: Sequence[str]
) -> tuple[tuple[Image, ...], list[Finding]]:
    """Leave test views out; the scene keeps them, by which a run's scene is recognised."""
    names = matching_names([*(image.name for image in scene.images), *scene.absent], patterns)
    left = tuple(image for image in test if image.name not in names)
    if not left:
        raise ParameterError(
            "`exclude` to leave some test views",
            found=f"patterns that match all {len(test):,}",
            fix="Name fewer.",
        )
    gone = [image.name for image in test if image.name in names]
    return left, [excluded_finding(gone)] if gone else []


def _better_on_white(
    renderer: Callable[[Color], Render], scene: Scene, views: Sequence[View], data_factor: float
) -> list[Finding]:
    """Report a model without a record of its background whose renders fit better on white."""
    few = ([view for view in views if view.empty is not None] or views)[:_COMPARED]
    on_white = few
    if few[0].empty is not None:
        white = scene.replace(background=WHITE)
        images = [white[view.name] for view in few]
        on_white = load_views(white, images, data_factor=data_factor)
    dark, bright = _mean_psnr(renderer(BLACK), few), _mean_psnr(renderer(WHITE), on_white)
    if not bright > dark + _DIFFERENCE:
        return []
    text = "The model's background is not recorded, and its renders fit the photographs better on "
    text += f"white ({bright:.1f} dB) than on black ({dark:.1f} dB)."
    return [Finding("background", text, fix="Pass `background='white'` if it was trained on it.")]


@torch.no_grad()
def _mean_psnr(render: Render, views: Sequence[View]) -> float:
    shown = [(view, render(view)) for view in views]
    return float(
        np.mean(
            [
                psnr(im, photograph_tensor(v, im.device), mask_tensor(v, im.device))
                for v, im in shown
            ]
        )
    )


def _with_test_photographs(scene: Scene, test_every: int) -> Scene:
    """Like ``with_photographs``, but accept a scene with test photographs only."""
    try:
        return with_photographs(scene)
    except SceneNotFoundError:
        tested = scene.split(test_every)[1]
        there = with_photographs(scene.replace(images=tested))
        gone = {image.name for image in tested} - {image.name for image in there.images}
        images = tuple(image for image in scene.images if image.name not in gone)
        return scene.replace(images=images, absent=there.absent)


def evaluate_model(model: TrainedModel, **options: Any) -> EvalResult:
    """Score a model on its test views, with options of ``evaluate_views``; count its Gaussians."""
    result = evaluate_views(model.render, model.views, **options)
    return dataclasses.replace(
        result, num_gaussians=len(model.gaussians), model_bytes=model.gaussians.num_bytes
    )
