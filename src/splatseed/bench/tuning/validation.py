"""A scene without its test views, so that choices made on it have never seen them.

Promise: the written scene lists training views only, and its runs are scored on every eighth of
them; photographs are linked, and those of the test views never opened.
"""

from __future__ import annotations

from pathlib import Path

from splatseed.errors import SceneNotFoundError
from splatseed.io import load_originals, write_scene
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS
from splatseed.views.view import check_lens

LEAST_VIEWS = 4
"""Fewest training views of a scene: some to train on, and at least one to validate on."""


def make_validation_scene(scene_path: Path, target: Path, test_every: int = 8) -> Path:
    """Write a scene's training views as a scene of their own, unless that exists.

    Args:
        scene_path: The scene.
        target: The folder to write.
        test_every: Every n-th view is kept for testing.

    Returns:
        ``target``.

    Raises:
        SceneNotFoundError: There is no scene, or it has too few images.
        SceneFormatError: One of its files breaks its format, or a lens has distortion.
        OutputError: The folder cannot be written.
    """
    if target.is_dir():
        return target
    scene = load_originals(scene_path)
    for image in scene.images:
        check_lens(image, scene_path)
    train, _ = scene.split(test_every)
    if len(train) < LEAST_VIEWS:
        raise SceneNotFoundError(
            f"at least {LEAST_VIEWS} training views in {scene_path}, to hold some of them out",
            found=f"{len(train)}",
            fix="Tune a scene with more photographs.",
        )
    write_scene(
        scene.replace(images=train, listed=None),
        target,
        format="colmap",
        provenance={"command": "tune"},
    )
    for folder, names in ((target, ROOT_LISTS), (target / "sparse" / "0", MODEL_LISTS)):
        for name in names:  # of the whole scene's views
            (folder / name).unlink(missing_ok=True)
    return target
