"""Scene: cameras, images, points and tracks, as read from a capture.

Notation: an ``_id`` comes from a file and may have gaps, an ``_idx`` is contiguous. ``tracks``
belong to the first ``len(tracks)`` points, which are the originals in file order. Promise: a Scene
is frozen; ``replace`` and ``with_...`` return copies; photographs and masks are the only files that
its images open, when needed: cameras are in pixels of the photographs' files.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace as dataclass_replace
from difflib import get_close_matches
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from splatseed.camera import Camera, Intrinsics, rotation_from_quat
from splatseed.depthmap import DepthMaps, maps_by_name
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError, UnknownNameError
from splatseed.findings import Finding
from splatseed.frozen import freeze, read_only
from splatseed.pointcloud import PointCloud
from splatseed.tracks import Observations, Tracks

Color = tuple[int, int, int]
"""Red, green and blue, 0 to 255, sRGB."""
BLACK: Color = (0, 0, 0)

OPENCV = "with OpenCV's camera axes (x right, y down, z forward)"
OPENGL = "with OpenGL's camera axes (x right, y up, z back)"

TEST_EVERY = 8
"""By default every 8th image by name tests, from the first; of panoramas all faces or none."""
MIN_HELD_OUT = 12
"""Fewest images of which ``train`` holds some out by default. PSNR rises by about 4 dB where
photographs double, in published tables (3 to 6 of LLFF: 20.4 to 24.5; 12 to 24 of Mip-NeRF360: 19.5
to 23.4). So to hold out every 8th costs about 2 dB with 3 photographs and 1 with 6 to 11, for a
score that rests on one or two of them. The faces of a panorama count as one image: they add no
other viewpoint."""
_FACE_NAME = re.compile(r"(?P<folder>.*/)?(front|right|back|left|up|down)_(?P<panorama>[^/]+)")
"""Names of faces, as ``sfm.panoramas`` gives them."""


@dataclass(frozen=True, eq=False)
class Image:
    """One posed photograph.

    The pose is kept as the quaternion and translation of the file, and camera and features in
    pixels of the file's camera record, so that they are written back bit for bit. ``lens``,
    ``camera`` and ``K`` are in pixels of the photograph, which may be a resized copy.
    """

    name: str  # path relative to the images folder, with forward slashes
    image_id: int  # that tracks refer to
    intrinsics: Intrinsics  # the camera record, as in the file
    quat: Float64[np.ndarray, " 4"]  # wxyz rotation of ``cam_from_world``, as in the file
    translation: Float64[np.ndarray, " 3"]  # of ``cam_from_world``
    observations: Observations | None = None  # None where the format has none
    # A scene sets the following.
    folder: Path | None = None  # the images folder; None for a scene without one
    white: int = 65535  # the value of white in 16-bit photographs
    masks: Masks | None = None  # which pixels of the scene's photographs do not count
    background: Color = BLACK  # over which transparent pixels are composited

    def __post_init__(self) -> None:
        freeze(self, "quat", "translation")

    def __repr__(self) -> str:
        lens = self.lens
        seen = f", {self.observations}" if self.observations is not None else ""
        return f"Image({self.name!r}, {lens.width} x {lens.height} {lens.model}{seen})"

    @property
    def path(self) -> Path:
        """Path of the photograph, which need not exist.

        Raises:
            SceneNotFoundError: The image has no folder: its scene was made in memory.
        """
        if self.folder is None:
            raise SceneNotFoundError(
                f"a folder that holds the photograph {self.name}",
                found="none",
                fix="Load the scene from a folder that has its photographs.",
            )
        return self.folder / self.name

    @property
    def has_photograph(self) -> bool:
        """Whether the photograph's file exists."""
        return self.folder is not None and self.path.is_file()

    @cached_property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the photograph's file; None if it is missing or unreadable."""
        from splatseed.io.photograph_checks import photograph_size

        if self.has_photograph:
            with suppress(SceneFormatError, SceneNotFoundError):
                return photograph_size(self.path)
        return None

    @cached_property
    def lens(self) -> Intrinsics:
        """The camera record in pixels of the photograph's file.

        That is ``intrinsics`` if the photograph is missing, unreadable or of another shape.
        """
        from splatseed.io.photograph_checks import fits

        if self.size is None or not fits(self.intrinsics, self.size):
            return self.intrinsics
        return self.intrinsics.resized(*self.size)

    @property
    def K(self) -> Float64[np.ndarray, "3 3"]:  # noqa: N802  (the field's name)
        """Pinhole matrix [3, 3] in pixels of the photograph."""
        return self.camera.K

    @cached_property
    def cam_from_world(self) -> Float64[np.ndarray, "4 4"]:
        """Pose [4, 4]: maps world points to OpenCV camera axes (x right, y down, z forward)."""
        cam_from_world = np.eye(4)
        cam_from_world[:3, :3] = rotation_from_quat(self.quat)
        cam_from_world[:3, 3] = self.translation
        return read_only(cam_from_world)

    def read(self) -> UInt8[np.ndarray, "H W 3"]:
        """Read the photograph, sRGB, as stored: not rotated by EXIF, resized or undistorted.

        Transparent pixels are composited over the background; where masks leave them out, those
        below half of the full alpha have its colour and the others are opaque.

        Raises:
            SceneNotFoundError: There is no such file.
            SceneFormatError: It is no image, or damaged.
        """
        from splatseed.io.photograph import read_photograph

        return read_photograph(
            self.path, self.white, composited=self.shows_empty_space, background=self.background
        )

    def read_mask(self, factor: float = 1) -> Bool[np.ndarray, "h w"] | None:
        """Read which pixels of the photograph count; None if all do.

        Args:
            factor: Divides width and height; a reduced pixel counts if all of its pixels do.

        Raises:
            SceneNotFoundError: The mask's file is missing.
            SceneFormatError: It is no image, has another aspect ratio, or masks every pixel.
        """
        from splatseed.io.masks import read_mask

        return read_mask(self.masks, self.name, self.path, factor)

    def read_empty(self, factor: float = 1) -> Bool[np.ndarray, "h w"] | None:
        """Read which pixels show empty space, by their transparency; None if none do.

        Args:
            factor: Divides width and height; a reduced pixel is empty if any of its pixels is.

        Raises:
            SceneNotFoundError: There is no such file.
            SceneFormatError: It is no image, or damaged.
        """
        from splatseed.io.masks import read_empty

        return read_empty(self.path, factor) if self.shows_empty_space else None

    def read_opacity(self, factor: float = 1) -> UInt8[np.ndarray, "h w"] | None:
        """Read the alpha of pixels, 255 if opaque; None if none show empty space.

        Args:
            factor: Divides width and height; a reduced pixel has the mean of its pixels.

        Raises:
            SceneNotFoundError: There is no such file.
            SceneFormatError: It is no image, or damaged.
        """
        from splatseed.io.masks import read_opacity

        return read_opacity(self.path, factor) if self.shows_empty_space else None

    @property
    def shows_empty_space(self) -> bool:
        """Whether transparent pixels, if there are any, count: as background, empty space."""
        return self.masks is None or not self.masks.alpha

    @cached_property
    def camera(self) -> Camera:
        """The posed pinhole camera (distortion left out), in pixels of the photograph."""
        lens = self.lens
        return Camera(lens.K, lens.width, lens.height, self.cam_from_world)

    def with_photograph(
        self, folder: Path | None, white: int, masks: Masks | None, background: Color
    ) -> Image:
        """Return the image with the folder, white value, masks and background of its scene."""
        known = (self.folder, self.white, self.masks, self.background)
        if known == (folder, white, masks, background):
            return self
        return dataclass_replace(
            self, folder=folder, white=white, masks=masks, background=background
        )


