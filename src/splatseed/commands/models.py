"""A trained model as a user names it: a run folder, or a file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from splatseed.errors import SceneNotFoundError
from splatseed.train.record.folder import RunFolder

__all__ = ["config_of", "model_file"]


def model_file(path: Path) -> Path:
    """The file of a model's Gaussians; for a run, its result.

    Raises:
        SceneNotFoundError: There is none.
    """
    if path.is_file():
        return path
    folder = RunFolder(path)
    if path.is_dir() and folder.gaussians.is_file():
        return folder.gaussians
    there = "nothing there"
    if path.is_dir():
        there = "a run that has not finished" if folder.is_run else "a folder that is no run"
    raise SceneNotFoundError(
        f"{path} to be a finished run of splatseed train, or a file of Gaussians (.ply, .spz, ...)",
        found=there,
        fix="Name a file, or finish the run: splatseed train SCENE -o RUN --resume.",
    )


def config_of(path: Path) -> Mapping[str, Any]:
    """The config of a run, named by its folder or its result; empty for what belongs to no run.

    Raises:
        SceneFormatError: It cannot be read.
    """
    folder = RunFolder(path if path.is_dir() else path.parent)
    named = path.is_dir() or path == folder.gaussians
    return folder.read_config() if named and folder.is_run else {}
