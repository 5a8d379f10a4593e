"""Read and write masks of photographs.

A mask is an image of its photograph's aspect ratio; 0 means masked, as in COLMAP and nerfstudio. In
code, True marks valid pixels. Promise: a pixel of a reduced or undistorted copy is valid only if
all of its source pixels are. ``mask_files`` finds the files.

*Transparent* pixels, of an alpha below ``photograph.OPAQUE``, are either masked, or *empty*: they
count as black, the background of renders, so that training learns that nothing is there. They are
empty in photographs of an object that is cut out, where a large area is transparent, another one in
each photograph. Small holes, and borders that undistortion or a lens leaves, are masked. In either
case they get no seeds.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt8
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image as PilImage

from splatseed.camera import Intrinsics, same_shape
from splatseed.errors import SceneFormatError, SceneNotFoundError, SplatseedError
from splatseed.findings import Finding, without_kinds
from splatseed.io.depth_maps import Undistortion
from splatseed.io.downsampling import area_means
from splatseed.io.files import files_below, read_bytes, translate_errors
from splatseed.io.mask_files import SUFFIXES, find_masks, find_own_masks, masks_among
from splatseed.io.photograph import (
    OPAQUE,
    has_alpha,
    open_photograph,
    photograph_bytes,
    read_alpha,
    read_transparent,
)
from splatseed.io.photograph_checks import photograph_size
from splatseed.runtime.fingerprint import fingerprint
from splatseed.sampling import strided
from splatseed.scene import Masks, Scene
from splatseed.text import counted

NONE, INVERTED, ALPHA = "none", "inverted", "alpha"
"""Values of ``masks`` besides a folder; ``inverted:DIR`` inverts the masks of a folder.

With ``none`` transparent pixels are empty, with ``alpha`` they are masked."""
_LISTED = "masks of the scene's images, named a.jpg.png or a.png for a.jpg,"
_LOSSY = ("JPEG", "MPO", "WEBP")
"""Formats that may store 0 as slightly more."""
_SAMPLE = 5
"""Masks that are read with a scene."""
_MOST = 0.5
"""Share of masked pixels from which on masks may be inverted ones."""
_MOSTLY_MASKED, TRANSPARENT = "mostly-masked", "transparent-pixels"  # kinds of findings
_ROUNDING = 1e-6  # of a mean of valid pixels
_CUT_OUT, _CHANGING = 0.2, 0.02
"""Share of transparent pixels, in the median photograph, from which on an object may be cut out,
and of pixels that are transparent in some photographs only: a lens leaves the same border in
all."""


def with_masks(scene: Scene, choice: str | None) -> Scene:
    """Attach masks: those of a folder, inverted ones, or none; ``choice=None`` changes nothing.

    With ``none`` transparent pixels are empty, with ``alpha`` masked, beside the masks that are
    there.

    Raises:
        SceneNotFoundError: No image has a mask there.
    """
    if choice is None:
        return scene
    own, found = scene.masks or Masks({}), list[Finding]()
    if choice in {NONE, ALPHA}:
        kept = without_kinds(scene.findings, TRANSPARENT)
        if choice == ALPHA:
            return scene.replace(masks=replace(own, alpha=True, choice=choice), findings=kept)
        return scene.replace(masks=None, findings=without_kinds(kept, _MOSTLY_MASKED))
    kept = without_kinds(scene.findings, _MOSTLY_MASKED)
    inverted = choice == INVERTED or choice.startswith(f"{INVERTED}:")
    location = choice.removeprefix(INVERTED).removeprefix(":") if inverted else choice
    files: Mapping[str, Path] = own.files
    folder = Path(location).absolute() if location else None
    if folder is not None:
        names = [image.name for image in scene.images]
        files, found = find_masks(names, folder, scene.source.image_dir, named=True)
        choice = f"{INVERTED}:{folder}" if inverted else str(folder)
    if not files:
        where = f"in {folder}" if folder else "beside its photographs"
        there = "none" if folder is None or folder.is_dir() else "no such folder"
        fix = "Pass a folder of masks, or omit `masks`."
        raise SceneNotFoundError(f"{_LISTED} {where}", found=there, fix=fix)
    masks = replace(own, files=files, inverted=inverted, choice=choice)
    return scene.replace(masks=masks, findings=(*kept, *found, *_mostly_masked(masks)))


def mask_choice(scene: Scene) -> str | None:
    """Return the ``choice`` that makes ``with_masks`` attach this scene's masks again."""
    return NONE if scene.masks is None else scene.masks.choice