@dataclass(frozen=True)
class SceneSource:
    """Where a scene was read from; without any path, it was made in memory."""

    format: str = "memory"  # of its files: "colmap", "transforms", "phone", ...
    root: Path | None = None  # the scene's folder; of a bare PLY, the one it lies in
    points_path: Path | None = None  # of the points; of a capture without any, a file of the poses
    model_dir: Path | None = None  # COLMAP's, if there is one
    image_dir: Path | None = None  # that ``Image.name`` is relative to, if there is one
    transforms_path: Path | None = None  # if it was read
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # recorded beside its files
    named: Path | None = None  # what the user named, which may be one model or file of several
    convention: str = f"poses are cam_from_world, {OPENCV}"
    """Of the files' poses: completes "Write the poses so: ..."."""

    @property
    def again(self) -> Path | None:
        """Absolute path from which ``load_scene`` reads the same scene, if there is one."""
        path = self.named or self.root
        return path and path.resolve()

    @property
    def inputs(self) -> tuple[Path, ...]:
        """Input paths that outputs must not overlap.

        An image folder above the root is excluded, so outputs may be written beside it.
        """
        is_file = self.format == "ply"
        places = (self.points_path,) if is_file else (self.root, self.model_dir, self.image_dir)
        above = self.root.resolve().parents if self.root else ()
        return tuple(path for path in places if path and path.resolve() not in above)


