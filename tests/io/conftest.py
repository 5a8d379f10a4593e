"""Small COLMAP models for the tests of the formats."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.io import colmap
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Tracks


class Model(NamedTuple):
    intrinsics: tuple[Intrinsics, ...]
    images: tuple[Image, ...]
    points: PointCloud
    tracks: Tracks


@pytest.fixture
def model(rng) -> Model:
    """Four images that all see each of ten points; ids with gaps; ids and indices agree."""
    intrinsics = (
        Intrinsics(7, "PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
        Intrinsics(9, "OPENCV", 800, 600, (700.0, 700.0, 400.0, 300.0, 0.1, 0.01, 1e-3, 1e-4)),
    )
    image_ids, point_ids = np.array([2, 3, 5, 11]), 3 * np.arange(1, 11)
    slots = np.stack([rng.permutation(10) for _ in image_ids])  # feature of each point
    tracks = Tracks(
        point_ids=point_ids,
        xyz=rng.normal(size=(10, 3)),
        errors=rng.random(10),
        offsets=np.arange(11) * 4,
        image_ids=np.tile(image_ids, 10).astype(np.uint32),
        point2d_idx=slots.T.ravel().astype(np.uint32),
    )
    images = []
    for i, (image_id, slot) in enumerate(zip(image_ids.tolist(), slots, strict=True)):
        observed = np.full(12, -1)
        observed[slot] = point_ids
        quat = rng.normal(size=4)
        images.append(
            Image(
                name=f"left/image{i:03d}.jpg",
                image_id=image_id,
                intrinsics=intrinsics[i % 2],
                quat=quat / np.linalg.norm(quat),
                translation=rng.normal(size=3),
                observations=Observations(640 * rng.random((12, 2)), observed),
            )
        )
    points = PointCloud(tracks.xyz, rng.integers(0, 256, (10, 3)).astype(np.uint8))
    return Model(intrinsics, tuple(images), points, tracks)


@pytest.fixture
def scene_dir(tmp_path, model) -> Path:
    """The model as a scene folder with its photographs."""
    root = tmp_path / "scene"
    (root / "sparse" / "0").mkdir(parents=True)
    colmap.write_cameras(root / "sparse/0/cameras.bin", model.intrinsics)
    colmap.write_images(root / "sparse/0/images.bin", model.images)
    colmap.write_points3d(root / "sparse/0/points3D.bin", model.points, model.tracks)
    for image in model.images:
        path = root / "images" / image.name
        path.parent.mkdir(parents=True, exist_ok=True)
        size = (image.intrinsics.width, image.intrinsics.height)
        PilImage.new("RGB", size, "teal").save(path)
    return root


@pytest.fixture(scope="module")
def target(tmp_path_factory) -> Path:
    """A file for fuzzed bytes."""
    return tmp_path_factory.mktemp("fuzz") / "file"
