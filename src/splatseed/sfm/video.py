"""Frames of a video to reconstruct from: sharp ones, spaced by how far the picture moves.

Notation: the *way* of a frame is how far the picture has moved by then, in picture widths: the sum,
over the frames so far, of the median shift of blocks from one frame to the next, by phase
correlation (Kuglin and Hines 1975). A frame's *sharpness* is the variance of its Laplacian.
Promise: the sharpest frame of each stretch of the way is taken, so that a camera that stands still
gives one frame, not hundreds; equal videos give equal frames.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from PIL import Image
from scipy.ndimage import laplace

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.progress import Progress, silent
from splatseed.requirements import require

LOOK_WIDTH = 256
"""Width in pixels at which frames are analysed."""
BLOCK = 64
"""Side of the blocks whose shifts are measured, in pixels at that width."""
LEAST_STEP = 0.02
"""Least distance, in widths, that the picture moves between chosen frames."""
LEAST_FRAMES = 3
"""Fewer photographs make no scene."""
QUALITY = 95
"""JPEG quality of the frames."""


@dataclass(frozen=True)
class PickedFrames:
    """Which frames were chosen.

    Args:
        numbers: Their numbers, from 0.
        total: How many frames the video has.
        way: How far the picture moves in total, in widths.
    """

    numbers: tuple[int, ...]
    total: int
    way: float


def pick_frames(
    video: Path, folder: Path, most: int = 150, progress: Progress = silent
) -> PickedFrames:
    """Write the best frames of a video as JPEGs.

    Args:
        video: The file.
        folder: An existing folder for the frames.
        most: The most frames to choose.
        progress: Called with the stage and the fraction done.

    Raises:
        MissingDependencyError: imageio-ffmpeg is absent.
        SceneNotFoundError: There is no such file.
        SceneFormatError: It cannot be read, or the picture hardly moves.
        ParameterError: ``most`` is too small.
    """
    if most < LEAST_FRAMES:
        raise ParameterError(f"--frames of {LEAST_FRAMES} or more", found=f"{most}", fix="Try 150.")
    if not video.is_file():
        raise SceneNotFoundError(f"a video {video}", found="none", fix="Check the path.")
    sharpness, way = _look(video, progress)
    numbers = choose(sharpness, way, most)
    if len(numbers) < LEAST_FRAMES:
        raise SceneFormatError(
            f"{video} to move, for photographs from several places",
            found=f"{len(way)} frames whose picture moves by {way[-1] if len(way) else 0:.1%} of "
            "its width",
            fix="Film while you walk around the scene.",
        )
    wanted = set(numbers.tolist())
    for number, (pixels, part) in enumerate(_frames(video, [], "rgb24")):
        if number in wanted:
            picture = Image.fromarray(pixels)
            name = f"{video.stem}_{number:06}.jpg"
            picture.save(folder / name, quality=QUALITY, subsampling=0)
        progress("take frames", part)
    return PickedFrames(tuple(numbers.tolist()), len(way), float(way[-1]))


def choose(
    sharpness: Float64[np.ndarray, " F"], way: Float64[np.ndarray, " F"], most: int
) -> Int64[np.ndarray, " P"]:
    """The sharpest frame in each of at most ``most`` equal stretches of the way.

    Args:
        sharpness: The sharpness of each frame.
        way: The way up to each frame, ascending.
        most: The most stretches.
    """
    if not len(way):
        return np.empty(0, np.int64)
    step = max(way[-1] / most, LEAST_STEP)
    stretch = np.minimum((way / step).astype(np.int64), max(int(way[-1] / step) - 1, 0))
    order = np.lexsort((np.arange(len(way)), -sharpness, stretch))
    first = np.unique(stretch[order], return_index=True)[1]
    return np.sort(order[first])


def _look(
    video: Path, progress: Progress
) -> tuple[Float64[np.ndarray, " F"], Float64[np.ndarray, " F"]]:
    """The sharpness and way of every frame."""
    sharpness, steps = [], []
    before: Float32[np.ndarray, "H W"] | None = None
    for frame, part in _frames(video, ["-vf", f"scale={LOOK_WIDTH}:-2"], "gray"):
        grey = frame[..., 0].astype(np.float32)
        sharpness.append(float(laplace(grey).var()))
        steps.append(0.0 if before is None else shift(before, grey) / LOOK_WIDTH)
        before = grey
        progress("look at video", part)
    return np.array(sharpness), np.cumsum(steps)


def shift(before: Float32[np.ndarray, "H W"], now: Float32[np.ndarray, "H W"]) -> float:
    """How far the picture moved: the median over blocks of the length of their shifts, px."""
    blocks = _blocks(before), _blocks(now)
    window = np.hanning(BLOCK)[:, None] * np.hanning(BLOCK)
    spectra = [np.fft.rfft2((b - b.mean(axis=(1, 2), keepdims=True)) * window) for b in blocks]
    # Phase correlation: the inverse transform of the normalised cross spectrum peaks at the shift.
    cross = spectra[0] * np.conj(spectra[1])
    peaks = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-6), s=(BLOCK, BLOCK))
    at = np.argmax(peaks.reshape(len(peaks), -1), axis=1)
    # Shifts of more than half a block are negative ones.
    dy, dx = ((each + BLOCK // 2) % BLOCK - BLOCK // 2 for each in np.divmod(at, BLOCK))
    return float(np.median(np.hypot(dx, dy)))


def _blocks(grey: Float32[np.ndarray, "H W"]) -> Float32[np.ndarray, "B S S"]:
    rows, columns = (max(1, side // BLOCK) for side in grey.shape)
    padded = np.zeros((max(grey.shape[0], BLOCK), max(grey.shape[1], BLOCK)), np.float32)
    padded[: grey.shape[0], : grey.shape[1]] = grey
    cut = padded[: BLOCK * rows, : BLOCK * columns].reshape(rows, BLOCK, columns, BLOCK)
    return cut.swapaxes(1, 2).reshape(-1, BLOCK, BLOCK)


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
            found=said[-120:] or type(error).__name__,
            fix="Convert it to .mp4 (H.264), or pass a folder of photographs.",
        ) from None