@dataclass(frozen=True)
class Split:
    """Training and test images by a list in the scene."""

    train: frozenset[str]  # names of the images to train on
    test: frozenset[str]  # names of the images to test; an image may be in neither
    origin: str  # the list, in words

    def finding(self, *, given: bool) -> Finding:
        """Return a note on the split; ``given``: the user passed ``test_every``."""
        count = f"{len(self.train):,} training and {len(self.test):,} test images"
        text = f"The split is that of the scene's {self.origin}: {count}"
        return Finding("listed-split", text + ("; `test_every` is ignored." * given or "."), "info")


@dataclass(frozen=True)
class Masks:
    """Masks of photographs: pixels where an image's mask file is 0 are ignored."""

    files: Mapping[str, Path]  # by the image's name; an image without one is used whole
    inverted: bool = False  # whether pixels where the file is not 0 are masked instead
    alpha: bool = True  # whether transparent pixels are masked, too; else they are empty space
    choice: str | None = None  # what the user asked for, to be asked for again; None: the default


class LeftOut(NamedTuple):
    """Numbers of points in the files that a scene excludes."""

    non_finite: int = 0  # without three finite coordinates, or beyond 1e15
    duplicates: int = 0  # at exactly the position of an earlier one


@dataclass(frozen=True, eq=False)
class Scene:
    """A capture: points, and the images and cameras that saw them.

    Positions, of points and in poses, are those of the files minus ``origin``, which is 0 unless
    these lie so far from 0 that float32 does not resolve them.
    """

    points: PointCloud
    images: tuple[Image, ...] = ()  # in file order; none for a bare cloud
    intrinsics: tuple[Intrinsics, ...] = ()  # all camera records of the file, including unused ones
    tracks: Tracks | None = None  # of the first ``len(tracks)`` points, which are the originals
    source: SceneSource = SceneSource()  # where it was read from
    findings: tuple[Finding, ...] = ()  # what the reader repaired or found odd
    depths: DepthMaps | None = None  # of some images, read on demand
    listed: Split | None = None  # the split given by lists beside the scene
    left_out: LeftOut = field(default_factory=LeftOut)  # how many points of its files were
    masks: Masks | None = None  # which pixels of its photographs do not count; None: all count
    absent: tuple[
        str, ...
    ] = ()  # names of images left out; they keep their place in ``test_every``
    white: int = 65535  # the value of white in photographs of 16 bits a channel
    background: Color = BLACK  # of renders, over which transparent pixels are composited
    origin: Float64[np.ndarray, " 3"] = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        if self.depths is not None:
            names = [image.name for image in self.images]
            distorted = {im.name for im in self.images if im.intrinsics.has_distortion}
            object.__setattr__(self, "depths", maps_by_name(self.depths, names, distorted))
        if self.points.original_idx is not None:  # from here on, rows count in this cloud
            object.__setattr__(self, "points", self.points.replace(original_idx=None))
        of_scene = self.source.image_dir, self.white, self.masks, self.background
        images = tuple(image.with_photograph(*of_scene) for image in self.images)
        object.__setattr__(self, "images", images)

    def __repr__(self) -> str:
        root = self.source.root
        where = f"{root}, {self.source.format}" if root else "made in memory"
        added = len(self.points) - self.points.num_original
        lines = [
            f"Scene({where})",
            f"  images: {len(self.images):,}{_size_range(self.images)}",
            f"  points: {self.points.num_original:,} originals, {added:,} added",
            f"  tracks: {'none' if self.tracks is None else f'of {len(self.tracks):,} points'}",
            f"  depths: {'none' if self.depths is None else f'{len(self.depths):,} maps'}",
        ]
        return "\n".join(lines)

    def __getitem__(self, name: str) -> Image:
        """Return the image of a name, as in ``scene["DSC07956.JPG"]``.

        Raises:
            UnknownNameError: A ``KeyError``; the message lists similar names.
        """
        if name in self:
            return self._images_by_name[name]
        names = list(self._images_by_name)
        last = str(name).rpartition("/")[2].casefold()
        near = [each for each in names if each.rpartition("/")[2].casefold() == last]
        near += [each for each in get_close_matches(str(name), names) if each not in near]
        fix = f"Did you mean {' or '.join(map(repr, near[:3]))}?"
        raise UnknownNameError(
            f"the name of one of the scene's {len(names):,} images",
            found=repr(name),
            fix=fix if near else "scene.images lists them, each with its name.",
        )

    def __contains__(self, name: object) -> bool:
        """Whether an image has this name."""
        return isinstance(name, str) and name in self._images_by_name

    __iter__ = None  # or else Python would ask for images 0, 1, ... by ``__getitem__``

    @cached_property
    def _images_by_name(self) -> dict[str, Image]:
        return {image.name: image for image in self.images}

    def with_points(self, points: PointCloud) -> Scene:
        """Return a copy with other points; ``replace`` describes which tracks are kept."""
        return self.replace(points=points)

    def without(self, names: Iterable[str]) -> Scene:
        """Return a copy without the images of some names, which become ``absent``.

        Points stay; their tracks lose the observations there.

        Raises:
            UnknownNameError: There is no such image; the message lists similar names.
        """
        gone = {self[name].name: None for name in names}
        images = tuple(image for image in self.images if image.name not in gone)
        tracks = self.tracks and self.tracks.seen_by([image.image_id for image in images])
        return self.replace(images=images, tracks=tracks, absent=(*self.absent, *gone))

    def with_depths(self, depths: Any) -> Scene:
        """Return a copy with other depth maps.

        Args:
            depths: What ``stereo_depths`` returns, ``DepthMaps``, or a dict by image name of
                ``DepthMap`` or of arrays [H, W] of planar depth in scene units.
        """
        return self.replace(depths=depths)

    def replace(self, **changes: Any) -> Scene:
        """Return a copy with some fields replaced.

        When ``points`` are replaced and ``tracks`` are not, originals keep their tracks if they
        come first, in the scene's order and at the same positions, as ``upsample`` puts them.
        Features of other points then belong to none.
        """
        if "points" in changes and "tracks" not in changes and self.tracks is not None:
            kept = self._kept_originals(changes["points"])
            if not kept.all():
                gone = self.tracks.point_ids[~kept] if kept.any() else None
                changes["tracks"] = self.tracks.select(kept) if kept.any() else None
                changes.setdefault("images", tuple(_without(im, gone) for im in self.images))
        return dataclass_replace(self, **changes)

    def _kept_originals(self, points: PointCloud) -> Bool[np.ndarray, " N"]:
        """Mark the tracked points that another cloud has first and in order, else none."""
        kept = np.zeros(len(self.tracks or ()), bool)
        rows = points.rows_of_originals
        in_order = (np.diff(rows, prepend=-1) > 0) & (rows < len(kept))
        num = len(rows) if in_order.all() else int(in_order.argmin())  # up to the first that is not
        kept[rows[:num]] = True
        others = rows[num:][(rows[num:] >= 0) & (rows[num:] < len(kept))]
        # A row of another scene's cloud may have the same number, but seldom the same position.
        same = np.array_equal(points.xyz[:num], self.points.xyz[rows[:num]], equal_nan=True)
        return kept if same and kept[others].all() else np.zeros_like(kept)

    @property
    def offset(self) -> Float64[np.ndarray, " 3"]:
        """Offset from positions to the world: the origin plus the offset recorded in the files."""
        return np.asarray(self.origin + np.array(self.source.offset))

    @property
    def has_photographs(self) -> bool:
        """Whether at least one photograph exists."""
        return any(image.has_photograph for image in self.images)

    @property
    def default_test_every(self) -> int:
        """The ``test_every`` of ``train``: every 8th image tests, none of few."""
        return TEST_EVERY if self.num_viewpoints >= MIN_HELD_OUT else 0

    @property
    def num_viewpoints(self) -> int:
        """Number of images, where all faces of a panorama count as one."""
        return len({self._uncut[image.name] for image in self.images})

    @cached_property
    def _uncut(self) -> dict[str, str]:
        """By name, what each image, also an absent one, was cut from: a panorama, or itself.

        Neither refined poses nor left out faces may change this, as they must not change the split.
        """
        names = [*(image.name for image in self.images), *self.absent]
        found = {name: _FACE_NAME.fullmatch(name) for name in names}
        cut = {n: f"{m['folder'] or ''}{m['panorama']}" for n, m in found.items() if m}
        faces = (image.name for image in self.images if image.intrinsics.is_face)
        panoramas = {cut[name] for name in faces if name in cut}
        if panoramas:  # then others may be absent with all their faces
            panoramas |= {cut[name] for name in self.absent if name in cut}
        return {name: cut[name] if cut.get(name) in panoramas else name for name in names}

    def split(self, test_every: int = TEST_EVERY) -> tuple[tuple[Image, ...], tuple[Image, ...]]:
        """Return training and test images by name: as listed, else every ``test_every``-th tests.

        With 0, none tests. Images that are ``absent`` count, so that the other images stay in their
        part. Faces cut from one panorama count as one image, as they show margins of one another.

        Raises:
            ParameterError: ``test_every`` is no whole number of 2 or more, and not 0.
        """
        ordered = sorted(self.images, key=lambda image: image.name)
        if self.listed is not None:
            parts = (self.listed.train, self.listed.test)
            train, test = (tuple(i for i in ordered if i.name in part) for part in parts)
            return train, test
        if test_every == 0:
            return tuple(ordered), ()
        if not isinstance(test_every, (int, np.integer)) or test_every < 2:
            raise ParameterError(
                "test_every as a whole number of 2 or more, or 0",
                found=repr(test_every),
                fix="With 8, every 8th image is kept for testing, with 0 none.",
            )
        tested = {*sorted({*self._uncut.values()})[::test_every]}
        train = tuple(image for image in ordered if self._uncut[image.name] not in tested)
        return train, tuple(image for image in ordered if self._uncut[image.name] in tested)


def _size_range(images: Sequence[Image]) -> str:
    """Format the pixels of the smallest and the largest image; empty without images."""
    sizes = sorted({(im.lens.width, im.lens.height) for im in images}, key=math.prod)
    ends = dict.fromkeys([*sizes[:1], *sizes[-1:]])
    return f", {' to '.join(f'{width} x {height}' for width, height in ends)} px" if ends else ""


def _without(image: Image, point_ids: Int64[np.ndarray, " P"] | None) -> Image:
    if image.observations is None:
        return image
    return dataclass_replace(image, observations=image.observations.without(point_ids))
