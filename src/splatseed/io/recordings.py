"""Photographs inside recordings: which are used, decoding by ffmpeg, extraction into the cache.

Frames are chosen sharp and spaced by motion, none from standing still. The *motion* at a frame is
the cumulative image motion since the first, in image widths: measured in the pictures (``sfm``), or
by ``pose_motion`` where poses are known. *Sharpness* is the variance of the Laplacian at a width of
``ANALYSIS_WIDTH``. Frames of a video are numbered from 0 as ffmpeg delivers them, each once (no
frame rate is enforced).

What a video or an archive holds is extracted once into the user's cache. A folder's name ends in a
fingerprint of its content's source and of how it was chosen, so another source never takes its
place. It appears complete or not at all, is used again by later calls, and is removed once no call
has used it for ``UNUSED_DAYS``. Outputs copy photographs from here, since a link would break then.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from platformdirs import user_cache_path

from splatseed.errors import OutputError, SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import open_file, translate_read_errors
from splatseed.io.staging import locked, remove, staged, translate_write_errors
from splatseed.progress import Progress, extraction_progress, silent
from splatseed.requirements import require
from splatseed.runtime.fingerprint import fingerprint

ANALYSIS_WIDTH = 256
"""Width at which frames are analysed, px."""
_MAX_SELECTED = 1000
"""Frames that ffmpeg selects by number; it need not convert and send the others."""
_HIDDEN = ["-ignore_editlist", "1"]
"""ffmpeg's option for frames that an MP4's edit list hides, such as those before its time 0."""
UNUSED_DAYS = 30
"""Extracted photographs are removed once no call has used them for this long."""
_SAMPLE = 1 << 20
"""Bytes at a file's start and at its end that identify it, with its size: headers and indices of
videos are there, and hashing gigabytes would take seconds at each call."""


# Choosing frames ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class FilmSettings:
    """How many frames of a recording are used."""

    max_photographs: int = 500
    """Of the photographs of a recording: a capture's usual number, at most; such apps save 30 or 60
    a second."""
    max_frames: int = 300
    """Of a video's frames: neighbours are then some centimetres apart in a walk of a minute, and
    the JPEGs of 1,920 x 1,440 pixels take 0.3 GB."""
    min_step: float = 0.02
    """Smallest image motion between chosen frames of a video, in widths."""
    distance: float = 2.0
    """Assumed distance of what a walking camera sees, metres: weighs steps against turns."""


FILM = FilmSettings()


def choose_frames(
    sharpness: Float64[np.ndarray, " F"],
    motion: Float64[np.ndarray, " F"],
    limit: int,
    min_step: float = FILM.min_step,
) -> Int64[np.ndarray, " P"]:
    """Choose the sharpest frame in each of at most ``limit`` equal intervals of motion.

    Intervals are ``min_step`` or longer.
    """
    if not len(motion):
        return np.empty(0, np.int64)
    step = max(motion[-1] / limit, min_step)
    interval = np.minimum((motion / step).astype(np.int64), max(int(motion[-1] / step) - 1, 0))
    order = np.lexsort((-sharpness, interval))
    return np.sort(order[np.unique(interval[order], return_index=True)[1]])


def pose_motion(
    rotations: Float64[np.ndarray, "F 3 3"], centers: Float64[np.ndarray, "F 3"], focal: float
) -> Float64[np.ndarray, " F"]:
    """Predict the cumulative image motion of a moving camera, in widths.

    A turn by an angle a moves the picture by about f a; a step s, seen at the assumed distance d,
    by f s / d.

    Args:
        rotations: World from camera, in order of time.
        centers: Of the cameras, metres.
        focal: Focal length f in image widths.
    """
    if not len(centers):
        return np.zeros(0)
    # Two rotations an angle a apart differ by sqrt(8) sin(a / 2) in the Frobenius norm.
    apart = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
    turns = 2 * np.arcsin(np.minimum(apart / np.sqrt(8), 1.0))
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(focal * (turns + steps / FILM.distance))])


def choose_photographs(
    details: Float64[np.ndarray, " F"],
    rotations: Float64[np.ndarray, "F 3 3"],
    centers: Float64[np.ndarray, "F 3"],
    focal: float,
) -> Int64[np.ndarray, " P"]:
    """Choose among the photographs of a recording: all, unless there are too many.

    ``details`` are higher for the sharper of two photographs of the same content; the others are
    the arguments of ``pose_motion``.
    """
    if len(details) <= FILM.max_photographs:
        return np.arange(len(details))
    motion = pose_motion(rotations, centers, focal)
    return choose_frames(details, motion, FILM.max_photographs)


def chosen_finding(how_many: str) -> Finding:
    """Report that some frames of a recording are used; ``how_many`` begins the sentence."""
    which = "the sharpest at equal distances of the camera's motion"
    return Finding("chosen-photographs", f"{how_many} are used: {which}.", "info")


# Videos -------------------------------------------------------------------------------------------


def small_frames(
    video: Path, progress: Progress, *, hidden: bool = False
) -> Iterator[Float32[np.ndarray, "H W"]]:
    """Yield all frames in grey, ``ANALYSIS_WIDTH`` wide, values from 0 to 255.

    ``hidden``: also those that the file's edit list hides from players.

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


# The cache ----------------------------------------------------------------------------------------


def extracted(source: Path, facts: object, fill: Callable[[Path, Progress], None]) -> Path:
    """Return the folder of what ``fill`` extracts from ``source``; fill it if there is none yet.

    ``facts`` determine the content: fingerprints and settings. Raises ``OutputError`` if the cache
    cannot be written.
    """
    base = _base()
    folder = base / f"{source.stem}-{fingerprint(facts)[:16]}"
    try:
        with translate_write_errors(folder):
            base.mkdir(parents=True, exist_ok=True)
            with locked(base, wait=True):  # of several processes, one extracts, the others wait
                if not folder.is_dir():
                    _remove_unused(base)
                    with staged(folder, folder=True) as partial:
                        fill(partial, extraction_progress.get(silent))
    except OutputError as error:
        where = "Photographs inside a file are extracted into the user's cache folder"
        fix = f"{error.fix} {where}, which XDG_CACHE_HOME sets on Linux."
        raise OutputError(error.expected, found=error.found, fix=fix) from error
    with suppress(OSError):  # a cache that others filled may be read-only
        os.utime(folder)
    return folder


def is_extracted(path: Path) -> bool:
    """Whether a file or folder lies in the cache of extracted photographs."""
    return _base().resolve() in path.resolve().parents


def identity(path: Path) -> str:
    """Fingerprint a large file by its size, first and last bytes."""
    with translate_read_errors(path), open_file(path) as file:
        first, size = file.read(_SAMPLE), os.fstat(file.fileno()).st_size
        file.seek(max(0, size - _SAMPLE))
        return fingerprint(size, first, file.read(_SAMPLE))


def _base() -> Path:
    return user_cache_path("splatseed", appauthor=False) / "captures"


def _remove_unused(base: Path) -> None:
    for folder in base.iterdir():
        with suppress(OSError):
            if time.time() - folder.stat().st_mtime > UNUSED_DAYS * 86_400:
                remove(folder)
