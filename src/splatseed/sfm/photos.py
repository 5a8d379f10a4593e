"""Photographs: which images a folder holds, whether they can be read, and which have a pose.

Promise: every ``Photo`` returned was decoded to its last byte. pycolmap itself accepts a truncated
JPEG as a picture with a grey lower half, and skips files that it cannot read.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import VIDEO_SUFFIXES, open_file
from splatseed.io.staging import read_manifest
from splatseed.literal import describe_error, quoted
from splatseed.scene import Image, Scene

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
_FOREIGN_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".webp", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf",
     ".orf", ".rw2"}
)  # fmt: skip
_GREY = "of 16-bit or floating-point grey, as depth maps are"
_FOREIGN = "of a format that is not read"
_DEPTH_MODES = ("I", "F")  # Pillow's names for 16- and 32-bit grey
_SHOWN = 8


@dataclass(frozen=True)
class Photo:
    """An image file.

    Args:
        name: Path relative to the images folder, with forward slashes.
        width: Width in pixels as stored, before any EXIF rotation.
        height: Height in pixels as stored.
    """

    name: str
    width: int
    height: int


def find_photos(image_dir: Path) -> tuple[tuple[Photo, ...], Mapping[str, Sequence[str]]]:
    """The photographs below ``image_dir``, at least two.

    Hidden files are left out, and so are 16-bit and floating-point grey images: those are the
    depth maps of an RGB-D capture. Formats such as HEIC and cameras' raw ones are not read.

    Returns:
        The photographs, sorted by name, and the names of other images by what they are.

    Raises:
        SceneNotFoundError: The folder is missing or holds fewer than two photographs.
        SceneFormatError: An image cannot be decoded.
    """
    _check_folder(image_dir)
    relative = [path.relative_to(image_dir) for path in image_dir.rglob("*") if path.is_file()]
    files = [path for path in relative if not any(part.startswith(".") for part in path.parts)]
    names, foreign = (
        sorted(path.as_posix() for path in files if path.suffix.lower() in suffixes)
        for suffixes in (_SUFFIXES, _FOREIGN_SUFFIXES)
    )
    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the GIL
        read = pool.map(lambda name: _read_photo(image_dir, name), names)
        by_name = dict(zip(names, read, strict=True))
    photos = tuple(photo for photo in by_name.values() if photo is not None)
    grey = [name for name, photo in by_name.items() if photo is None]
    left_out = {what: them for what, them in ((_GREY, grey), (_FOREIGN, foreign)) if them}
    if len(photos) < 2:
        found = [f"{len(them)} {what} ({name_some(them)})" for what, them in left_out.items()]
        if others := len(files) - len(names) - len(foreign):
            found.append(f"{others} other files")
        raise SceneNotFoundError(
            f"at least 2 photographs ({' '.join(sorted(_SUFFIXES))}) in {image_dir}",
            found=" and ".join([f"{len(photos)}", *found]),
            fix="Save photographs as JPEG, or as PNG of 8 bits."
            if left_out
            else "Name the folder that holds the photographs of a scene.",
        )
    return photos, left_out


def match_poses(
    photos: Sequence[Photo], scene: Scene, image_dir: Path
) -> tuple[tuple[Photo, Image], ...]:
    """The photographs that ``scene`` has a pose for, with that pose.

    Raises:
        SceneNotFoundError: Fewer than two names are in both.
        SceneFormatError: A photograph has another size than its camera.
    """
    posed = {image.name: image for image in scene.images}
    pairs = tuple(
        (photo, replace(posed[photo.name], observations=None))  # not needed by the worker
        for photo in photos
        if photo.name in posed
    )
    if len(pairs) < 2:
        raise SceneNotFoundError(
            f"two or more images of {image_dir} among the {len(posed)} posed images "
            f"({name_some(sorted(posed)[:3])}, ...)",
            found=f"{len(pairs)} of {len(photos)} ({name_some([p.name for p in photos[:3]])}, ...)",
            fix="Names must be equal, relative to the images folder, suffix included.",
        )
    for photo, image in pairs:
        lens = image.intrinsics
        if (photo.width, photo.height) != (lens.width, lens.height):
            raise SceneFormatError(
                f"{image_dir / photo.name} to have the size of its camera {lens.camera_id}, "
                f"{lens.width}x{lens.height}",
                found=f"{photo.width}x{photo.height}",
                fix="Give the images that the poses were made for, at the same scale.",
            )
    return pairs


def name_some(names: Sequence[str]) -> str:
    """The first few of ``names``, and how many more there are."""
    shown = ", ".join(names[:_SHOWN])
    more = len(names) - _SHOWN
    return f"{shown} and {more} more" if more > 0 else shown


def _check_folder(image_dir: Path) -> None:
    if not image_dir.is_dir():
        raise SceneNotFoundError(
            f"a folder of photographs or a video at {image_dir}",
            found="a file that is neither" if image_dir.exists() else "nothing",
            fix="Name the folder that holds the photographs, or a video "
            f"({', '.join(sorted(VIDEO_SUFFIXES))}).",
        )
    if (kind := read_manifest(image_dir).get("command")) is not None:
        images = image_dir / "images"
        fix = f"Name its photographs: {quoted(images)}."
        raise SceneNotFoundError(
            f"a folder of photographs at {image_dir}",
            found=f"what splatseed {kind} wrote, with pictures of its own",
            fix=fix if images.is_dir() else "Name the folder that the photographs are in.",
        )


def _read_photo(image_dir: Path, name: str) -> Photo | None:
    """The photograph, decoded and found whole; None for a depth map."""
    path = image_dir / name
    try:
        with open_file(path) as file, PilImage.open(file) as image:
            if image.mode.startswith(_DEPTH_MODES):
                return None
            width, height = image.size
            image.draft("L", (1, 1))  # an eighth of the JPEG's size: checks all bytes, cheaply
            image.load()
    except (OSError, SyntaxError, ValueError, PilImage.DecompressionBombError) as error:
        raise SceneFormatError(
            f"{path} to be a readable image",
            found=describe_error(error),
            fix="Export it again, or take it out of the folder.",
        ) from error
    return Photo(name, width, height)
