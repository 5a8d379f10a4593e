"""The sizes at which photographs are used: of their files, divided by a factor.

A photograph is never enlarged. The factor (``io.downsampling``) is whole, so that intrinsics are
divided by it and nothing else changes, unless training is to use an exact size.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatseed.camera import Intrinsics
from splatseed.errors import SceneFormatError
from splatseed.scene import Image

TRAINED_SIDE = 1600
"""Longer side of photographs in training by default, in pixels, as in graphdeco's trainer."""


def at_file_size(images: Sequence[Image]) -> tuple[Image, ...]:
    """Images with camera records and features in pixels of the files, as COLMAP needs them.

    If photographs of several sizes share a camera, each further size gets a new camera with an id
    above all others.
    """
    free = itertools.count(1 + max((image.intrinsics.camera_id for image in images), default=0))
    records: dict[tuple[Intrinsics, Intrinsics], Intrinsics] = {}
    used, changed = set[int](), list[Image]()
    for image in images:
        record, lens, seen = image.intrinsics, image.lens, image.observations
        if (record, lens) not in records:
            camera_id = next(free) if lens.camera_id in used else lens.camera_id
            used.add(camera_id)
            records[record, lens] = replace(lens, camera_id=camera_id)
        if seen is not None:
            scale = np.array([lens.width, lens.height]) / [record.width, record.height]
            seen = replace(seen, xy=seen.xy * scale)
        changed.append(replace(image, intrinsics=records[record, lens], observations=seen))
    return tuple(changed)


def factor_for_size(images: Sequence[Image], max_size: int) -> int:
    """The smallest whole factor that makes the longest side at most ``max_size`` pixels."""
    side = max(max(image.camera.width, image.camera.height) for image in images)
    return max(1, -(-side // max_size))


def default_factor(images: Sequence[Image]) -> int:
    """The factor by which training downsamples photographs by default."""
    return factor_for_size(images, TRAINED_SIDE) if images else 1


def factor_for_side(images: Sequence[Image], long_side: int) -> float:
    """The factor, whole or not, that makes the longest side ``long_side`` pixels; at least 1."""
    side = max(max(image.camera.width, image.camera.height) for image in images)
    if side <= long_side:
        return 1
    return side / long_side if side % long_side else side // long_side


def check_side(name: Path | str, min_side: int, data_factor: float, size: tuple[int, int]) -> None:
    """Refuse a downsampled photograph (SceneFormatError) with a side below ``min_side`` pixels."""
    if min(size) < min_side:
        pixels = "pixel" if min_side == 1 else "pixels"
        raise SceneFormatError(
            f"{name} to have at least {min_side} {pixels} a side, divided by {data_factor:g}",
            found=f"{size[0]} x {size[1]}",
            fix="Choose a smaller `data_factor`, or a larger `long_side`.",
        )
