"""Frames of a video, decoded by ffmpeg: small grey ones for analysis, some of full size as JPEGs.

Notation: frames are numbered from 0 as ffmpeg delivers them, each once (no frame rate is enforced).
*Sharpness* is the variance of the Laplacian at a width of ``ANALYSIS_WIDTH``.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import SceneFormatError
from splatseed.progress import Progress
from splatseed.requirements import require

ANALYSIS_WIDTH = 256
"""Width at which frames are analysed, px."""
_MAX_SELECTED = 1000
"""Frames that ffmpeg selects by number; it need not convert and send the others."""
_HIDDEN = ["-ignore_editlist", "1"]
"""ffmpeg's option for frames that an MP4's edit list hides, such as those before its time 0."""


def small_frames(
    video: Path, progress: Progress, *, hidden: bool = False
) -> Iterator[Float32[np.ndarray, "H W"]]:
    """Yield all frames in grey, ``ANALYSIS_WIDTH`` wide, values from 0 to 255.

    Args:
        video: The file.
        progress: Called with the fraction of the video that is read.
        hidden: Also yield frames that the file's edit list hides from players.

    Raises:
        MissingDependencyError: imageio-ffmpeg is not installed.
        SceneFormatError: ffmpeg cannot read the file.
    """
    scale = ["-vf", f"scale={ANALYSIS_WIDTH}:-2"]
    for frame, part in _frames(video, scale, "gray", hidden=hidden):
        yield frame[..., 0].astype(np.float32)
        progress("analyse video", part)


def sharpness(grey: Float32[np.ndarray, "H W"]) -> float:
    """Return the variance of the Laplacian: high for a sharp frame, for equal content."""
    from scipy.ndimage import laplace  # noqa: PLC0415  (takes a while to load)

    return float(laplace(grey).var())


def write_frames(
    video: Path, paths: Mapping[int, Path], progress: Progress, *, hidden: bool = False
) -> None:
    """Write frames as JPEGs, by their numbers; other arguments and errors as ``small_frames``."""
    from PIL import Image as PilImage  # noqa: PLC0415  (takes a while to load)

    if not paths:
        return
    numbers = sorted(paths)
    select = _any_of([f"eq(n\\,{number})" for number in numbers])
    # Without the filter, all frames pass: a command line cannot hold thousands of numbers.
    filtered = len(numbers) <= _MAX_SELECTED
    parameters = ["-vf", f"select={select}"] if filtered else []
    frames = _frames(video, parameters, "rgb24", hidden=hidden)
    for i, (pixels, part) in enumerate(frames):
        number = numbers[i] if filtered else i
        if number in paths:
            PilImage.fromarray(pixels).save(paths[number], quality=95, subsampling=0)
        progress("write frames", (i + 1) / len(numbers) if filtered else part)


def _any_of(terms: Sequence[str]) -> str:
    """Add ffmpeg's expressions in a balanced tree, as it accepts only about 100 levels."""
    if len(terms) < 2:
        return "".join(terms)
    half = len(terms) // 2
    return f"({_any_of(terms[:half])}+{_any_of(terms[half:])})"


def _frames(
    video: Path, parameters: list[str], pixels: Literal["gray", "rgb24"], *, hidden: bool
) -> Iterator[tuple[UInt8[np.ndarray, "H W C"], float]]:
    """Yield frames of a video, and the fraction read so far."""
    require("imageio_ffmpeg")
    import imageio_ffmpeg  # noqa: PLC0415  (an optional package)

    channels = 1 if pixels == "gray" else 3
    # Silence its warning about reading at another size.
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)
    try:
        reader = imageio_ffmpeg.read_frames(
            str(video), pix_fmt=pixels, bits_per_pixel=8 * channels,
            input_params=_HIDDEN if hidden else [],
            output_params=["-fps_mode", "passthrough", *parameters],
        )  # fmt: skip
        facts = dict(next(reader))
        total = max(1.0, float(facts.get("duration") or 0) * float(facts.get("fps") or 0))
        width, height = facts["size"]
        for i, raw in enumerate(reader):
            frame = np.frombuffer(raw, np.uint8).reshape(height, width, channels)
            yield frame, min(1.0, (i + 1) / total)
    except (OSError, RuntimeError, StopIteration, IndexError, ValueError) as error:
        text = " ".join(str(error).split())
        raise SceneFormatError(
            f"{video} to be a video that ffmpeg can read",
            found=(text if len(text) <= 120 else f"...{text[-117:]}") or type(error).__name__,
            fix="Convert it to .mp4 (H.264), or pass a folder of photographs.",
        ) from None
