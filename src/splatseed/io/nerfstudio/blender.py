"""A scene in two files, ``transforms_train.json`` and ``transforms_test.json``, as Blender's sets.

Promise: both become one scene, whose images are named with their folders (``train/r_0.png``), and
whose split is that of the files. Images that only ``transforms_val.json`` has are left out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

from splatseed.camera import Intrinsics
from splatseed.io.image_checks import image_warnings, lens_warnings
from splatseed.io.nerfstudio.scene import find_points
from splatseed.io.nerfstudio.transforms import Transforms, read_transforms
from splatseed.scene import Image, Scene, SceneSource, Split

_FILES = ("transforms_train.json", "transforms_test.json")


def is_blender(folder: Path) -> bool:
    """Whether a folder has both files."""
    return all((folder / name).is_file() for name in _FILES)


def read_blender(folder: Path) -> Scene:
    """Read both files, and the points in their space; the cloud may be empty.

    Raises:
        SceneNotFoundError: A file is missing.
        SceneFormatError: A file is not what its format promises.
    """
    parts = [read_transforms(folder / name) for name in _FILES]
    cameras: dict[tuple[object, ...], Intrinsics] = {}
    train, test = (tuple(_images(part, folder, cameras)) for part in parts)
    first_test = len(train) + 1
    test = tuple(dataclasses.replace(im, image_id=first_test + i) for i, im in enumerate(test))
    images = (*train, *test)
    points, points_path, notes = find_points(parts[0])
    warnings = (
        *dict.fromkeys((*parts[0].warnings, *parts[1].warnings, *notes)),
        *image_warnings(images, folder, folder),
        *lens_warnings(images),
    )
    return Scene(
        points,
        images,
        tuple(cameras.values()),
        source=SceneSource("transforms", folder, points_path, image_dir=folder),
        warnings=warnings,
        listed=Split(
            frozenset(image.name for image in train),
            frozenset(image.name for image in test),
            "pair of transforms_train.json and transforms_test.json",
        ),
    )


def _images(
    part: Transforms, folder: Path, cameras: dict[tuple[object, ...], Intrinsics]
) -> Iterator[Image]:
    """One file's images, from id 1, under names within the folder, with cameras shared by all."""
    for i, image in enumerate(part.images):
        lens = image.intrinsics
        key = (lens.model, lens.width, lens.height, lens.params)
        shared = cameras.setdefault(key, dataclasses.replace(lens, camera_id=len(cameras) + 1))
        path = part.image_dir / image.name
        name = (
            path.relative_to(folder.absolute()).as_posix() if _within(path, folder) else str(path)
        )
        yield dataclasses.replace(image, name=name, image_id=i + 1, intrinsics=shared)


def _within(path: Path, folder: Path) -> bool:
    return folder.absolute() in path.parents
