"""The sizes at which photographs are used: of their files, divided by a whole factor.

A photograph is never enlarged; pixels at the right and lower edge that do not fill a block of
factor x factor are cut off, so intrinsics are divided by the factor and nothing else changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from splatseed.errors import SceneFormatError
from splatseed.io.photograph_checks import file_sizes, resized_to
from splatseed.scene import Image, Scene

TRAINED_SIDE = 1600
"""Longer side of photographs in training by default, in pixels, as in graphdeco's trainer."""


def at_file_size(scene: Scene) -> Scene:
    """The scene, with the camera of each image in pixels of its photograph's file.

    Photographs may be resized copies of those in the model. An image keeps its camera if its
    photograph is missing, unreadable or of another shape.
    """
    folder = scene.source.image_dir if scene.source else None
    images = resized_to(scene.images, {} if folder is None else file_sizes(scene.images, folder))
    if all(image is before for image, before in zip(images, scene.images, strict=True)):
        return scene
    cameras = {lens.camera_id: lens for lens in scene.intrinsics}
    cameras |= {image.intrinsics.camera_id: image.intrinsics for image in images}
    return scene.replace(images=images, intrinsics=tuple(cameras.values()))


def factor_for_size(images: Sequence[Image], max_size: int) -> int:
    """The smallest whole factor that makes the longest side at most ``max_size`` pixels."""
    side = max(max(image.camera.width, image.camera.height) for image in images)
    return max(1, -(-side // max_size))


def default_factor(images: Sequence[Image]) -> int:
    """The factor by which training downsamples photographs by default."""
    return factor_for_size(images, TRAINED_SIDE) if images else 1


def check_side(name: Path | str, min_side: int, data_factor: int, size: tuple[int, int]) -> None:
    """Refuse a downsampled photograph (SceneFormatError) with a side below ``min_side`` pixels."""
    if min(size) < min_side:
        pixels = "pixel" if min_side == 1 else "pixels"
        raise SceneFormatError(
            f"{name} to have at least {min_side} {pixels} a side, divided by {data_factor}",
            found=f"{size[0]} x {size[1]}",
            fix="Choose a smaller `data_factor`, or a larger `long_side`.",
        )
