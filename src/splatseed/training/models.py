"""Trained models on disk: the folder of a finished run, or a file of Gaussians of any trainer."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import special_kind
from splatseed.io.load import is_scene
from splatseed.io.masks import NONE
from splatseed.text import quoted
from splatseed.training.folder import RunFolder


def model_file(path: Path) -> Path:
    """Return the file of a model's Gaussians; for a run, the file in its folder.

    Raises:
        SceneNotFoundError: There is none, or the run has not finished.
    """
    folder = RunFolder(path)
    for file in (path, folder.gaussians):
        if file.is_file():
            return file
    found, fix = special_kind(path) or "nothing there", "Check the path."
    if folder.is_run:
        found = "a run that has not finished"
        fix = "Finish it: train with the same output and `resume=True`."
    elif path.is_dir() and is_scene(path):
        found, fix = "a scene", f"Train it first: splatseed train {quoted(path)} -o RUN."
    elif path.is_dir():
        found, fix = "a folder that is no run", "Name a run, or the file itself."
    raise SceneNotFoundError(
        f"{path} to be a finished run of splatseed train, or a file of Gaussians (.ply, .spz, ...)",
        found=found,
        fix=fix,
    )


def near_plane_of(config: Mapping[str, Any]) -> float | None:
    """Return the near plane of a run's training, in scene units; None without one."""
    near = config.get("near_plane")
    return float(near) if isinstance(near, float) and 0 < near < math.inf else None


def config_of(path: Path) -> Mapping[str, Any]:
    """Read the config of a run, given its folder or its file of Gaussians; empty for other files.

    ``scene`` is the trained scene (with refined poses, if the run refined them), ``masks`` are the
    masks of that scene.

    Raises:
        SceneFormatError: The config is damaged.
    """
    folder = RunFolder(path if path.is_dir() else path.parent)
    if path not in (folder.path, folder.gaussians) or not folder.is_run:
        return {}
    config = folder.read_config()
    masks = config.get("masks")
    if not isinstance(masks, str | None):
        expected = f"masks of {folder.config} to name a folder"
        raise SceneFormatError(expected, found=str(masks), fix="Train again with `overwrite=True`.")
    if config.get("refine_poses") is True and masks != NONE:
        masks = None  # the scene with refined poses was written with its masks
    return {**config, "scene": folder.scene_of(config), "masks": masks}
