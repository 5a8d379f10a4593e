"""Photographs against their camera records: which are there, and whether they have the right size.

A photograph *fits* its camera record if it has its size, or is a resized copy. Promise: sizes are
of pixels as stored, as COLMAP and trainers take them: EXIF's orientation is ignored; only headers
of files are read.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import open_file, similar_name, special_kind, translate_errors
from splatseed.io.photograph import COPY_AGAIN, photograph_bytes, photograph_folder
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted, name_some

Size = tuple[int, int]
"""Width and height."""

ASPECT_SLACK = 0.02
"""By how much the aspect ratio of a resized copy may differ from its camera's."""
ROUNDING = 2.0
"""A copy that is off by more pixels was not just resized, as each side is rounded by 1 at most."""
_SIDEWAYS = frozenset({5, 6, 7, 8})
"""EXIF's orientations that swap width and height when a viewer shows the photograph."""
_NAMED = 3  # photographs that a sentence names


def with_photographs(scene: Scene) -> Scene:
    """The scene with those images whose photographs are there; others become ``absent``.

    Raises:
        SceneNotFoundError: Fewer than half of the photographs are there.
    """
    folder = photograph_folder(scene)
    gone = tuple(image.name for image in scene.images if not (folder / image.name).is_file())
    if not gone:
        return scene
    if 2 * len(gone) > len(scene.images):
        raise SceneNotFoundError(
            f"at least half of the scene's {len(scene.images)} photographs in {folder}",
            found=f"{len(scene.images) - len(gone) or 'none'}; missing: {name_some(gone, _NAMED)}",
            fix="Put them there, under the names that the model has.",
        )
    there = tuple(image for image in scene.images if image.name not in {*gone})
    return scene.replace(images=there, absent=(*scene.absent, *gone))


def photograph_size(path: Path) -> Size:
    """Width and height of an image file; errors as ``photograph_bytes``'s and ``open``'s."""
    if not path.is_file():
        photograph_bytes(path)  # raises the error of a missing file
    with translate_errors(path, "an image", fix=COPY_AGAIN), open_file(path) as file:
        return PilImage.open(file).size


def fits(lens: Intrinsics, size: Size) -> bool:
    """Whether a photograph of this size can be its camera's, or a resized copy."""
    record = (lens.width, lens.height)
    if size == record[::-1] != record:  # turned, even if it is nearly square
        return False
    stretch = size[0] * lens.height / (size[1] * lens.width)
    return abs(stretch - 1) <= ASPECT_SLACK or _off(lens, size) <= ROUNDING / 2


def _off(lens: Intrinsics, size: Size) -> float:
    """By how many pixels of the file one of its sides differs from that of a resized copy."""
    width, height = size[1] * lens.width / lens.height, size[0] * lens.height / lens.width
    return min(abs(size[0] - width), abs(size[1] - height))


def check_sizes(images: Sequence[Image], folder: Path) -> dict[str, Size]:
    """The sizes of the photographs of some images, all of which fit their records.

    Raises:
        SceneNotFoundError: One is missing.
        SceneFormatError: One does not fit, or is no image.
    """
    sizes = {image.name: photograph_size(folder / image.name) for image in images}
    wrong = [image for image in images if not fits(image.intrinsics, sizes[image.name])]
    if wrong:
        lens, (width, height) = wrong[0].intrinsics, sizes[wrong[0].name]
        what, fix = _misfit(lens, (width, height), folder / wrong[0].name)
        more = len(wrong) - 1
        others = f"; {more} more of {counted(len(images), 'photograph')} do not fit either"
        raise SceneFormatError(
            f"{folder / wrong[0].name} to have the size of its camera {lens.camera_id}, "
            f"{lens.width} x {lens.height}, or to be a resized copy",
            found=f"{width} x {height}: {what}{others if more else ''}",
            fix=fix,
        )
    return sizes


def _misfit(lens: Intrinsics, size: Size, path: Path) -> tuple[str, str]:
    """Why a photograph does not fit its camera record, and what to do about it."""
    if not fits(lens, size[::-1]):
        return "cropped, or stretched", (
            "Use the photographs that the poses were made from, or resized copies of them. A crop "
            "needs a camera record of its own: width, height and principal point."
        )
    if orientation := _sideways(path):
        return f"stored turned, with EXIF orientation {orientation}", (
            "The poses are of upright pixels: turn copies as EXIF says (mogrify -auto-orient, of "
            "ImageMagick), or find poses of the files as they are (splatseed sfm)."
        )
    return "turned, width and height are swapped", (
        "Turn them back, or find poses of the files as they are (splatseed sfm)."
    )


def _sideways(path: Path) -> int:
    """EXIF's orientation if it swaps width and height, else 0."""
    try:
        with open_file(path) as file, PilImage.open(file) as picture:
            orientation = int(picture.getexif().get(0x0112, 0))
    except Exception:  # noqa: BLE001  (EXIF is whatever a camera wrote; Pillow raises anything)
        return 0
    return orientation if orientation in _SIDEWAYS else 0


