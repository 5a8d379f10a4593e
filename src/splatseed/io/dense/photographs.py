"""The photographs of a COLMAP dense workspace: unchanged or undistorted.

Notation: the pinhole camera of an undistorted photograph has the lens's own focal length, centre
and size. Promise: photographs are linked or copied, and never written to; undistorted ones keep
their names and file types.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from splatseed.camera import Intrinsics
from splatseed.errors import OutputError, SceneFormatError
from splatseed.io.dense.maps import scaled_K
from splatseed.io.depth.folder import safe_parts
from splatseed.io.output.image_folders import bring, image_folders
from splatseed.io.photograph import decode_photograph, open_photograph, photograph_bytes
from splatseed.progress import Progress, in_threads
from splatseed.scene import Image, Scene

Undistort: TypeAlias = Callable[
    [UInt8[np.ndarray, "H W 3"], Intrinsics, Float64[np.ndarray, "3 3"]],
    tuple[UInt8[np.ndarray, "H W 3"], Bool[np.ndarray, "H W"]],
]
"""``splatseed.views.undistortion.undistort`` or an equivalent: takes pixels, lens and matrix, and
returns pixels and which of them are known."""

_ASPECT_SLACK = 0.02
_QUALITY: dict[str, Any] = {"quality": 95, "subsampling": 0}
"""Quality of JPEGs that are written: their pixels come from JPEGs already."""


def check_image(image: Image, folder: Path, *, undistorts: bool) -> tuple[int, int]:
    """Check that a photograph can be used, and return its width and height.

    Raises:
        SceneNotFoundError: It is missing.
        SceneFormatError: It has distortion that cannot be undone, or is not of its camera's shape.
        OutputError: Its name leads out of its folder.
    """
    lens = image.intrinsics
    if lens.has_distortion:
        _check_lens(image, undistorts=undistorts)
    if "/".join(safe_parts(image.name)) != image.name or "\n" in image.name:
        raise OutputError(
            "image names that stay inside their folder",
            found=repr(image.name),
            fix="Rename the image.",
        )
    path = folder / image.name
    size = open_photograph(path, photograph_bytes(path)).size
    if abs(size[0] / size[1] / (lens.width / lens.height) - 1) > _ASPECT_SLACK:
        raise SceneFormatError(
            f"{path} to have the shape of its camera, {lens.width} x {lens.height}",
            found=f"{size[0]} x {size[1]}",
            fix="Use the images that the model was made from, or a resized copy of them.",
        )
    return size


def _check_lens(image: Image, *, undistorts: bool) -> None:
    if not undistorts:
        raise SceneFormatError(
            "cameras without lens distortion (PINHOLE), as COLMAP's dense tools need them",
            found=f"{image.intrinsics.model} for {image.name}",
            fix="Undistort the scene first: splatseed undistort SCENE -o OUT.",
        )
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    suffix = Path(image.name).suffix
    if PilImage.registered_extensions().get(suffix.lower()) not in PilImage.SAVE:
        raise SceneFormatError(
            "photographs that can be written again once they are undistorted (.jpg, .png, .tif)",
            found=image.name,
            fix="Export them as one of these, or undistort the scene first.",
        )


def bring_photographs(
    scene: Scene, folder: Path, undistort: Undistort | None, progress: Progress, *, copy: bool
) -> list[str]:
    """Fill ``images`` in a folder; returns the paths of what was made, inside the folder.

    Args:
        scene: Of checked images.
        folder: The workspace.
        undistort: Removes lens distortion; None if there is none.
        progress: Called with the stage and the fraction done.
        copy: Whether to copy rather than link.
    """
    bent = [image for image in scene.images if image.intrinsics.has_distortion]
    source = scene.source.image_dir if scene.source else None
    if undistort is None or not bent or source is None:
        folders = image_folders(scene)
        wanted = {n: p for n, p in folders.items() if n == "images" or n.startswith("images/")}
        return bring(wanted, folder, copy=copy)
    straight = [image.name for image in scene.images if not image.intrinsics.has_distortion]
    bring({f"images/{name}": source / name for name in straight}, folder, copy=copy)

    def work(start: int, stop: int) -> None:
        for image in bent[start:stop]:
            _write_undistorted(image, source / image.name, folder / "images", undistort)

    in_threads(work, len(bent), 1, "undistort", progress)
    return ["images"]


def _write_undistorted(image: Image, path: Path, folder: Path, undistort: Undistort) -> None:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    pixels = np.asarray(decode_photograph(path, photograph_bytes(path)))
    height, width = pixels.shape[:2]
    straight, _ = undistort(pixels, image.intrinsics, scaled_K(image.camera, width, height))
    target = folder / image.name
    target.parent.mkdir(parents=True, exist_ok=True)
    jpeg = PilImage.registered_extensions()[target.suffix.lower()] == "JPEG"
    PilImage.fromarray(straight).save(target, **(_QUALITY if jpeg else {}))
