"""Input of SfM: the photographs of a folder, those with known poses, or frames of a video.

Photographs are decoded completely, because pycolmap accepts a truncated JPEG (with a grey lower
half) and skips unreadable files. Video frames are chosen sharp and spaced by image motion, so that
a standing camera gives one frame.

Notation: the *motion* at a frame is the cumulative image motion in image widths: the sum of the
median shifts of blocks between frames, by phase correlation (Kuglin and Hines 1975).
"""

from __future__ import annotations

import re
from collections.abc import Container, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.exclusion import matching_names
from splatseed.io.files import VIDEO_SUFFIXES, StrPath, files_below
from splatseed.io.image_folders import link_folders
from splatseed.io.mask_files import masks_among
from splatseed.io.photograph import (
    check_photograph,
    decode_photograph,
    has_alpha,
    open_photograph,
    photograph_bytes,
)
from splatseed.io.photograph_checks import check_sizes
from splatseed.io.picture import WHITE, find_white, is_16_bit
from splatseed.io.recordings import (
    ANALYSIS_WIDTH,
    choose_frames,
    sharpness,
    small_frames,
    write_frames,
)
from splatseed.io.scanner_app import is_photograph, is_scanner_app
from splatseed.io.staging import read_manifest
from splatseed.photos.sizes import at_file_size
from splatseed.progress import Progress, silent
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Image, Scene
from splatseed.sfm.cameras import Photo, Photos, read_exif
from splatseed.sfm.gps import read_gps
from splatseed.text import name_some, quoted

COPIES = "readable"
"""Folder of a run's scratch folder with such copies."""
_MISREAD_SUFFIXES = frozenset({".png", ".tif", ".tiff", ".webp"})  # with 16 bits or transparency
_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
_FOREIGN_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".webp", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf",
     ".orf", ".rw2"}
)  # fmt: skip
_GREY = "of 16-bit or floating-point grey, as depth maps are"
EXCLUDED = "that `exclude` names"
"""Why images are left out that the user chose."""
_FOREIGN = "of an unsupported format"
_MASK = "named as masks of others are"
_MAP = "of grey, named as maps of depth or confidence are"
_BESIDE = "that 3D Scanner App writes beside its photographs"
_COPY = "that are reduced copies, as in images_2"
_DEPTH_MODES = ("I", "F")  # Pillow's names for 16- and 32-bit grey
_GREY_MODES = ("L", "1", "LA")
_MAPS = re.compile(r"(^|[/_.-])(conf|confidence|depth|disparity|masks?)([/_.\d-]|$)", re.IGNORECASE)
"""Names of maps that scanning apps write beside photographs."""

_REDUCED = re.compile(r"images_\d+(_png)?")
"""Folders in which trainers keep reduced copies of the photographs in ``images``."""
_BLOCK = 64
"""Side of the blocks of phase correlation, px."""
_MIN_FRAMES = 3
"""Fewest frames of a scene."""


