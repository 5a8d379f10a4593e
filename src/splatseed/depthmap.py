"""DepthMap: an image's depth per pixel, and the source of such maps.

Notation: a map is H x W pixels and belongs to one image, of the same size or at least the same
aspect ratio: its pixel (column u, row v) has its centre at ((u + 0.5) / W, (v + 0.5) / H) of the
image's width and height. Promise: values are float32, NaN where unknown; a ``DepthMaps`` reads each
map on demand, so a scene's maps need not fit in memory.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.camera import Camera, same_shape
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError, UnknownNameError
from splatseed.frozen import read_only
from splatseed.projection import scaled
from splatseed.text import did_you_mean

DepthKind = Literal["z", "ray", "inverse"]
"""Meaning of a value: planar depth z along the camera's axis, distance along the pixel's ray, or an
inverse depth of the form a / z + b (what most monocular networks predict)."""

MIN_CONFIDENCE = 1
"""Default confidence from which on depth is used. On a phone's capture (corridor) depth of
confidence 0, 1 and 2 is within 5% of other views' at 75%, 85% and 98% of the pixels. Where
photographs confirm none, 79% of the seeds of confidence 1 are within 5% of a surface, and 70% of
the guesses that they replace; of confidence 0, 47% are, and 52%."""
ASPECT_SLACK = 0.02
"""Largest relative difference of a map's aspect ratio from its image's, beyond a pixel."""


@dataclass(frozen=True, eq=False)
class DepthMap:
    """The depth map of one image.

    Values are NaN where unknown. Of the kinds "z" and "ray" they are positive, in scene units or in
    a multiple of them that alignment determines.
    """

    values: Float32[np.ndarray, "H W"]
    kind: DepthKind = "z"  # what a value is
    K: Float64[np.ndarray, "3 3"] | None = None  # in pixels of the map; None: the image's, scaled
    confidence: UInt8[np.ndarray, "H W"] | None = None
    """The sensor's confidence, 0 low, 1 medium, 2 high (ARKit's ARConfidenceLevel); None: unknown.
    """

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))
        if self.confidence is None:
            return
        if np.shape(self.confidence) != self.values.shape:
            raise ParameterError(
                f"a confidence per pixel of the depth map, {self.height} x {self.width}",
                found=" x ".join(map(str, np.shape(self.confidence))),
                fix="Resize both alike.",
            )
        object.__setattr__(self, "confidence", read_only(self.confidence, np.uint8))

    def reliable(self, min_confidence: int) -> DepthMap:
        """Return the map with depth of a lower confidence unknown; itself without a confidence."""
        if self.confidence is None or min_confidence <= 0:
            return self
        sure = self.confidence >= min_confidence
        return replace(self, values=np.where(sure, self.values, np.float32(np.nan)))

    @property
    def width(self) -> int:
        """Pixels in a row."""
        return int(self.values.shape[1])

    @property
    def height(self) -> int:
        """Pixels in a column."""
        return int(self.values.shape[0])

    def camera(self, camera: Camera) -> Camera:
        """The image's camera in the map's pixels: same pose, and ``K`` or the image's, scaled.

        Raises:
            SceneFormatError: The map and the image differ in aspect ratio.
        """
        if self.K is not None:
            return Camera(self.K, self.width, self.height, camera.cam_from_world)
        scale = np.array([self.width / camera.width, self.height / camera.height])
        alike = same_shape((self.width, self.height), (camera.width, camera.height))
        if not alike and abs(scale[0] / scale[1] - 1) > ASPECT_SLACK:
            raise SceneFormatError(
                f"a depth map with the aspect ratio of its image, {camera.width} x {camera.height}",
                found=f"{self.width} x {self.height}",
                fix="Make depth from the images of this scene, or resize both alike.",
            )
        return Camera(scaled(camera.K, *scale), self.width, self.height, camera.cam_from_world)


@runtime_checkable
class DepthMaps(Protocol):
    """The depth maps of a scene, by image name.

    An optional member, ``in_scene_units``, is True where depth comes with the capture and needs no
    alignment, as a LiDAR's in metres beside poses in metres.
    """

    def __contains__(self, name: object) -> bool:
        """Whether the image of that name has a map."""

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the images that have a map."""

    def __len__(self) -> int:
        """Return the number of images that have a map."""

    def read(self, name: str) -> DepthMap:
        """Read the map of an image; threads may call this at once.

        Raises:
            SceneNotFoundError: The image has none, or its file is gone.
            SceneFormatError: The file is not what its format promises.
        """


class HeldDepths(dict[str, DepthMap]):
    """Depth maps in memory, by image name."""

    def read(self, name: str) -> DepthMap:
        """Return the map of an image."""
        if name not in self:
            raise SceneNotFoundError(
                f"a depth map of {name}", found=f"maps of {len(self):,} others", fix="Add one."
            )
        return self[name]


def in_scene_units(maps: DepthMaps | None) -> bool:
    """Whether there are maps, and their depth needs no alignment."""
    return maps is not None and len(maps) > 0 and bool(getattr(maps, "in_scene_units", False))


def maps_by_name(maps: Any, names: Collection[str], distorted: Collection[str] = ()) -> DepthMaps:
    """Convert depth maps in memory to a scene's ``DepthMaps``.

    Args:
        maps: ``DepthMaps``; a mapping from image names to a ``DepthMap`` or an array of planar
            depth; or records with a ``name``, planar ``depth`` and ``camera``, as
            ``stereo_depths`` returns.
        names: Names of the scene's images.
        distorted: Names of images whose cameras have lens distortion. Stereo's maps are of
            photographs without it, so they do not fit.

    Raises:
        UnknownNameError: The scene has no image of a map's name.
        ParameterError: ``maps`` is none of these, or stereo's of such an image.
    """
    if isinstance(maps, DepthMaps):
        return maps
    try:
        if isinstance(maps, Mapping):
            held, distorted = HeldDepths({name: _as_map(each) for name, each in maps.items()}), ()
        else:
            held = HeldDepths({each.name: _as_map(each.depth, each.camera.K) for each in maps})
    except (AttributeError, TypeError, ValueError):
        raise ParameterError(
            "depth maps by image name, such as find_depths gives, or what stereo_depths returns",
            found=type(maps).__name__,
            fix="Pass a dict of DepthMap by image name.",
        ) from None
    if unknown := sorted(held.keys() - set(names)):
        raise UnknownNameError(
            "depth maps of the scene's images",
            found=repr(unknown[0]),
            fix=did_you_mean(unknown[0], names) or "scene.images lists them, each with its name.",
        )
    if bent := [name for name in held if name in distorted]:
        raise ParameterError(
            "stereo's depth maps of images without lens distortion",
            found=f"a lens with distortion for {bent[0]}",
            fix="Undistort the scene first: splatseed undistort SCENE -o OUT.",
        )
    return held


def _as_map(values: Any, K: Float64[np.ndarray, "3 3"] | None = None) -> DepthMap:
    if isinstance(values, DepthMap):
        return values
    array = np.asarray(values, np.float32)
    if array.ndim != 2:
        raise ValueError
    return DepthMap(np.where(array > 0, array, np.float32(np.nan)), K=K)