def image_warnings(images: Sequence[Image], image_dir: Path | None, root: Path) -> list[str]:
    """What is wrong with the image files against their records; only headers are read."""
    if not images:
        return []
    if image_dir is None:
        dead = root / "images" if (root / "images").is_symlink() else None
        gone = f"{dead} leads to {dead.readlink()}, which is not there" if dead else "is missing"
        return [f"The images folder {gone}; points can be made, but nothing can be trained."]
    missing = {im.name: None for im in images if not (image_dir / im.name).is_file()}
    warnings = [_missing_warning([*missing], len(images), image_dir)] if missing else []
    # Links, which somebody made on purpose, may lead anywhere: they are not followed.
    around = os.path.abspath(root)  # noqa: PTH100
    paths = {im.name: os.path.abspath(image_dir / im.name) for im in images}  # noqa: PTH100
    outside = [n for n, path in paths.items() if os.path.commonpath([path, around]) != around]
    if outside:
        lie = agreeing(len(outside), "lies", "lie")
        warnings.append(
            f"{len(outside)} of {len(images)} images {lie} outside of {root}, the first is "
            f"{outside[0]}."
        )
    return [*warnings, *_size_warnings([im for im in images if im.name not in missing], image_dir)]


def _missing_warning(missing: Sequence[str], count: int, image_dir: Path) -> str:
    first, are = missing[0], agreeing(len(missing), "is", "are")
    near, kind = similar_name(image_dir / first), special_kind(image_dir / first)
    hint = f"; {near} is there, but names must be equal to the letter" if near else ""
    hint = f"; {first} is {kind}" if kind else hint
    hint = "; folders are separated by /, as on Linux, not by \\" if "\\" in first else hint
    which = f"{len(missing)} of {count} images {are} missing in {image_dir}, and left out"
    return f"{which} ({name_some(missing, _NAMED)}){hint}."


def _size_warnings(images: Sequence[Image], image_dir: Path) -> list[str]:
    """A sentence on each way in which files differ from their records, about the first such."""
    sizes, warnings = file_sizes(images, image_dir), list[str]()
    if len(sizes) < len(images):
        first = next(image.name for image in images if image.name not in sizes)
        try:
            photograph_size(image_dir / first)
        except SceneFormatError as error:
            warnings.append(f"{first} cannot be read: {error.found}.")
    other = [im for im in images if sizes.get(im.name, _own(im)) != _own(im)]
    fitting = [im for im in other if fits(im.intrinsics, sizes[im.name])]
    stretched = [im for im in fitting if _off(im.intrinsics, sizes[im.name]) > ROUNDING]
    all_of = counted(len(images), "photograph")
    if wrong := [im for im in other if im not in fitting]:
        what = _misfit(wrong[0].intrinsics, sizes[wrong[0].name], image_dir / wrong[0].name)[0]
        warnings.append(
            f"{len(wrong)} of {all_of} {agreeing(len(wrong), 'does', 'do')} not fit the camera: "
            f"{_against(wrong[0], sizes)} ({what}). Nothing can be trained on them."
        )
    if stretched:
        (width, height), lens = sizes[stretched[0].name], stretched[0].intrinsics
        warnings.append(
            f"{len(stretched)} of {all_of} {agreeing(len(stretched), 'has', 'have')} another shape "
            f"than the camera: {_against(stretched[0], sizes)}. They are taken as resized, and "
            f"stretched by {abs(width * lens.height / (height * lens.width) - 1):.1%}; if they were"
            " cropped, give them a camera of their own size."
        )
    elif fitting:
        warnings.append(f"{_against(fitting[0], sizes)}; some trainers rescale, others fail.")
    return warnings


def _own(image: Image) -> Size:
    return image.intrinsics.width, image.intrinsics.height


def _against(image: Image, sizes: Mapping[str, Size]) -> str:
    lens, size = image.intrinsics, sizes[image.name]
    record = f"its camera {lens.camera_id} {lens.width} x {lens.height}"
    return f"{image.name} has {size[0]} x {size[1]} pixels, {record}"


def file_sizes(images: Sequence[Image], folder: Path) -> Mapping[str, Size]:
    """The sizes of those photographs that are there and can be read, by name."""
    sizes = {}
    for image in images:
        try:
            sizes[image.name] = photograph_size(folder / image.name)
        except (SceneNotFoundError, SceneFormatError):
            continue
    return sizes


def resized_to(images: Sequence[Image], sizes: Mapping[str, Size]) -> tuple[Image, ...]:
    """Images with cameras and features in pixels of photographs of these sizes, by name.

    Where photographs of several sizes share a camera record, each size gets a record of its own,
    with an id above all others. An image without a size, or whose photograph does not fit, stays.
    """
    free = itertools.count(1 + max((image.intrinsics.camera_id for image in images), default=0))
    records: dict[tuple[Intrinsics, Size], Intrinsics] = {}
    used, changed = set[int](), list[Image]()
    for image in images:
        lens, found = image.intrinsics, image.observations
        size = sizes.get(image.name, _own(image))
        size = size if fits(lens, size) else _own(image)
        if (lens, size) not in records:
            camera_id = next(free) if lens.camera_id in used else lens.camera_id
            used.add(camera_id)
            records[lens, size] = replace(lens.resized(*size), camera_id=camera_id)
        if found is not None and size != _own(image):
            found = replace(found, xy=found.xy * (np.array(size) / _own(image)))
        own = records[lens, size]
        same = own == lens
        changed.append(image if same else replace(image, intrinsics=own, observations=found))
    return tuple(changed)
