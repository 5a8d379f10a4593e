"""Photographs: those of a folder, checked, those that have a pose, and the best frames of a video.

Every photograph is decoded to its last byte: pycolmap accepts a truncated JPEG as a picture with a
grey lower half, and skips files that it cannot read. From a video come sharp frames, spaced by how
far the picture moves, so that a camera that stands still gives one frame, not hundreds.

Notation: a video's *way* up to a frame is how far the picture has moved by then, in picture widths:
the sum, over the frames so far, of the median shift of blocks from one frame to the next, by phase
correlation (Kuglin and Hines 1975). A frame's *sharpness* is the variance of its Laplacian.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from PIL import Image as PilImage
from scipy.ndimage import laplace

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import VIDEO_SUFFIXES, StrPath, files_below
from splatseed.io.mask_files import masks_among
from splatseed.io.photograph import check_photograph, open_photograph, photograph_bytes
from splatseed.io.photograph_checks import check_sizes, resized_to
from splatseed.io.staging import read_manifest
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Image, Scene
from splatseed.sfm.cameras import Photo, Photos, read_exif
from splatseed.text import name_some, quoted

_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp"})
_FOREIGN_SUFFIXES = frozenset(
    {".heic", ".heif", ".avif", ".webp", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf",
     ".orf", ".rw2"}
)  # fmt: skip
_GREY = "of 16-bit or floating-point grey, as depth maps are"
_FOREIGN = "of a format that is not read"
_MASK = "named as masks of others are"
_MAP = "of grey, named as maps of depth or confidence are"
_DEPTH_MODES = ("I", "F")  # Pillow's names for 16- and 32-bit grey
_GREY_MODES = ("L", "1", "LA")
_MAPS = re.compile(r"(^|[/_.-])(conf|confidence|depth|disparity|masks?)([/_.\d-]|$)", re.IGNORECASE)
"""Names of the maps that phones' scanning apps write beside photographs."""

_ANALYSIS_WIDTH, _BLOCK = 256, 64
"""Width at which frames are analysed, and the side of the blocks whose shifts are measured, px."""
_MIN_STEP = 0.02
"""Least distance, in widths, that the picture moves between chosen frames."""
_MIN_FRAMES = 3
"""Fewer photographs make no scene."""


def find_photos(image_dir: StrPath) -> tuple[dict[str, Photo], dict[str, list[str]]]:
    """The photographs below ``image_dir``, at least two.

    Hidden files are left out, and so are 16-bit and floating-point grey images: those are the
    depth maps of an RGB-D capture, and 8-bit grey ones that are named as an app's maps of
    confidence or depth, beside photographs in colour. Formats such as HEIC and cameras' raw ones
    are not read.

    Returns:
        The photographs by their names (paths relative to the folder), in order of names; and the
        names of other images by what they are.

    Raises:
        SceneNotFoundError: The folder is missing or holds fewer than two photographs.
        SceneFormatError: An image cannot be decoded.
    """
    image_dir = Path(image_dir)
    if not image_dir.is_dir():
        raise SceneNotFoundError(
            f"a folder of photographs or a video at {image_dir}",
            found="a file that is neither" if image_dir.exists() else "nothing",
            fix="Name the folder that holds the photographs, or a video "
            f"({', '.join(sorted(VIDEO_SUFFIXES))}).",
        )
    if (kind := read_manifest(image_dir).get("command")) is not None:
        raise SceneNotFoundError(
            f"a folder of photographs at {image_dir}",
            found=f"what splatseed {kind} wrote, with pictures of its own",
            fix=f"Name the folder of its photographs, such as {quoted(image_dir / 'images')}.",
        )
    relative = [path.relative_to(image_dir) for path in files_below(image_dir) if path.is_file()]
    files = [path for path in relative if not any(part.startswith(".") for part in path.parts)]
    names, foreign = (
        sorted(path.as_posix() for path in files if path.suffix.lower() in suffixes)
        for suffixes in (_SUFFIXES, _FOREIGN_SUFFIXES)
    )
    masks = masks_among(names)
    names = [name for name in names if name not in masks]
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
        (_FOREIGN, foreign),
        (_MASK, sorted(masks)),
    )
    left_out = {what: them for what, them in kinds if them}
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


def _read(path: Path) -> tuple[Photo | None, bool]:
    """A photograph, decoded and found whole, None for a depth map; and whether it has colours."""
    encoded = photograph_bytes(path)
    with open_photograph(path, encoded) as image:
        mode, exif = image.mode, read_exif(image)
    if mode.startswith(_DEPTH_MODES):
        return None, False
    digest = fingerprint(encoded)
    return Photo(check_photograph(path), exif, digest), mode not in _GREY_MODES


