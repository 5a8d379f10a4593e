"""What a user names to look at: a scene, a run, or a file of Gaussians or points.

Promise: a file's content decides what it is; a model knows its scene if the run or the user names
it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.export import detect_format, read_model
from splatseed.io import load_scene
from splatseed.io.files import read_bytes
from splatseed.scene import Scene
from splatseed.splat.gaussians import Gaussians
from splatseed.train.folder import RunFolder

MODEL_SUFFIXES = (".spz", ".splat", ".sog", ".ksplat", ".glb")
_HEADER = 1 << 16


@dataclass(frozen=True, eq=False)
class Shown:
    """What a viewer shows: a scene, a model, or a model with its scene.

    Args:
        name: What to call it.
        path: What the user named.
        scene: Points, cameras and photographs; None for a lone model.
        gaussians: The model, in the scene's world; None for a lone scene.
        config: The run's, if it is a run.
    """

    name: str
    path: Path
    scene: Scene | None = None
    gaussians: Gaussians | None = None
    config: Mapping[str, Any] = field(default_factory=dict)

    @property
    def data_factor(self) -> int:
        """The factor by which the run downsampled its photographs; 1 if unknown."""
        return int(self.config.get("data_factor", 1))

    @property
    def test_every(self) -> int:
        """Every ``test_every``-th image, sorted by name, is a test view."""
        return int(self.config.get("test_every", 8))


def share_a_world(first: Shown, second: Shown) -> bool:
    """Whether the cameras of one also see the other: a photograph has the same pose in both.

    Also where the scene of one is unknown, as nothing speaks against it.
    """
    if not (first.scene and first.scene.images and second.scene):
        return True
    poses = {image.name: image.camera.world_from_cam for image in first.scene.images}
    return any(
        np.allclose(poses[image.name], image.camera.world_from_cam, rtol=1e-4, atol=1e-4)
        for image in second.scene.images
        if image.name in poses
    )


def open_shown(path: Path, scene_path: Path | None = None) -> Shown:
    """Read what a user names.

    Args:
        path: A scene, a run folder, or a file of Gaussians or points.
        scene_path: The scene that a model belongs to; by default the one named by its run, if that
            exists.

    Raises:
        SceneNotFoundError: ``path``, or the scene that the user names, does not exist.
        SceneFormatError: It is damaged, or cannot be shown.
    """
    folder = RunFolder(path)
    if path.is_dir() and folder.is_run:
        return _open_run(folder, scene_path)
    if path.is_file() and _is_model(path):
        scene = None if scene_path is None else load_scene(scene_path, require_points=False)
        return Shown(path.name, path, scene, read_model(path))
    return Shown(path.name, path, load_scene(path, require_points=False))


def _open_run(folder: RunFolder, scene_path: Path | None) -> Shown:
    if not folder.gaussians.is_file():
        raise SceneNotFoundError(
            f"{folder.path} to be a finished run of splatseed train",
            found="a run that has not finished",
            fix=f"Continue it: splatseed train SCENE -o {folder.path} --resume.",
        )
    config, scene = folder.read_config(), None
    named = scene_path or folder.scene_of(config)
    if named is not None:
        try:
            scene = load_scene(Path(named), require_points=False)
        except (SceneNotFoundError, SceneFormatError):
            if scene_path is not None:
                raise
    return Shown(folder.path.name, folder.path, scene, read_model(folder.gaussians), config)


def _is_model(path: Path) -> bool:
    """Whether a file holds Gaussians: a .ply of points is a scene."""
    if path.suffix.lower() in MODEL_SUFFIXES:
        return True
    data = read_bytes(path)
    if path.suffix.lower() == ".json" and b'"means"' not in data[:_HEADER]:
        return False
    try:
        kind = detect_format(path, data)
    except SceneFormatError:
        return False
    return kind != "ply" or b" rot_0\n" in data[:_HEADER].replace(b"\r", b"")
