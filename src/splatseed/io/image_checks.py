"""Warnings about a scene's images and lenses before training.

Promise: only the headers of a few image files are opened; problems are returned, never raised.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from splatseed.io.files import odd_kind, open_file, other_spelling
from splatseed.literal import agreeing, told
from splatseed.scene import Image, Scene

_MAX_OPENED = 32  # files whose size is compared


def image_warnings(images: Sequence[Image], image_dir: Path | None, root: Path) -> list[str]:
    """What is wrong with the image files against their records; only a few headers are opened.

    Args:
        images: The images.
        image_dir: The folder their names are relative to, if it exists.
        root: The scene's folder.
    """
    if not images:
        return []
    if image_dir is None:
        return ["The images folder is missing; points can be made, but nothing can be trained."]
    outside = [im.name for im in images if _leads_out(im.name, image_dir, root)]
    missing = {im.name: None for im in images if not (image_dir / im.name).is_file()}
    warnings = []
    if missing:
        first, are = next(iter(missing)), agreeing(len(missing), "is", "are")
        near = other_spelling(image_dir / first)
        hint = f"; {near} is there, but names must be equal to the letter" if near else ""
        if kind := odd_kind(image_dir / first):
            hint = f", which is {kind}"
        warnings.append(
            f"{len(missing)} of {len(images)} images {are} missing in {image_dir}, the first is "
            f"{first}{hint}."
        )
    if outside:
        lie = agreeing(len(outside), "lies", "lie")
        warnings.append(
            f"{len(outside)} of {len(images)} images {lie} outside of {root}, the first is "
            f"{outside[0]}."
        )
    present = [im for im in images if im.name not in missing]
    sample = present[:: -(-len(present) // _MAX_OPENED) or 1]  # evenly spaced, the first among them
    wrong = [text for im in sample if (text := _size_warning(im, image_dir))]
    return [*warnings, *wrong[:1]]


def _leads_out(name: str, image_dir: Path, root: Path) -> bool:
    """Whether an image's name leads out of its scene's folder.

    Links, which somebody made on purpose, may lead anywhere.
    """
    path, around = (os.path.abspath(each) for each in (image_dir / name, root))  # noqa: PTH100  (without following links)
    return os.path.commonpath([path, around]) != around


def _size_warning(image: Image, image_dir: Path) -> str | None:
    from PIL import Image as PilImage, UnidentifiedImageError  # noqa: PLC0415  (slow to import)

    try:
        with open_file(image_dir / image.name) as file, PilImage.open(file) as picture:
            size = picture.size
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnidentifiedImageError, PilImage.DecompressionBombError) as error:
        return f"{image.name} cannot be read: {told(error)}."
    expected = (image.intrinsics.width, image.intrinsics.height)
    if size == expected:
        return None
    return (
        f"{image.name} has {size[0]} x {size[1]} pixels, its camera {image.intrinsics.camera_id}"
        f" {expected[0]} x {expected[1]}; some trainers rescale, others fail."
    )


def warnings_but_lens(scene: Scene) -> list[str]:
    """What is wrong with a scene for a command that takes lens distortion out."""
    lens = lens_warnings(scene.images)
    return [warning for warning in scene.warnings if warning not in lens]


def lens_warnings(images: Sequence[Image]) -> list[str]:
    """A sentence on lens distortion, which not every trainer supports."""
    models = sorted({im.intrinsics.model for im in images if not im.intrinsics.is_pinhole})
    if not models:
        return []
    lenses = f"Cameras have lens distortion ({', '.join(models)})"
    trainers = "splatseed train, graphdeco's trainer and OpenSplat need PINHOLE cameras"
    return [f"{lenses}; {trainers}: undistort the scene with splatseed undistort SCENE -o OUT."]