def find_photos(
    image_dir: StrPath, exclude: Sequence[str] = ()
) -> tuple[dict[str, Photo], dict[str, list[str]]]:
    """Find the photographs of a folder and its subfolders, at least two.

    Skipped are hidden files, masks, reduced copies in ``images_2`` and so on, depth maps (16-bit or
    float grey; next to colour photographs also 8-bit grey with the name of a depth or confidence
    map), textures and thumbnails in an export of 3D Scanner App, unsupported formats such as HEIC
    or raw, and those that ``exclude`` names, as for ``io.exclusion.exclude``.

    Returns:
        The photographs by name (relative path), sorted; and the names of skipped images by reason.
    """
    image_dir = Path(image_dir)
    if not image_dir.is_dir():
        raise SceneNotFoundError(
            f"a folder of photographs or a video at {image_dir}",
            found="a file that is neither" if image_dir.exists() else "nothing",
            fix=f"Pass a folder of photographs, or a video ({', '.join(sorted(VIDEO_SUFFIXES))}).",
        )
    if (kind := read_manifest(image_dir).get("command")) is not None:
        raise SceneNotFoundError(
            f"a folder of photographs at {image_dir}",
            found=f"an output of splatseed {kind}",
            fix=f"Pass the folder of its photographs, such as {quoted(image_dir / 'images')}.",
        )
    files = [path.relative_to(image_dir) for path in files_below(image_dir) if path.is_file()]
    names, foreign = (
        sorted(path.as_posix() for path in files if path.suffix.lower() in suffixes)
        for suffixes in (_SUFFIXES, _FOREIGN_SUFFIXES)
    )
    excluded = matching_names([*names, *foreign], exclude)
    names, foreign = ([name for name in each if name not in excluded] for each in (names, foreign))
    masks = masks_among(names)
    names = [name for name in names if name not in masks]
    copies = _reduced_copies(names)
    names = [name for name in names if name not in copies]
    beside = []
    if is_scanner_app(image_dir):
        beside = [name for name in names if not (is_photograph(name) or _MAPS.search(name))]
        names = [name for name in names if name not in beside]
    with ThreadPoolExecutor() as pool:  # Pillow decodes outside the GIL
        read = dict(zip(names, pool.map(lambda n: _read(image_dir / n), names), strict=True))
    grey = [name for name, (photo, _) in read.items() if photo is None]
    maps = [name for name, (_, colours) in read.items() if not colours and _MAPS.search(name)]
    if not any(colours for _, colours in read.values()):
        maps = []
    photos = {n: photo for n, (photo, _) in read.items() if photo is not None and n not in maps}
    kinds = (
        (_GREY, grey),
        (_MAP, [n for n in maps if n not in grey]),
        (_BESIDE, beside),
        (_COPY, sorted(copies)),
        (_FOREIGN, foreign),
        (_MASK, sorted(masks)),
        (EXCLUDED, sorted(excluded)),
    )
    left_out = {reason: names for reason, names in kinds if names}
    if len(photos) < 2:
        found = [
            f"{len(skipped)} {why} ({name_some(skipped)})" for why, skipped in left_out.items()
        ]
        if others := len(files) - len(names) - len(foreign):
            found.append(f"{others} other files")
        raise SceneNotFoundError(
            f"at least 2 photographs ({' '.join(sorted(_SUFFIXES))}) in {image_dir}",
            found=" and ".join([f"{len(photos)}", *found]),
            fix="Save photographs as JPEG, or as PNG of 8 bits."
            if left_out
            else "Pass the folder with the photographs of a scene.",
        )
    return photos, left_out


def _reduced_copies(names: Iterable[str]) -> set[str]:
    """Return the names of reduced copies: test views would be trained on by theirs."""
    places = {name: PurePosixPath(name).with_suffix("").parts for name in names}
    there = {*places.values()}
    return {
        name
        for name, parts in places.items()
        if any(
            _REDUCED.fullmatch(part) and (*parts[:i], "images", *parts[i + 1 :]) in there
            for i, part in enumerate(parts[:-1])
        )
    }


def _read(path: Path) -> tuple[Photo | None, bool]:
    """Decode an image; return the photograph (None for depth maps), and if it has colour."""
    encoded = photograph_bytes(path)
    with open_photograph(path, encoded) as image:
        mode, exif, gps = image.mode, read_exif(image), read_gps(image)
    if mode.startswith(_DEPTH_MODES):
        return None, False
    digest = fingerprint(encoded)
    return Photo(check_photograph(path), exif, digest, gps), mode not in _GREY_MODES


def match_poses(photos: Photos, scene: Scene, image_dir: Path) -> tuple[Image, ...]:
    """Return the scene's images with photographs, in the photographs' order and sizes."""
    posed = {image.name: image for image in scene.images}
    # Without observations, which the child process does not need.
    found = [posed[name] for name in photos if name in posed]
    images = [replace(image, observations=None, folder=image_dir) for image in found]
    if len(images) < 2:
        raise SceneNotFoundError(
            f"two or more images of {image_dir} among the {len(posed)} posed images "
            f"({name_some(sorted(posed)[:3])}, ...)",
            found=f"{len(images)} of {len(photos)} ({name_some(list(photos)[:3])}, ...)",
            fix="Names must match exactly, relative to the images folder, suffix included.",
        )
    check_sizes(images)
    return at_file_size(images)


class PickedFrames(NamedTuple):
    """The chosen frames of a video."""

    numbers: tuple[int, ...]  # from 0
    total: int  # frames of the video
    motion: float  # total image motion, in widths


