"""A scene without its test views, so that what is chosen on it has never seen them.

Promise: the scene that is written names training views alone, and every eighth of these is what
its runs are scored on; photographs are linked, those of the test views are never opened.
"""

from __future__ import annotations

from pathlib import Path

from splatseed.errors import SceneNotFoundError
from splatseed.io import load_scene, write_scene
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS

__all__ = ["LEAST_VIEWS", "make_validation_scene"]

LEAST_VIEWS = 4
"""Training views that a scene must have: some to train on, one or more to validate on."""


def make_validation_scene(scene_path: Path, target: Path, test_every: int = 8) -> Path:
    """Write a scene's training views as a scene of their own, unless it is there.

    Args:
        scene_path: The scene.
        target: The folder to write.
        test_every: Which views are kept for the test.

    Returns:
        ``target``.

    Raises:
        SceneNotFoundError: There is no scene, or it has too few images.
        SceneFormatError: A file of it is not what its format promises.
        OutputError: The folder cannot be written.
    """
    if target.is_dir():
        return target
    scene = load_scene(scene_path)
    train, _ = scene.split(test_every)
    if len(train) < LEAST_VIEWS:
        raise SceneNotFoundError(
            f"at least {LEAST_VIEWS} training views in {scene_path}, to hold some of them out",
            found=f"{len(train)}",
            fix="Tune a scene with more photographs.",
        )
    points = scene.points.originals
    write_scene(
        scene.replace(points=points, images=train, listed=None),
        target,
        format="colmap",
        provenance={"command": "tune"},
    )
    for folder, names in ((target, ROOT_LISTS), (target / "sparse" / "0", MODEL_LISTS)):
        for name in names:  # of the whole scene's views
            (folder / name).unlink(missing_ok=True)
    return target