def match_poses(photos: Photos, scene: Scene, image_dir: Path) -> tuple[Image, ...]:
    """The images of ``scene`` that are among the photographs, in their order and at their sizes.

    Raises:
        SceneNotFoundError: Fewer than two names are in both.
        SceneFormatError: A photograph is neither of its camera's size nor a resized copy.
    """
    posed = {image.name: image for image in scene.images}
    # Observations are not needed where they go, in another process.
    images = [replace(posed[name], observations=None) for name in photos if name in posed]
    if len(images) < 2:
        raise SceneNotFoundError(
            f"two or more images of {image_dir} among the {len(posed)} posed images "
            f"({name_some(sorted(posed)[:3])}, ...)",
            found=f"{len(images)} of {len(photos)} ({name_some(list(photos)[:3])}, ...)",
            fix="Names must be equal, relative to the images folder, suffix included.",
        )
    return resized_to(images, check_sizes(images, image_dir))


class PickedFrames(NamedTuple):
    """Which frames of a video were chosen."""

    numbers: tuple[int, ...]  # from 0
    total: int  # how many frames the video has
    way: float  # how far the picture moves in total, in widths


def pick_frames(
    video: Path, folder: Path, most: int = 150, progress: Progress = silent
) -> PickedFrames:
    """Write the best frames of a video, ``most`` at most, as JPEGs; equal videos give equal frames.

    Raises:
        MissingDependencyError: imageio-ffmpeg is absent.
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read, or the picture hardly moves.
        ParameterError: ``most`` is too small.
    """
    if most < _MIN_FRAMES:
        expected = f"`frames` of {_MIN_FRAMES} or more"
        raise ParameterError(expected, found=f"{most}", fix="Try 150.")
    if not video.is_file():
        raise SceneNotFoundError(f"a video {video}", found="none", fix="Check the path.")
    sharpness, steps = [], []
    before: Float32[np.ndarray, "H W"] | None = None
    for frame, part in _frames(video, ["-vf", f"scale={_ANALYSIS_WIDTH}:-2"], "gray"):
        grey = frame[..., 0].astype(np.float32)
        sharpness.append(float(laplace(grey).var()))
        steps.append(0.0 if before is None else shift(before, grey) / _ANALYSIS_WIDTH)
        before = grey
        progress("look at video", part)
    way = np.cumsum(steps)
    numbers = choose_frames(np.array(sharpness), way, most).tolist()
    if len(numbers) < _MIN_FRAMES:
        raise SceneFormatError(
            f"{video} to move, for photographs from several places",
            found=f"{len(way)} frames whose picture moves by {way[-1] if len(way) else 0:.1%} of "
            "its width",
            fix="Film while you walk around the scene.",
        )
    for number, (pixels, part) in enumerate(_frames(video, [], "rgb24")):
        if number in numbers:
            path = folder / f"{video.stem}_{number:06}.jpg"
            PilImage.fromarray(pixels).save(path, quality=95, subsampling=0)
        progress("take frames", part)
    return PickedFrames(tuple(numbers), len(way), float(way[-1]))


def choose_frames(
    sharpness: Float64[np.ndarray, " F"], way: Float64[np.ndarray, " F"], most: int
) -> Int64[np.ndarray, " P"]:
    """The sharpest frame in each of at most ``most`` equal stretches of the (ascending) way."""
    if not len(way):
        return np.empty(0, np.int64)
    step = max(way[-1] / most, _MIN_STEP)
    stretch = np.minimum((way / step).astype(np.int64), max(int(way[-1] / step) - 1, 0))
    order = np.lexsort((-sharpness, stretch))
    return np.sort(order[np.unique(stretch[order], return_index=True)[1]])


def shift(before: Float32[np.ndarray, "H W"], now: Float32[np.ndarray, "H W"]) -> float:
    """How far the picture moved: the median over blocks of the length of their shifts, px."""
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
    # Shifts of more than half a block are negative ones.
    dy, dx = ((each + _BLOCK // 2) % _BLOCK - _BLOCK // 2 for each in np.divmod(at, _BLOCK))
    return float(np.median(np.hypot(dx, dy)))


def _frames(
    video: Path, parameters: list[str], pixels: Literal["gray", "rgb24"]
) -> Iterator[tuple[UInt8[np.ndarray, "H W C"], float]]:
    """Frames of a video, with the fraction of it read so far."""
    require("imageio_ffmpeg")
    import imageio_ffmpeg  # noqa: PLC0415  (of the extras sfm and view)

    channels = 1 if pixels == "gray" else 3
    # It warns about every video that is read at another size than its own.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    try:
        reader = imageio_ffmpeg.read_frames(
            str(video), pix_fmt=pixels, bits_per_pixel=8 * channels,
            output_params=["-fps_mode", "passthrough", *parameters],
        )  # fmt: skip
        facts = dict(next(reader))
        total = max(1.0, float(facts.get("duration") or 0) * float(facts.get("fps") or 0))
        width, height = facts["size"]
        for i, raw in enumerate(reader):
            frame = np.frombuffer(raw, np.uint8).reshape(height, width, channels)
            yield frame, min(1.0, (i + 1) / total)
    except (OSError, RuntimeError, StopIteration, IndexError, ValueError) as error:
        said = " ".join(str(error).split())
        raise SceneFormatError(
            f"{video} to be a video that ffmpeg reads",
            found=(said if len(said) <= 120 else f"...{said[-117:]}") or type(error).__name__,
            fix="Convert it to .mp4 (H.264), or pass a folder of photographs.",
        ) from None