def pick_frames(
    video: Path, folder: Path, frames: int = 150, progress: Progress = silent
) -> PickedFrames:
    """Write the best frames of a video, at most ``frames``, as JPEGs; deterministic."""
    if frames < _MIN_FRAMES:
        expected = f"`frames` to be {_MIN_FRAMES} or more"
        raise ParameterError(expected, found=f"{frames}", fix="Try 150.")
    if not video.is_file():
        raise SceneNotFoundError(f"a video {video}", found="none", fix="Check the path.")
    sharp, steps = [], []
    before: Float32[np.ndarray, "H W"] | None = None
    for grey in small_frames(video, progress):
        sharp.append(sharpness(grey))
        steps.append(0.0 if before is None else shift(before, grey) / ANALYSIS_WIDTH)
        before = grey
    motion = np.cumsum(steps)
    numbers = choose_frames(np.array(sharp), motion, frames).tolist()
    if len(numbers) < _MIN_FRAMES:
        raise SceneFormatError(
            f"{video} to show the scene from several places",
            found=f"{len(motion)} frames with image motion of "
            f"{motion[-1] if len(motion) else 0:.1%} of the width",
            fix="Film while you walk around the scene.",
        )
    paths = {number: folder / f"{video.stem}_{number:06}.jpg" for number in numbers}
    write_frames(video, paths, progress)
    return PickedFrames(tuple(numbers), len(motion), float(motion[-1]))


def shift(before: Float32[np.ndarray, "H W"], now: Float32[np.ndarray, "H W"]) -> float:
    """Measure image motion between frames: the median length of the blocks' shifts, px."""
    window = np.hanning(_BLOCK)[:, None] * np.hanning(_BLOCK)
    spectra = []
    for grey in (before, now):
        rows, columns = (max(1, side // _BLOCK) for side in grey.shape)
        padded = np.pad(grey, [(0, max(0, _BLOCK - side)) for side in grey.shape])
        cut = padded[: _BLOCK * rows, : _BLOCK * columns].reshape(rows, _BLOCK, columns, _BLOCK)
        blocks = cut.swapaxes(1, 2).reshape(-1, _BLOCK, _BLOCK)
        spectra.append(np.fft.rfft2((blocks - blocks.mean(axis=(1, 2), keepdims=True)) * window))
    # Phase correlation: the inverse transform of the normalised cross spectrum peaks at the shift.
    cross = spectra[0] * np.conj(spectra[1])
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-6), s=(_BLOCK, _BLOCK))
    at = np.argmax(peaks.reshape(len(peaks), -1), axis=1)
    # Shifts of more than half a block are negative.
    dy, dx = ((each + _BLOCK // 2) % _BLOCK - _BLOCK // 2 for each in np.divmod(at, _BLOCK))
    return float(np.median(np.hypot(dx, dy)))


def copy_misread(
    image_dir: Path,
    names: Iterable[str],
    folder: Path,
    *,
    over_black: bool = False,
    linked: Container[str] = (),
) -> Path:
    """Copy photographs that pycolmap misreads to ``folder``, with links to the others.

    Args:
        image_dir: The photographs.
        names: Their names.
        folder: A folder to create if there is any to copy. Copies have 8 bits per channel.
        over_black: Copy photographs with transparent pixels, too.
        linked: Names of photographs that pycolmap only copies.

    Returns:
        The folder for pycolmap: ``folder``, or ``image_dir`` if there is nothing to copy.
    """
    paths = {name: image_dir / name for name in names}
    white, _ = find_white(list(paths.values()))
    read = [
        n
        for n, path in paths.items()
        if n not in linked and path.suffix.lower() in _MISREAD_SUFFIXES
    ]
    odd = [name for name in read if _is_misread(paths[name], white, over_black=over_black)]
    if not odd:
        return image_dir
    link_folders({n: path for n, path in paths.items() if n not in odd}, folder, copy=False)
    for name in odd:
        copy = folder / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        picture = decode_photograph(paths[name], photograph_bytes(paths[name]), white)
        picture.save(copy, lossless=True)  # of WebP; PNG and TIFF are
    return folder


def _is_misread(path: Path, white: int, *, over_black: bool) -> bool:
    picture = open_photograph(path, photograph_bytes(path))
    if is_16_bit(picture) and white != WHITE:
        return True
    if not (over_black and has_alpha(picture)):
        return False
    return bool(np.asarray(picture.convert("RGBA").getchannel("A")).min() < WHITE // 257)
