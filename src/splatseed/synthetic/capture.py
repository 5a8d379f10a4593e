"""make_capture: photographs, depth and points of the demo, determined by a seed.

Notation: V views of H x W pixels; depth is planar z in metres, 0 where nothing was hit. The scene
has all parts of a COLMAP model (poses, features, tracks, reprojection errors) and known surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Float64, UInt8
from PIL import Image as PillowImage

from splatseed.camera import Camera, Intrinsics, quat_from_rotation
from splatseed.errors import ParameterError
from splatseed.io import write_scene
from splatseed.io.depth_maps import write_description
from splatseed.io.files import StrPath
from splatseed.io.staging import output_folder
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.synthetic.room import (
    TEXTURELESS,
    Room,
    build_room,
    orbit_cameras,
    render_views,
    visible,
)
from splatseed.synthetic.surfaces import Union
from splatseed.synthetic.tracks import TrackedPoints, track_points
from splatseed.tracks import Observations, Tracks

DEPTH_SCALE = 5000
"""Depth PNGs hold metres times this, rounded to 16 bits (as TUM's); 0 = no depth."""


@dataclass(frozen=True, eq=False)
class Capture:
    """A synthetic capture and its ground truth."""

    scene: Scene  # with features and tracks; ``source`` is None
    images: UInt8[np.ndarray, "V H W 3"]  # sRGB
    depths: Float32[np.ndarray, "V H W"]  # planar z in metres; 0 = no hit
    room: Room
    outliers: Bool[np.ndarray, " N"]  # points of wrong matches

    @property
    def surfaces(self) -> Union:
        """The union of all surfaces; ``surfaces.distance(xyz)`` is exact, [N, 3] to [N]."""
        return self.room.surfaces

    def sample_visible(self, num: int, rng: np.random.Generator) -> Float64[np.ndarray, "num 3"]:
        """Sample points uniformly by area on the visible parts of the surfaces, [num, 3].

        Coverage is measured on these, since no method can know hidden surfaces. The textureless
        wall is excluded: it has no points to upsample, so it would dominate the score in favour of
        methods that scatter points at random.
        """
        surfaces = self.room.without(TEXTURELESS)
        batches: list[np.ndarray] = []
        while sum(len(batch) for batch in batches) < num:
            xyz = surfaces.sample(num, rng)
            batches.append(xyz[self._seen_by_any(xyz)])
        # Shuffle: Union samples part by part, and callers may use the first few points.
        return np.asarray(rng.permutation(np.concatenate(batches))[:num])

    def _seen_by_any(self, xyz: Float64[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
        seen = np.zeros(len(xyz), bool)
        for image in self.scene.images:
            rest = np.flatnonzero(~seen)
            seen[rest] = visible(self.surfaces, image.camera, xyz[rest])
        return seen


def make_capture(
    seed: int = 0, num_views: int = 40, width: int = 400, height: int = 300
) -> Capture:
    """Build the demo room, render photographs of it, and simulate Structure-from-Motion points.

    ``seed`` determines the leaves and the points' noise. Raises ParameterError for fewer than 3
    views or 32 x 32 pixels.
    """
    if num_views < 3 or min(width, height) < 32:
        raise ParameterError(
            "`num_views` of 3 or more and a size of 32 x 32 pixels or more",
            found=f"{num_views} of {width} x {height}",
            fix="Pass larger values.",
        )
    rng = np.random.default_rng(seed)
    return photograph_room(build_room(rng), orbit_cameras(num_views, width, height), rng)


def photograph_room(room: Room, cameras: Sequence[Camera], rng: np.random.Generator) -> Capture:
    """Render photographs of a room, and simulate Structure-from-Motion points with ``rng``.

    The cameras share their intrinsics.
    """
    images, depths = render_views(room, cameras)
    tracked = track_points(room.surfaces, cameras, images, depths, rng)
    return Capture(_scene(cameras, images, tracked), images, depths, room, tracked.outliers)


def write_capture(capture: Capture, path: StrPath, *, overwrite: bool = False) -> Path:
    """Write a COLMAP scene (``images/*.png``, ``sparse/0``) and depth maps (``depths/*.png``).

    Depth PNGs have 16 bits and hold metres times ``DEPTH_SCALE`` (recorded in
    ``depths/depths.json``), 0 for no depth. Returns the folder. Raises OutputError if it exists or
    cannot be written.
    """
    with output_folder(Path(path), kind="capture", overwrite=overwrite) as partial:
        write_scene(capture.scene, partial / "scene")
        for child in (partial / "scene").iterdir():
            child.rename(partial / child.name)
        (partial / "scene").rmdir()
        scaled = np.round(capture.depths * DEPTH_SCALE).clip(0, 65535).astype(np.uint16)
        for folder, arrays in (("images", capture.images), ("depths", scaled)):
            (partial / folder).mkdir()
            for image, array in zip(capture.scene.images, arrays, strict=True):
                PillowImage.fromarray(array).save(partial / folder / image.name)
        write_description(partial / "depths", "z", DEPTH_SCALE)
    return Path(path)


def _scene(
    cameras: Sequence[Camera], images: UInt8[np.ndarray, "V H W 3"], tracked: TrackedPoints
) -> Scene:
    """Make the scene; point i has id i + 1, view v has id v + 1."""
    K, images_of_scene = cameras[0].K, []
    params = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    intrinsics = Intrinsics(1, "PINHOLE", cameras[0].width, cameras[0].height, params)
    for view, camera in enumerate(cameras):
        mine, pose = tracked.view_idx == view, camera.cam_from_world
        seen = Observations(tracked.uv[mine], tracked.point_idx[mine] + 1)
        turn, name = quat_from_rotation(pose[:3, :3]), f"view_{view:03d}.png"
        images_of_scene.append(Image(name, view + 1, intrinsics, turn, pose[:3, 3], seen))
    points = PointCloud(tracked.xyz.astype(np.float32), _point_colors(images, tracked))
    return Scene(points, tuple(images_of_scene), (intrinsics,), _tracks(tracked))


def _tracks(tracked: TrackedPoints) -> Tracks:
    """Make tracks; features are numbered per image in the order of its observations."""
    by_view = np.argsort(tracked.view_idx, kind="stable")
    counts = np.bincount(tracked.view_idx)
    first = np.repeat(np.cumsum(counts) - counts, counts)
    point2d_idx = np.empty(len(by_view), np.uint32)
    point2d_idx[by_view] = np.arange(len(by_view)) - first
    num = len(tracked.xyz)
    return Tracks(
        point_ids=np.arange(1, num + 1),
        xyz=tracked.xyz,
        errors=tracked.errors,
        offsets=np.searchsorted(tracked.point_idx, np.arange(num + 1)),
        image_ids=(tracked.view_idx + 1).astype(np.uint32),
        point2d_idx=point2d_idx,
    )


def _point_colors(
    images: UInt8[np.ndarray, "V H W 3"], tracked: TrackedPoints
) -> UInt8[np.ndarray, "N 3"]:
    """Return each point's mean colour over its observations."""
    limits = np.array(images.shape[2:0:-1]) - 1
    column, row = np.clip(np.floor(tracked.uv), 0, limits).astype(np.int64).T
    pixels = images[tracked.view_idx, row, column].astype(np.float64)
    starts = np.searchsorted(tracked.point_idx, np.arange(len(tracked.xyz)))
    sums = np.add.reduceat(pixels, starts)
    counts = np.bincount(tracked.point_idx, minlength=len(tracked.xyz))
    return np.round(sums / counts[:, None]).astype(np.uint8)