def masks_digest(scene: Scene) -> str | None:
    """Fingerprint which masks the photographs have, and the sizes of their files; None without any.

    A run keeps it, so that masks that were added or changed since are noticed.
    """
    masks = scene.masks
    if masks is None or not masks.files:
        return None
    sizes = {name: file.stat().st_size for name, file in masks.files.items() if file.is_file()}
    return fingerprint(repr(masks.inverted).encode(), repr(sorted(sizes.items())).encode())


def with_own_masks(scene: Scene) -> Scene:
    """Attach the masks found near the photographs of a scene that was just read, if it has none."""
    folder, root = scene.source.image_dir, scene.source.root
    masks, found = scene.masks or Masks({}), list[Finding]()
    if folder is None or root is None:
        return scene
    if not masks.files:
        names = [image.name for image in scene.images]
        files, found = find_own_masks(names, folder, root)
        found += _resized(files, folder)
        masks = replace(masks, files=files)
    if masks.choice is None:
        paths = [image.path for image in scene.images if image.has_photograph]
        masks, transparent = _with_transparency(masks, paths)
        found += transparent
    return scene.replace(masks=masks, findings=(*scene.findings, *found, *_mostly_masked(masks)))


def _with_transparency(masks: Masks, paths: Sequence[Path]) -> tuple[Masks, list[Finding]]:
    """Decide by a sample of photographs whether transparent pixels are empty, and report it.

    Those of a scene whose reader knows that they are, such as a Blender pair, stay empty.
    """
    sample, pixels = strided(paths, _SAMPLE), list[Bool[np.ndarray, "H W"]]()
    for path in sample:
        with suppress(SplatseedError):  # reported when used
            if (each := read_transparent(path)) is not None and each.any():
                pixels.append(each)
    if not pixels:
        return masks, []
    shares = [*(float(each.mean()) for each in pixels), *[0.0] * (len(sample) - len(pixels))]
    share = f"Transparent pixels, {np.mean(shares):.0%} of the photographs"
    alike = {each.shape for each in pixels} == {pixels[0].shape}
    changing = np.any(pixels, axis=0) & ~np.all(pixels, axis=0) if alike else np.ones(1, np.bool_)
    if not masks.alpha or (np.median(shares) >= _CUT_OUT and changing.mean() >= _CHANGING):
        text = f"{share}, are empty space: any colour in training, the background in scores."
        fix = f"`masks={ALPHA!r}` leaves them out of both."
        return replace(masks, alpha=False), [Finding(TRANSPARENT, text, "info", fix=fix)]
    text = f"{share}, are left out of training and of scores."
    fix = f"`masks={NONE!r}` trains them as empty space."
    return masks, [Finding(TRANSPARENT, text, "info", fix=fix)]


def masks_near(photographs: Path) -> tuple[Masks, list[Finding]]:
    """Find the masks near a folder of photographs, with findings for the user."""
    folder = photographs.absolute()
    if not photographs.is_dir():
        return Masks({}), []
    # Not files of other kinds, such as a photograph's .xmp, for each of which a mask would lack.
    pictures = (path for path in files_below(photographs) if path.suffix.lower() in SUFFIXES)
    names = sorted(path.relative_to(photographs).as_posix() for path in pictures)
    names = sorted(set(names) - masks_among(names))
    files, found = find_own_masks(names, folder, folder.parent)
    if files:
        where = next(iter(files.values())).parent
        text = f"{counted(len(files), 'photograph')} with a mask in {where}."
        found = [Finding("masks-used", text, "info"), *found]
    masks, transparent = _with_transparency(Masks(files), [folder / name for name in names])
    found += [replace(each, fix="") for each in transparent]  # sfm has no such option
    return masks, [*found, *_mostly_masked(masks, "invert them")]


