"""The sparse model of a COLMAP dense workspace: pinhole cameras in the photographs' own pixels.

Notation: COLMAP numbers images by their place in the model, here ascending by image id. Promise:
the points are the originals with their tracks; where there are no tracks, points from the maps
stand in, because COLMAP learns only from tracks which images overlap.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Camera, Intrinsics
from splatseed.io.cloud import clean_scene
from splatseed.io.colmap import binary as colmap_binary
from splatseed.io.colmap.ids import Renumbered, renumber
from splatseed.io.dense.maps import scaled_K
from splatseed.io.dense.overlap import OverlapPoints
from splatseed.lens import rays_through
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Scene

Size = tuple[int, int]
"""Width and height in pixels."""


@dataclass(frozen=True)
class SparseModel:
    """Cameras and images of a workspace.

    Args:
        scene: Where they come from.
        cameras: One PINHOLE record for each camera and size of photograph.
        images: Ascending by id; features in the photographs' pixels.
    """

    scene: Scene
    cameras: tuple[Intrinsics, ...]
    images: tuple[Image, ...]

    @property
    def by_name(self) -> dict[str, Image]:
        """The images by their names."""
        return {image.name: image for image in self.images}

    @property
    def image_idxs(self) -> dict[str, int]:
        """COLMAP's index of each image, by its name."""
        return {image.name: idx for idx, image in enumerate(self.images)}

    def write(self, folder: Path, overlap: OverlapPoints) -> None:
        """Write ``cameras.bin``, ``images.bin`` and ``points3D.bin``.

        Args:
            folder: Made here.
            overlap: Points of the maps, for a scene without tracks.

        Raises:
            OutputError: A value does not fit its field.
            OSError: A file cannot be written.
        """
        points, tracked = self._originals()
        if tracked.tracks is None or not len(tracked.tracks.image_ids):
            points, tracked = overlap.model(self.images)
        folder.mkdir()
        colmap_binary.write_cameras(folder / "cameras.bin", self.cameras)
        colmap_binary.write_images(folder / "images.bin", tracked.images)
        colmap_binary.write_points3d(folder / "points3D.bin", points, tracked.tracks)

    def _originals(self) -> tuple[PointCloud, Renumbered]:
        """The finite, distinct points with tracks; added points have none."""
        num_tracked = len(self.scene.tracks or ())
        points = self.scene.points.select(slice(0, num_tracked))
        scene = clean_scene(replace(self.scene, points=points, images=self.images))
        return scene.points, renumber(scene)


def photograph_model(scene: Scene, sizes: Mapping[str, Size]) -> SparseModel:
    """The cameras and images of a scene, in pixels of the photographs as they are on disk.

    A camera record may be larger than its photographs (a folder of reduced copies); COLMAP samples
    colours at the record's pixels, so the two must agree.

    Args:
        scene: The scene; a camera with distortion becomes the pinhole camera of its undistorted
            photographs.
        sizes: Width and height of each photograph, by name.
    """
    cameras: dict[tuple[int, Size], Intrinsics] = {}
    images = []
    for image in sorted(scene.images, key=lambda image: image.image_id):
        size = sizes[image.name]
        key = (image.intrinsics.camera_id, size)
        record = cameras.setdefault(key, _pinhole(len(cameras) + 1, image.camera, size))
        images.append(_in_pixels_of(image, record))
    return SparseModel(scene, tuple(cameras.values()), tuple(images))


def _pinhole(camera_id: int, camera: Camera, size: Size) -> Intrinsics:
    K = scaled_K(camera, *size)
    params = (float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
    return Intrinsics(camera_id, "PINHOLE", *size, params)


def _in_pixels_of(image: Image, record: Intrinsics) -> Image:
    old, seen = image.intrinsics, image.observations
    if seen is not None:
        if old.has_distortion:
            seen = Observations(_straightened(old, seen.xy), seen.point_ids)
        scale = np.array([record.width / old.width, record.height / old.height])
        seen = Observations(seen.xy * scale, seen.point_ids)
    return replace(image, intrinsics=record, observations=seen)


def _straightened(lens: Intrinsics, uv: Float64[np.ndarray, "M 2"]) -> Float64[np.ndarray, "M 2"]:
    """The features of a lens in the undistorted photograph.

    A feature that no ray of the lens reaches stays where it is.
    """
    straight = rays_through(lens, uv) * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2]
    return np.where(np.isnan(straight), uv, straight)
