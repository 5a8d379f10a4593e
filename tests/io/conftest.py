"""Small COLMAP models for the tests of the formats."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PilImage

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.io import colmap
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Observations, Tracks

U32 = st.integers(0, 2**32 - 1)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


class Model(NamedTuple):
    intrinsics: tuple[Intrinsics, ...]
    images: tuple[Image, ...]
    points: PointCloud
    tracks: Tracks


@st.composite
def _intrinsics(draw, camera_id):
    model = draw(st.sampled_from(list(CAMERA_MODELS.values())))
    params = draw(st.lists(FINITE, min_size=model.num_params, max_size=model.num_params))
    params[: model.num_focal] = [abs(each) or 1.0 for each in params[: model.num_focal]]
    sizes = st.integers(1, 2**31 - 1)
    return Intrinsics(camera_id, model.name, draw(sizes), draw(sizes), tuple(params))


@st.composite
def _image(draw, image_id, intrinsics):
    count = draw(st.integers(0, 4))
    quat = hnp.arrays(np.float64, 4, elements=st.floats(-1, 1))
    return Image(
        name=draw(st.text(st.characters(categories=("L", "N", "P", "S", "Zs")), min_size=1)).strip()
        or "image.jpg",
        image_id=image_id,
        intrinsics=draw(st.sampled_from(intrinsics)),
        quat=draw(quat.filter(lambda q: np.linalg.norm(q) > 1e-3)),
        translation=draw(hnp.arrays(np.float64, 3, elements=FINITE)),
        observations=Observations(
            draw(hnp.arrays(np.float64, (count, 2))),
            draw(hnp.arrays(np.int64, count, elements=st.integers(-1, 2**63 - 1))),
        ),
    )


@st.composite
def _tracks(draw):
    ids = draw(st.lists(st.integers(0, 2**63 - 1), max_size=6, unique=True))
    lengths = draw(hnp.arrays(np.int64, len(ids), elements=st.integers(0, 5)))
    total = int(lengths.sum())
    return Tracks(
        point_ids=np.array(ids, np.int64),
        xyz=draw(hnp.arrays(np.float64, (len(ids), 3))),
        errors=draw(hnp.arrays(np.float64, len(ids))),
        offsets=np.concatenate([[0], np.cumsum(lengths)]),
        image_ids=draw(hnp.arrays(np.uint32, total)),
        point2d_idx=draw(hnp.arrays(np.uint32, total)),
    )


@st.composite
def _models(draw):
    camera_ids = draw(st.lists(U32, min_size=1, max_size=3, unique=True))
    intrinsics = tuple(draw(_intrinsics(i)) for i in camera_ids)
    image_ids = draw(st.lists(U32, max_size=3, unique=True))
    images = tuple(draw(_image(i, intrinsics)) for i in image_ids)
    assume(len({image.name for image in images}) == len(images))
    tracks = draw(_tracks())
    with np.errstate(over="ignore"):
        xyz = tracks.xyz.astype(np.float32)
    return Model(intrinsics, images, PointCloud(xyz, draw(hnp.arrays(np.uint8, xyz.shape))), tracks)


@pytest.fixture(scope="session")
def models() -> st.SearchStrategy[Model]:
    """Any model that the formats can hold, also one whose ids refer to nothing."""
    return _models()


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