def _mostly_masked(masks: Masks, fix: str = f"use `masks={INVERTED!r}`") -> list[Finding]:
    """Report masks that leave out most pixels, by a sample: in many tools 255 means left out.

    Masks that the user has called inverted are taken as they are.
    """
    files, shares = [*masks.files.values()], list[float]()
    for path in strided(files, _SAMPLE) if not masks.inverted else ():
        with suppress(SplatseedError):  # reported when used
            shares.append(1.0 - float(_read_counts(path).mean()))
    if not shares or (share := float(np.mean(shares))) < _MOST:
        return []
    what = f"Masks leave out {share:.0%} of the pixels of their photographs"
    text = f"{what}: if 0 marks the pixels that count, {fix}."
    return [Finding(_MOSTLY_MASKED, text)]


def _resized(files: Mapping[str, Path], folder: Path) -> list[Finding]:
    """Report masks of another size than their photographs, by the first readable pair."""
    for name, path in files.items():
        with suppress(SplatseedError, OSError, ValueError):
            sizes = [photograph_size(path), photograph_size(folder / name)]
            if sizes[0] == sizes[1]:
                return []
            mask, photograph = (f"{width} x {height}" for width, height in sizes)
            text = f"Masks are resized to their photographs: {path} has {mask}, not {photograph}."
            return [Finding("masks-resized", text, "info")]
    return []


def read_mask(
    masks: Masks | None, name: str, photograph: Path, factor: float = 1
) -> Bool[np.ndarray, "h w"] | None:
    """Read which pixels of a photograph are valid; None if all are.

    A pixel reduced by ``factor`` is valid if all of its pixels are.

    Transparent pixels are not valid where ``Masks.alpha`` says so.

    Raises:
        SceneNotFoundError: The mask's file is missing.
        SceneFormatError: It is no image, has another aspect ratio, or masks every pixel.
    """
    if masks is None:
        return None
    path, parts = masks.files.get(name), []
    if path is not None:
        marked = _read_counts(path) != masks.inverted
        (height, width), size = marked.shape, photograph_size(photograph)
        if not same_shape((width, height), size):
            raise SceneFormatError(
                f"the mask {path} to have the size of {name}, {size[0]} x {size[1]}",
                found=f"{width} x {height}",
                fix="Make it from that photograph, without cropping or rotating it.",
            )
        parts.append(_fitted(marked, size))
    if masks.alpha and (transparent := read_transparent(photograph)) is not None:
        parts.append(~transparent)
    if not parts:
        return None
    counts = _reduced(np.logical_and.reduce(parts), factor)
    if counts.size and not counts.any():
        reduced = "" if factor == 1 else f", reduced by a factor of {factor:g}"
        raise SceneFormatError(
            f"unmasked pixels of {name} by its mask, {path or photograph}{reduced}",
            found="none",
            fix="Correct the mask, or remove the photograph from the scene. If 0 marks valid "
            f"pixels, pass `masks={INVERTED!r}`.",
        )
    return None if counts.all() else np.asarray(counts)


def read_empty(photograph: Path, factor: float = 1) -> Bool[np.ndarray, "h w"] | None:
    """Read the transparent pixels of a photograph; None without any.

    A pixel reduced by ``factor`` is transparent if any of its pixels is.
    """
    transparent = read_transparent(photograph)
    if transparent is None or not transparent.any():
        return None
    return ~_reduced(~transparent, factor)


def read_opacity(photograph: Path, factor: float = 1) -> UInt8[np.ndarray, "h w"] | None:
    """Read the alpha of a photograph with transparent pixels; None without any.

    That of a pixel reduced by ``factor`` is the mean of its pixels, as its colour over black is.
    """
    alpha = read_alpha(photograph)
    if alpha is None or (alpha >= OPAQUE).all():
        return None
    return np.asarray(np.rint(area_means(alpha, factor)), np.uint8)


