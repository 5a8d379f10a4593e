"""Which of several COLMAP models is a scene's: the one with most images.

COLMAP's mapper writes a model for each group of photographs that it could connect, into folders
``0``, ``1`` and so on, which are not ordered by size.
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from splatseed.errors import SplatseedError
from splatseed.io.colmap import LEAST_IMAGE_BYTES, find_model, model_file, read_colmap_scene
from splatseed.io.files import numbered_lines, open_file
from splatseed.scene import Scene
from splatseed.text import counted

_UNKNOWN = -1


def scene_model(root: Path) -> Path | None:
    """The model of a scene's folder, of ``sparse``, or of a folder of numbered models."""
    largest = largest_model(root / "sparse")
    return largest or find_model(root / "sparse", root) or largest_model(root)


def nested_model(root: Path) -> Path | None:
    """The model in ``colmap/sparse``, where nerfstudio puts it."""
    return largest_model(root / "colmap/sparse") or find_model(root / "colmap/sparse")


def largest_model(folder: Path) -> Path | None:
    """The model with most images in a folder's numbered ones; of equals, the first."""
    return next(iter(ranked_models(folder)), None)


def ranked_models(folder: Path) -> list[Path]:
    """The models in a folder's numbered ones, those with most images first."""
    models = numbered_models(folder)
    return models if len(models) < 2 else sorted(models, key=lambda each: -count_images(each))


def numbered_models(folder: Path) -> list[Path]:
    """The folders ``0``, ``1`` and so on that hold a model, by number."""
    if not folder.is_dir():
        return []
    numbered = [each for each in folder.iterdir() if each.name.isdecimal()]
    return [each for each in sorted(numbered, key=lambda p: int(p.name)) if find_model(each)]


def count_images(model_dir: Path) -> int:
    """How many images a model promises; -1 if the file is damaged."""
    path = model_file(model_dir, "images")
    if path is None:
        return 0
    with suppress(SplatseedError, OSError):
        if path.suffix == ".txt":
            return _count_lines(path)
        with open_file(path) as file:
            count = int.from_bytes(file.read(8), "little")
        size = path.stat().st_size
        if size >= 8 and count <= (size - 8) // LEAST_IMAGE_BYTES:
            return count
    return _UNKNOWN


def _count_lines(path: Path) -> int:
    """Images of an ``images.txt``: each is a line, and one of features, which may be blank."""
    count, lines = 0, numbered_lines(path)
    for _, line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            count += 1
            next(lines, None)
    return count


def read_model(model_dir: Path) -> Scene:
    """The scene of a model, with a note if it is one of several."""
    scene, models = read_colmap_scene(model_dir), numbered_models(model_dir.parent)
    if len(models) < 2 or not model_dir.name.isdecimal():
        return scene
    counts = {each.name: count_images(each) for each in models}
    shown = [
        f"{name} with {counted(count, 'image') if count != _UNKNOWN else 'damaged images'}"
        for name, count in counts.items()
    ]
    other = next(each for each in ranked_models(model_dir.parent) if each.name != model_dir.name)
    there = f"{model_dir.parent} has {len(models)} models, {', '.join(shown)}"
    note = f"{there}: {model_dir.name} is read. To read another, name it, such as {other}."
    return scene.replace(warnings=(*scene.warnings, note))
