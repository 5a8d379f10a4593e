"""Writing frames as a video, by the ffmpeg that imageio-ffmpeg brings."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import closing
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatseed.errors import OutputError, ParameterError
from splatseed.io.output.staging import atomic_file
from splatseed.requirements import require

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
"""File name suffixes that can be written, all holding H.264."""
QUALITY = 8
"""imageio-ffmpeg's quality, 0 to 10."""


def check_video_name(path: Path) -> None:
    """Refuse a name whose suffix is not one of ``VIDEO_SUFFIXES``.

    Raises:
        ParameterError: It is refused.
    """
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise ParameterError(
            f"the name of a video: {', '.join(VIDEO_SUFFIXES)}",
            found=path.suffix or "no suffix",
            fix="Name it flight.mp4.",
        )


def even_size(width: int, height: int, most: int | None = None) -> tuple[int, int]:
    """The nearest size that H.264 allows, both sides even.

    Args:
        width: Pixels.
        height: Pixels.
        most: Limit of the longer side; unlimited when left out.
    """
    scale = min(1.0, most / max(width, height)) if most else 1.0
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (width, height))
    return width, height


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], size: tuple[int, int], fps: float
) -> None:
    """Write frames as H.264, replacing a file at ``path``.

    Args:
        path: See ``check_video_name``.
        frames: One after the other, all of one size.
        size: Their width and height, both even.
        fps: Frames per second.

    Raises:
        MissingDependencyError: imageio-ffmpeg is absent.
        OutputError: The video cannot be written.
    """
    require("imageio_ffmpeg")
    import imageio_ffmpeg  # noqa: PLC0415  (of the extra view)

    with atomic_file(path) as partial:
        writer = imageio_ffmpeg.write_frames(
            str(partial),
            size,
            fps=fps,
            quality=QUALITY,
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-movflags", "+faststart"],
        )
        try:
            with closing(writer):  # also when stopped: ffmpeg must end before its file is removed
                writer.send(None)
                for frame in frames:
                    writer.send(np.ascontiguousarray(frame))
        except (OSError, RuntimeError) as error:  # ffmpeg ended early
            raise OutputError(
                f"{path} to be written",
                found=" ".join(str(error).split())[-160:] or type(error).__name__,
                fix="Check the disk and try again. Nothing half-written was left behind.",
            ) from None
        if not partial.is_file():
            raise OutputError(
                f"{path} to be written by ffmpeg", found="nothing", fix="Check the disk."
            )