def _reduced(counts: Bool[np.ndarray, "H W"], factor: float) -> Bool[np.ndarray, "h w"]:
    return np.asarray(area_means(counts, factor) > 1 - _ROUNDING)


def _read_counts(path: Path) -> Bool[np.ndarray, "H W"]:
    """Read which pixels of a mask are neither 0 nor transparent."""
    with translate_errors(path, "a mask, an image of one channel"):
        picture = open_photograph(path, read_bytes(path))
        if picture.mode.startswith(("I", "F")):  # Pillow's conversion would clip
            return np.asarray(np.asarray(picture) > 0)
        threshold = 128 if picture.format in _LOSSY else 1
        counts = np.asarray(picture.convert("L")) >= threshold
        if has_alpha(picture):
            counts &= np.asarray(picture.convert("RGBA").getchannel("A")) > 0
        return np.asarray(counts)


def _fitted(counts: Bool[np.ndarray, "H W"], size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """Resize a mask; a pixel is valid if all mask pixels that it overlaps are."""
    for axis, length in enumerate(size[::-1]):
        count = counts.shape[axis]
        if count != length:
            edges = np.arange(length + 1) * count
            start, stop = edges[:-1] // length, -(-edges[1:] // length)
            masked = np.cumsum(np.insert(~counts, 0, False, axis=axis), axis=axis)
            counts = masked.take(start, axis=axis) == masked.take(stop, axis=axis)
    return counts


def write_masks(
    masks: Masks | None,
    image_dir: Path,
    names: Iterable[str],
    folder: Path,
    lenses: Mapping[str, tuple[Intrinsics, Intrinsics]] | None = None,
) -> None:
    """Write masks of 0 and 255 under COLMAP's names.

    If any image has masked pixels, all get a mask: COLMAP and nerfstudio fail where one is missing.
    ``lenses`` (the camera of each photograph, and of its undistorted copy) undistorts the masks.
    """
    unmasked = []
    for name in names:
        counts = read_mask(masks, name, image_dir / name)
        if counts is None:
            unmasked.append(name)
        else:
            fitting = _undistorted(counts, *lenses[name]) if lenses else counts
            _write(folder / f"{name}.png", fitting)
    for name in unmasked if folder.is_dir() else ():
        width, height = photograph_size(image_dir / name)
        if lenses:
            width, height = lenses[name][1].width, lenses[name][1].height
        _write(folder / f"{name}.png", np.ones((height, width), np.bool_))


def _write(path: Path, counts: Bool[np.ndarray, "H W"]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    PilImage.fromarray(np.where(counts, 255, 0).astype(np.uint8)).save(path)


def write_transparency(
    image_dir: Path, copies: Path, lenses: Mapping[str, tuple[Intrinsics, Intrinsics]]
) -> None:
    """Make empty pixels transparent in undistorted copies of photographs, which lost their alpha.

    ``lenses`` as in ``write_masks``.
    """
    for name, (lens, pinhole) in lenses.items():
        copy, transparent = copies / name, read_transparent(image_dir / name)
        if transparent is None or lens == pinhole:  # the copy is that of the file
            continue
        shown = _undistorted(~transparent, lens, pinhole)
        picture = open_photograph(copy, photograph_bytes(copy)).convert("RGB")
        picture.putalpha(PilImage.fromarray(np.where(shown, 255, 0).astype(np.uint8)))
        picture.save(copy, lossless=True)  # of WebP; PNG and TIFF are


def _undistorted(
    counts: Bool[np.ndarray, "H W"], lens: Intrinsics, pinhole: Intrinsics
) -> Bool[np.ndarray, "h w"]:
    if lens == pinhole:  # the photograph is a copy
        return counts
    # Undistortion interpolates four pixels, all within one pixel of the nearest.
    windows = sliding_window_view(np.pad(counts, 1, constant_values=True), (3, 3))
    sure = np.asarray(windows.all(axis=(2, 3)))
    moved = Undistortion({"": lens}, {"": pinhole}).apply("", sure.astype(np.float32))
    return np.asarray(moved == 1)  # NaN outside of the image, where the copy is black
