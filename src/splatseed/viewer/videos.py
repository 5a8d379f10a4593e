"""Frames of a path through a model, as a video or as a folder of pictures.

Promise: either appears complete or not at all, and players show the colours of a video's frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from PIL import Image

from splatseed.errors import OutputError
from splatseed.findings import Finding
from splatseed.io.staging import atomic_file, output_folder
from splatseed.photos.view import View
from splatseed.progress import Progress, silent
from splatseed.requirements import require
from splatseed.sampling import evenly_spaced
from splatseed.splat.covisible import COVISIBILITY, farthest, seen_cells
from splatseed.splat.pictures import to_uint8
from splatseed.splat.rendering import ModelRenderer
from splatseed.text import counted
from splatseed.viewer.flights import at_size
from splatseed.viewer.models import split_picture
from splatseed.viewer.page import depth_picture, nearness, value_range

DEPTH_SAMPLES = 7  # frames of a path that are rendered to find its depth range
QUALITY = 8  # imageio-ffmpeg's, 0 to 10
MIN_SHOWN = 0.01  # mean alpha below which a frame counts as empty
MAX_COMPARED, MAX_GUESSED = 20, 0.05
"""Frames that are compared with the photographs, and the share of a frame that may show what none
does: with three of fern, at most 0.7% on the way from camera to camera, 2 to 6% at half the extent
of the cameras beside it, 7 to 12% at the whole; with 123 of treehill, at most 0.8% on the way,
0 to 16% and 0 to 72%."""
FLIGHT = "flight"
"""The kind of a folder of pictures."""
_COLOURS = (
    "-vf", ("scale=out_color_matrix=bt709:out_range=tv,"
            "setparams=range=tv:colorspace=bt709:color_primaries=bt709:color_trc=bt709"),
    "-color_range", "tv", "-colorspace", "bt709", "-color_primaries", "bt709",
    "-color_trc", "bt709",
)  # fmt: skip
"""ffmpeg's options: it converts by BT.601 and says so nowhere, which players take for BT.709 from
720 rows on. Filters set what newer versions write, options what older ones do."""


class Frame(NamedTuple):
    """A rendered view."""

    picture: UInt8[np.ndarray, "H W 3"]
    shown: float  # share of the picture that the (first) model covers


def flight_frames(
    renderers: Sequence[ModelRenderer],
    names: Sequence[str],
    path: Sequence[View],
    *,
    depth: bool = False,
    progress: Progress = silent,
) -> Iterator[Frame]:
    """Render the views of a path, of a model or of two side by side with their names."""
    if depth:
        sample = path[:: max(1, len(path) // DEPTH_SAMPLES)]
        near = [nearness(renderers[0].depth(view)).ravel() for view in sample]
        limits = value_range(np.concatenate(near))
    for i, view in enumerate(path):
        pictures, shown = [], []
        for renderer in renderers:
            if depth:
                depths = renderer.depth(view)
                pictures.append(depth_picture(depths, limits))
                shown.append(float((depths > 0).mean()))
                continue
            image, alpha = renderer.image_and_alpha(view)
            pictures.append(to_uint8(image))
            shown.append(float(alpha.mean()))
        picture = pictures[0]
        if len(pictures) > 1:
            picture = split_picture(pictures[0], pictures[1], *names)
        yield Frame(picture, shown[0])
        progress("render", (i + 1) / len(path))


def unseen_findings(shown: Sequence[float], names: Sequence[str]) -> list[Finding]:
    """Say which frames show next to nothing of the model."""
    empty = [name for name, share in zip(names, shown, strict=True) if share < MIN_SHOWN]
    if not empty:
        return []
    text = f"{len(empty):,} of {counted(len(names), 'frame')} show next to nothing of the model, "
    text += f"such as {empty[0]}: the cameras are outside of it or look away."
    return [Finding("empty-frames", text, subjects=tuple(empty))]


def guessed_findings(
    renderer: ModelRenderer,
    path: Sequence[View],
    photographs: Sequence[View],
    progress: Progress = silent,
) -> list[Finding]:
    """Say which frames show much that no photograph shows.

    Some frames are compared with the ``photographs``' views, at a small size: with the nearest ones
    first, and with further ones as long as these do not show enough.
    """
    if not photographs:
        return []

    def surface(view: View) -> tuple[View, Float32[np.ndarray, "H W"]]:
        small = at_size(view, even_size(view.width, view.height, COVISIBILITY.num_cells))
        depth = renderer.depth(small)
        return small, np.where(depth > 0, depth, np.float32(np.inf))

    @cache
    def seen(i: int) -> tuple[View, Float32[np.ndarray, "H W"]]:
        view, depths = surface(photographs[i])
        return view, farthest(depths)

    poses = np.array([view.camera.world_from_cam for view in photographs])
    sample = [path[i] for i in evenly_spaced(len(path), MAX_COMPARED)]

    def guessed(frame: View) -> float:
        view, depths = surface(frame)
        unseen = np.isfinite(depths)
        # A turn by one radian counts as a move by the distance of what is shown.
        away = poses - view.camera.world_from_cam
        away[:, :3, 3] /= np.median(depths[unseen]) if unseen.any() else 1.0
        for i in np.argsort((away**2).sum(axis=(1, 2)), kind="stable"):
            if unseen.mean() <= MAX_GUESSED:
                break
            unseen &= ~seen_cells(view, depths, [seen(int(i))], min_views=1)
        return float(unseen.mean())

    shares = dict[str, float]()
    for frame in sample:
        shares[frame.name] = guessed(frame)
        progress("compare frames", len(shares) / len(sample))
    worst = max(shares, key=lambda name: shares[name])
    many = tuple(name for name, share in shares.items() if share > MAX_GUESSED)
    if not many:
        return []
    text = f"{len(many)} of {counted(len(shares), 'frame')} that were checked show parts that no "
    text += f"photograph shows, where the model is a guess: up to {shares[worst]:.0%} ({worst})."
    fix = "Keep the path between the photographs' cameras, or take photographs from there."
    return [Finding("guessed-frames", text, subjects=many, fix=fix)]


def even_size(width: int, height: int, limit: int | None = None) -> tuple[int, int]:
    """Nearest size with even sides, as H.264 needs, and the longer one at most ``limit``."""
    scale = min(1.0, limit / max(width, height)) if limit else 1.0
    width, height = (max(2, 2 * round(scale * side / 2)) for side in (width, height))
    return width, height


def write_pictures(
    folder: Path,
    pictures: Iterable[UInt8[np.ndarray, "H W 3"]],
    names: Sequence[str],
    *,
    overwrite: bool = False,
) -> None:
    """Write PNG files of these names into a new folder.

    Raises:
        OutputError: The folder has other content, or cannot be written.
    """
    with output_folder(folder, kind=FLIGHT, overwrite=overwrite) as partial:
        for name, picture in zip(names, pictures, strict=True):
            Image.fromarray(picture).save(partial / name)


def write_video(
    path: Path, frames: Iterable[UInt8[np.ndarray, "H W 3"]], size: tuple[int, int], fps: float
) -> None:
    """Write frames as H.264 to a .mp4, .mkv or .mov; replaces an existing file.

    Width and height of all frames are even.
    """
    require("imageio_ffmpeg")
    import imageio_ffmpeg  # noqa: PLC0415  (of the extra view)

    with atomic_file(path) as partial:
        writer = imageio_ffmpeg.write_frames(
            str(partial), size, fps=fps, quality=QUALITY, macro_block_size=2,
            ffmpeg_log_level="error", output_params=[*_COLOURS, "-movflags", "+faststart"],
        )  # fmt: skip
        sent = 0
        try:
            with closing(writer):  # on errors, too: ffmpeg must end before its file is removed
                writer.send(None)
                for sent, frame in enumerate(frames, 1):  # noqa: B007  (the last number is used)
                    writer.send(np.ascontiguousarray(frame))
            # imageio-ffmpeg does not report whether ffmpeg could write the end of the file.
            written = 0
            with suppress(RuntimeError):
                written, _ = imageio_ffmpeg.count_frames_and_secs(str(partial))
            if written != sent:
                raise RuntimeError(f"{written} of {sent} frames")  # noqa: TRY301
        except (OSError, RuntimeError) as error:  # ffmpeg ended early
            raise OutputError(
                f"{path} to be written",
                found=" ".join(str(error).split())[-160:] or type(error).__name__,
                fix="Check the disk and try again. The incomplete file was removed.",
            ) from None
