"""The views of a scene in the frame of a model's file, whose Gaussians then stay as they are.

A file may be in its trainer's frame, or apart from the scene's origin; its cameras are moved there
instead.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from splatseed.errors import SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.masks import with_masks
from splatseed.io.origin import find_shift, offset_beside
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.camera_check import reference_points
from splatseed.photos.loading import load_views, user_cache_dir
from splatseed.photos.sizes import default_factor
from splatseed.photos.view import View, camera_views
from splatseed.progress import Progress, silent
from splatseed.sampling import evenly_spaced
from splatseed.scene import BLACK, Image, Scene
from splatseed.similarity import Similarity
from splatseed.splat.background import background_of
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import scene_from_model, translate_gaussians, view_in_model_frame
from splatseed.splat.training_frame import TrainingFrame, frame_of_model
from splatseed.training.config import has_run_poses, without_dropped
from splatseed.training.settings import TrainSettings

NO_CONFIG: Mapping[str, Any] = MappingProxyType({})
MAX_COMPARED = 6
"""Views from which a model before and after a change is rendered."""


class ModelViews(NamedTuple):
    """Views of a scene in the frame of a model's file."""

    train: tuple[View, ...]
    """Training views; without photographs, with masks."""
    test: tuple[View, ...]
    """Some of the test views, or of the training views if nothing was held out; with their
    photographs, if the scene has them."""
    frame: TrainingFrame
    """To render in."""
    scene: Scene
    """Its background is behind renders, and behind transparent pixels of the photographs."""
    file_from_scene: Similarity | None
    """From the scene's frame to the file's; None if they are the same."""
    label: str
    """What the views in ``test`` are."""


def find_model_views(
    path: Path,
    gaussians: Gaussians,
    scene_path: Path,
    config: Mapping[str, Any] = NO_CONFIG,
    progress: Progress = silent,
    excluded: Sequence[str] = (),
) -> ModelViews:
    """Find the views of the scene of a model.

    Args:
        path: The file of the model.
        gaussians: As read from it.
        scene_path: Its scene.
        config: Of its run, as of ``config_of``; gives the size of photographs, the test views and
            the masks.
        progress: Called with the name of a stage and its fraction done.
        excluded: Photographs to leave out, as for ``exclude``, beside those that the run left out.

    Raises:
        SceneNotFoundError: The scene is missing, or has no images.
        SceneFormatError: It is damaged, its cameras have lens distortion, or the model belongs to
            another scene.
    """
    masks = config.get("masks")
    scene = without_dropped(load_scene(scene_path, require_points=False), config)
    own, scene = has_run_poses(config, scene), with_masks(exclude(scene, excluded), masks)
    scene = scene.replace(background=background_of(path) or BLACK)
    photographed = False
    with suppress(SceneNotFoundError):
        scene, photographed = with_photographs(scene), True
    every = config.get("test_every")
    every = every if isinstance(every, int) and every != 1 else TrainSettings.test_every
    train, test = scene.split(every)
    if not train:
        raise SceneNotFoundError(
            f"{scene_path} to have images", found="none", fix="Name a scene with its cameras."
        )
    factor = config.get("data_factor")
    if not isinstance(factor, int | float) or factor < 1:
        factor = default_factor(scene.images)
    world = _file_from_scene(path, gaussians, scene, own=own)

    def views_of(images: Sequence[Image], *, pixels: bool) -> tuple[View, ...]:
        if pixels and photographed:
            found = load_views(
                scene, images, data_factor=factor, cache_dir=user_cache_dir(), progress=progress
            )
        else:
            found = camera_views(images, factor)
        return tuple(view_in_model_frame(world, view) for view in found)

    held_out = test or train
    compared = [held_out[i] for i in evenly_spaced(len(held_out), MAX_COMPARED)]
    masked = scene.masks is not None
    views = views_of(train, pixels=masked)
    points = reference_points(scene)
    return ModelViews(
        views,
        views_of(compared, pixels=True),
        frame_of_model(views, points if world is None else world.points(points), gaussians),
        scene,
        world,
        "test view" if test else "training view",
    )


def _file_from_scene(
    path: Path, gaussians: Gaussians, scene: Scene, *, own: bool
) -> Similarity | None:
    """Return the transform from the loaded scene's frame to the file's; None if they are the same.

    With ``own``, the model was trained at the scene's poses.
    """
    shift = find_shift(scene, gaussians.means, offset_beside(path), unrecorded=True)
    moved = translate_gaussians(gaussians, shift) if shift.any() else gaussians
    turned = None if own else scene_from_model(path, scene, moved)
    if turned is None and not shift.any():
        return None
    scene_from_file = Similarity(1.0, np.eye(3), shift)
    return (scene_from_file if turned is None else scene_from_file.then(turned)).inverse
