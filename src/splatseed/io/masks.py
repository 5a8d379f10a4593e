"""Masks: which pixels of photographs count; reading and writing them.

A mask is an image of its photograph's shape, 0 where a pixel is masked, as COLMAP and nerfstudio
take it; ``mask_files`` finds them. Pixels of a photograph that are not opaque are masked, too.
Promise: a pixel of a smaller copy, or of an undistorted one, counts only if all that it was made
from count.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError, SceneNotFoundError, SplatseedError
from splatseed.io.bit_depth import is_16_bit, opaque_value, read_16_bit
from splatseed.io.depth_maps import Undistortion
from splatseed.io.files import files_below, open_file, read_bytes, translate_errors
from splatseed.io.mask_files import find_masks, find_own_masks, masks_among
from splatseed.io.photograph import has_alpha, open_photograph, photograph_bytes
from splatseed.scene import Masks, Scene
from splatseed.text import counted

NONE, INVERTED = "none", "inverted"
"""Choices of masks besides a folder; ``inverted:DIR`` inverts those of a folder."""
_LISTED = "masks of the scene's images, named a.jpg.png or a.png for a.jpg,"


def with_masks(scene: Scene, choice: str | None) -> Scene:
    """The scene with the masks of a choice, as ``--masks`` takes it; None: as it is.

    Raises:
        SceneNotFoundError: There are no such masks.
    """
    if choice is None or choice == NONE:
        return scene if choice is None else scene.replace(masks=None)
    inverted = choice == INVERTED or choice.startswith(f"{INVERTED}:")
    place = choice.removeprefix(INVERTED).removeprefix(":") if inverted else choice
    own, notes = scene.masks or Masks({}), list[str]()
    files: Mapping[str, Path] = own.files
    folder = Path(place).absolute() if place else None
    if folder is not None:
        names = [image.name for image in scene.images]
        image_dir = scene.source.image_dir if scene.source else None
        files, notes = find_masks(names, folder, image_dir, named=True)
        choice = f"{INVERTED}:{folder}" if inverted else str(folder)
    if not files:
        where = f"in {folder}" if folder else "beside its photographs"
        found = "none" if folder is None or folder.is_dir() else "no such folder"
        fix = "Name the folder that masks lie in, or leave --masks out."
        raise SceneNotFoundError(f"{_LISTED} {where}", found=found, fix=fix)
    masks = replace(own, files=files, inverted=inverted, choice=choice)
    return scene.replace(masks=masks, warnings=(*scene.warnings, *notes))


def mask_choice(scene: Scene) -> str | None:
    """The choice with which ``with_masks`` gives a scene read anew the masks of this one."""
    return NONE if scene.masks is None else scene.masks.choice


def with_own_masks(scene: Scene) -> Scene:
    """A scene that was just read, with the masks near its photographs."""
    folder = scene.source.image_dir if scene.source else None
    if scene.source is None or folder is None or scene.masks is not None:
        return scene
    names = [image.name for image in scene.images]
    files, notes = find_own_masks(names, folder, scene.source.root)
    notes += _resized(files, folder)
    return scene.replace(masks=Masks(files), warnings=(*scene.warnings, *notes))


def masks_near(photographs: Path) -> tuple[Masks, list[str]]:
    """The masks near a folder of photographs, and notes for the user."""
    folder = photographs.absolute()
    if not photographs.is_dir():
        return Masks({}), []
    below = (path.relative_to(photographs).as_posix() for path in files_below(photographs))
    names = sorted(below)
    names = sorted(set(names) - masks_among(names))
    files, notes = find_own_masks(names, folder, folder.parent)
    if files:
        where = next(iter(files.values())).parent
        notes = [f"{counted(len(files), 'photograph')} with a mask in {where}.", *notes]
    return Masks(files), notes


def _resized(files: Mapping[str, Path], folder: Path) -> list[str]:
    """A note if masks have another size than their photographs; only two headers are opened."""
    for name, path in files.items():
        with suppress(SplatseedError, OSError, ValueError):
            sizes = [_size(path), _size(folder / name)]
            if sizes[0] == sizes[1]:
                return []
            mask, photograph = (f"{width} x {height}" for width, height in sizes)
            return [f"Masks are resized to their photographs: {path} has {mask}, not {photograph}."]
    return []


def _size(path: Path) -> tuple[int, int]:
    with open_file(path) as file, PilImage.open(file) as picture:
        return picture.size


def read_mask(
    masks: Masks | None, name: str, photograph: Path, factor: int = 1
) -> Bool[np.ndarray, "h w"] | None:
    """Which pixels of a photograph, reduced by a whole factor, count; None: all.

    Args:
        masks: The scene's.
        name: The image's name.
        photograph: Its file.
        factor: Each pixel is a block of ``factor``^2 of the file.

    Raises:
        SceneNotFoundError: The mask's file is gone.
        SceneFormatError: It is no image, has another size than the photograph, or masks all of it.
    """
    if masks is None:
        return None
    path, parts = masks.files.get(name), []
    if path is not None:
        with translate_errors(path, "a mask, an image of one channel"):
            picture = open_photograph(path, read_bytes(path))
            marked = _read_counts(picture) != masks.inverted
        size = open_photograph(photograph, photograph_bytes(photograph)).size
        if not _same_shape(picture.size, size):
            raise SceneFormatError(
                f"the mask {path} to have the size of {name}, {size[0]} x {size[1]}",
                found=f"{picture.size[0]} x {picture.size[1]}",
                fix="Make it from that photograph, without cropping or turning.",
            )
        parts.append(_fitted(marked, size))
    if masks.alpha and (opaque := _opaque(photograph)) is not None:
        parts.append(opaque)
    if not parts:
        return None
    counts = np.logical_and.reduce(parts)
    rows, columns = counts.shape[0] // factor, counts.shape[1] // factor
    blocks = counts[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor)
    counts = blocks.all(axis=(1, 3))
    if counts.size and not counts.any():
        reduced = "" if factor == 1 else f", reduced by a factor of {factor}"
        raise SceneFormatError(
            f"pixels of {name} that count by its mask, {path or photograph}{reduced}",
            found="none",
            fix="Correct the mask, or take the photograph out of the scene. If 0 is what counts, "
            f"pass --masks {INVERTED}.",
        )
    return None if counts.all() else np.asarray(counts)


def _read_counts(picture: PilImage.Image) -> Bool[np.ndarray, "H W"]:
    """Which pixels of a mask are neither 0 nor transparent."""
    if picture.mode.startswith(("I", "F")):  # which Pillow's conversion clips
        return np.asarray(np.asarray(picture) > 0)
    least = 128 if picture.format == "JPEG" else 1  # whose 0 may be stored as a little more
    counts = np.asarray(picture.convert("L")) >= least
    if has_alpha(picture):
        counts &= np.asarray(picture.convert("RGBA").getchannel("A")) > 0
    return np.asarray(counts)


def _same_shape(size: tuple[int, int], other: tuple[int, int]) -> bool:
    """Whether two sizes differ by a scale, within a pixel."""
    return abs(size[0] * other[1] - size[1] * other[0]) <= max(*size, *other)


def _fitted(counts: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """A mask at another size: a pixel counts if all those of the mask in it do."""
    for axis, length in enumerate(size[::-1]):
        count = counts.shape[axis]
        if count != length:
            edges = np.arange(length + 1) * count
            start, stop = edges[:-1] // length, -(-edges[1:] // length)
            masked = np.cumsum(np.insert(~counts, 0, False, axis=axis), axis=axis)
            counts = masked.take(start, axis=axis) == masked.take(stop, axis=axis)
    return counts


def _opaque(photograph: Path) -> Bool[np.ndarray, "H W"] | None:
    """Which pixels are fully opaque; None where none can be otherwise."""
    if photograph.suffix.lower() in {".jpg", ".jpeg"}:  # not worth reading
        return None
    picture = open_photograph(photograph, photograph_bytes(photograph))
    if not has_alpha(picture) or picture.mode.startswith(("I", "F")):
        return None
    with translate_errors(photograph, "an image, neither cut short nor damaged"):
        if is_16_bit(picture):
            alpha = read_16_bit(photograph_bytes(photograph))[..., -1]
            return np.asarray(alpha == opaque_value(alpha))
        return np.asarray(np.asarray(picture.convert("RGBA").getchannel("A")) == 255)


def write_masks(
    masks: Masks | None,
    image_dir: Path,
    names: Iterable[str],
    folder: Path,
    lenses: Mapping[str, tuple[Intrinsics, Intrinsics]] | None = None,
) -> None:
    """Write the masks of some images as COLMAP names them, 0 or 255.

    If any has pixels that do not count, all get a mask: COLMAP fails and nerfstudio stops where one
    is missing. With ``lenses``, that of each photograph and that of its undistorted copy, they fit
    the copies.
    """
    whole = []
    for name in names:
        counts = read_mask(masks, name, image_dir / name)
        if counts is None:
            whole.append(name)
        else:
            fitting = _undistorted(counts, *lenses[name]) if lenses else counts
            _write(folder / f"{name}.png", fitting)
    for name in whole if folder.is_dir() else ():
        width, height = open_photograph(image_dir / name, photograph_bytes(image_dir / name)).size
        if lenses:
            width, height = lenses[name][1].width, lenses[name][1].height
        _write(folder / f"{name}.png", np.ones((height, width), np.bool_))


def _write(path: Path, counts: Bool[np.ndarray, "H W"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    PilImage.fromarray(np.where(counts, 255, 0).astype(np.uint8)).save(path)


def _undistorted(
    counts: Bool[np.ndarray, "H W"], lens: Intrinsics, pinhole: Intrinsics
) -> Bool[np.ndarray, "h w"]:
    """A mask in the pixels of an undistorted photograph."""
    if lens == pinhole:  # the photograph is a copy
        return counts
    # Colours come from the four pixels around a place, which lie within one pixel of the nearest.
    windows = sliding_window_view(np.pad(counts, 1, constant_values=True), (3, 3))
    sure = np.asarray(windows.all(axis=(2, 3)))
    moved = Undistortion(lens, {"": pinhole}).apply("", sure.astype(np.float32))
    return np.asarray(moved == 1)  # NaN beyond the image, where the copy is black
