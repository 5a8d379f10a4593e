"""DepthFiles: the depth maps of a scene, one file per image, read on demand.

Notation: ``scale`` is stored units per scene unit, by which a file's numbers are divided.
Promise: a map is float32 with NaN where unknown; nothing stays in memory, and reading is safe from
several threads at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from splatseed.depthmap import DepthKind, DepthMap
from splatseed.errors import SceneNotFoundError
from splatseed.io.depth.arrays import (
    StoredDepth,
    read_colmap_depth,
    read_npy,
    read_npz,
    read_pfm,
)
from splatseed.io.depth.lens import Undistortion
from splatseed.io.depth.pictures import read_exr, read_picture

INTEGER_SCALE = 1000.0
"""Default scale of integer maps: millimetres in a scene in metres."""
NOTHING_HIT = 1e9
"""From this distance on, a value means that a renderer's ray hit nothing; Blender writes 1e10."""

_SATURATED = 65535
_READERS: dict[str, Callable[[Path], StoredDepth]] = {
    ".npy": read_npy,
    ".npz": read_npz,
    ".exr": read_exr,
    ".pfm": read_pfm,
    ".bin": read_colmap_depth,
    ".tiff": read_picture,
    ".tif": read_picture,
    ".png": read_picture,
}
SUFFIXES = tuple(_READERS)
"""Suffixes of readable files. PNG comes last: beside a file of exact numbers it is their
picture."""


@dataclass(frozen=True, eq=False)
class DepthFiles:
    """Depth maps in files; what ``Scene.depths`` holds for a scene that was read.

    Args:
        paths: The file of each image that has one, by the image's name.
        kind: What the values are; None: what the file itself says, else planar z.
        scale: Stored units per scene unit; None: 1000 for integers, 1 for floats.
        lens: Moves the values to the pixels of undistorted photographs; None: no need to.
    """

    paths: Mapping[str, Path]
    kind: DepthKind | None = None
    scale: float | None = None
    lens: Undistortion | None = None

    def __contains__(self, name: object) -> bool:
        """Whether there is a file for the image of that name."""
        return name in self.paths

    def __iter__(self) -> Iterator[str]:
        """The names of the images that have a file, sorted."""
        return iter(sorted(self.paths))

    def __len__(self) -> int:
        """How many images have a file."""
        return len(self.paths)

    def read(self, name: str) -> DepthMap:
        """The map of an image; safe to call from several threads.

        NaN stands where nothing is known: the file has NaN, an infinity, or 1e9 and more; 0 or less
        (for inverse depth only integer zeros, since a network may predict 0 for far pixels); or
        65535 in 16 bits, the end of the sensor's range.

        Raises:
            SceneNotFoundError: The image has no file, or it is gone.
            SceneFormatError: The file is not what its format promises.
            MissingDependencyError: It is an OpenEXR file, and that package is absent.
        """
        path = self.paths.get(name)
        if path is None:
            raise SceneNotFoundError(
                f"a depth map of {name}", found="none", fix="Leave this image out."
            )
        stored = _READERS[path.suffix.lower()](path)
        kind = self.kind or stored.kind or "z"
        values = _in_scene_units(stored.values, self.scale, kind)
        return DepthMap(values if self.lens is None else self.lens.apply(name, values), kind)


def _in_scene_units(
    stored: np.ndarray, scale: float | None, kind: DepthKind
) -> Float32[np.ndarray, "H W"]:
    """Divide by the scale, and put NaN wherever nothing is known."""
    is_integer = stored.dtype.kind in "ui"
    divisor = scale or (INTEGER_SCALE if is_integer else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):  # becomes infinite, and so NaN
        values: np.ndarray = (stored / np.float64(divisor)).astype(np.float32)
        unknown = (
            ~(np.abs(values) < NOTHING_HIT)
            if kind == "inverse"
            else ~((values > 0) & (values < NOTHING_HIT))
        )
    if is_integer and kind == "inverse":
        unknown |= stored == 0
    elif stored.dtype == np.uint16:
        unknown |= stored == _SATURATED
    values[unknown] = np.nan
    return values
