"""A trained model as a user names it, a run folder or a file, and where its files may go."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import odd_kind
from splatseed.io.load import is_scene
from splatseed.io.masks import NONE
from splatseed.io.staging import check_apart, check_parents
from splatseed.text import quoted
from splatseed.training.folder import RunFolder


def model_file(path: Path) -> Path:
    """The file of a model's Gaussians; for a run, its result."""
    folder = RunFolder(path)
    for file in (path, folder.gaussians):
        if file.is_file():
            return file
    found, fix = odd_kind(path) or "nothing there", "Check the path."
    if folder.is_run:
        found = "a run that has not finished"
        fix = f"Finish it: splatseed train SCENE -o {quoted(path)} --resume."
    elif path.is_dir() and is_scene(path):
        found, fix = "a scene", f"Train it first: splatseed train {quoted(path)} -o RUN."
    elif path.is_dir():
        found, fix = "a folder that is no run", "Name a run, or the file itself."
    raise SceneNotFoundError(
        f"{path} to be a finished run of splatseed train, or a file of Gaussians (.ply, .spz, ...)",
        found=found,
        fix=fix,
    )


def check_free(
    path: Path,
    *,
    overwrite: bool = False,
    protect: Sequence[Path] = (),
    fix: str = "Pass --overwrite to replace it, or choose another name.",
) -> None:
    """Refuse a file that may not be written, before any work is done.

    It may not be one of ``protect`` or lie in one. ``fix`` is told where a file is there.
    """
    check_apart(path, protect)
    check_parents(path)
    if path.exists() and not path.is_file():
        found = "a folder" if path.is_dir() else "no regular file"
        raise OutputError(f"a file name at {path}", found=found, fix="Choose another name.")
    if path.exists() and not overwrite:
        raise OutputError(f"no file at {path}", found="one", fix=fix)


def near_plane_of(config: Mapping[str, Any]) -> float | None:
    """The near plane that a run was trained with, in its world; None for others."""
    near = config.get("near_plane")
    return float(near) if isinstance(near, float) and 0 < near < math.inf else None


def config_of(path: Path) -> Mapping[str, Any]:
    """The config of a run, named by its folder or its result; empty for what belongs to no run.

    Its scene is the one that was trained, and its masks are those of that scene.
    """
    folder = RunFolder(path if path.is_dir() else path.parent)
    if path not in (folder.path, folder.gaussians) or not folder.is_run:
        return {}
    config = folder.read_config()
    masks = config.get("masks")
    if not isinstance(masks, str | None):
        expected = f"masks of {folder.config} to name a folder"
        raise SceneFormatError(expected, found=str(masks), fix="Train again with --overwrite.")
    if config.get("refine_poses") is True and masks != NONE:
        masks = None  # the scene with refined poses has the chosen ones
    return {**config, "scene": folder.scene_of(config), "masks": masks}
