"""Small COLMAP models and clouds for the tests of the formats."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.io import colmap
from splatseed.io.load import with_own_depths
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene
from splatseed.tracks import Observations, Tracks


class Model(NamedTuple):
    intrinsics: tuple[Intrinsics, ...]
    images: tuple[Image, ...]
    points: PointCloud
    tracks: Tracks


@pytest.fixture(scope="session")
def room_with_depth(room) -> Scene:
    """The made room with its true depth."""
    return with_own_depths(room)


@pytest.fixture
def captures(tmp_path, monkeypatch) -> Path:
    """An empty cache of extracted photographs."""
    folder = tmp_path / "captures"
    monkeypatch.setattr("splatseed.io.recordings._base", lambda: folder)
    return folder


@pytest.fixture
def model(rng) -> Model:
    """Four images that all see each of ten points; ids with gaps; ids and indices agree."""
    intrinsics = (
        Intrinsics(7, "PINHOLE", 640, 480, (500.0, 510.0, 320.0, 240.0)),
        Intrinsics(9, "OPENCV", 800, 600, (700.0, 700.0, 400.0, 300.0, 0.1, 0.01, 1e-3, 1e-4)),
    )
    image_ids, point_ids = np.array([2, 3, 5, 2**32 - 2]), 3 * np.arange(1, 11)
    point_ids[-1] = 2**62
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
        name, lens = f"left/image{i:03d}.jpg", intrinsics[i % 2]
        ids = np.full(12, -1)
        ids[slot] = point_ids
        seen = Observations(640 * rng.random((12, 2)), ids)
        quat, translation = rng.normal(size=4), rng.normal(size=3)
        quat /= np.linalg.norm(quat)
        images.append(Image(name, image_id, lens, quat, translation, seen))
    points = PointCloud(tracks.xyz, rng.integers(0, 256, (10, 3)).astype(np.uint8))
    return Model(intrinsics, tuple(images), points, tracks)


def written(folder: Path, model: Model) -> Path:
    """The folder, with the model's files in binary."""
    colmap.write_cameras(folder / "cameras.bin", model.intrinsics)
    colmap.write_images(folder / "images.bin", model.images)
    colmap.write_points3d(folder / "points3D.bin", model.points, model.tracks)
    return folder


@pytest.fixture
def scene_dir(tmp_path, model) -> Path:
    """The model as a scene folder with its photographs."""
    root = tmp_path / "scene"
    (root / "sparse" / "0").mkdir(parents=True)
    written(root / "sparse/0", model)
    (root / "images/left").mkdir(parents=True)
    for image in model.images:
        size = (image.intrinsics.width, image.intrinsics.height)
        PilImage.new("RGB", size, "teal").save(root / "images" / image.name)
    return root


@pytest.fixture(scope="module")
def target(tmp_path_factory) -> Path:
    """A file for fuzzed bytes."""
    return tmp_path_factory.mktemp("fuzz") / "file"


class CloudFiles(NamedTuple):
    folder: Path
    xyz: np.ndarray  # [60, 3], of 3 decimals
    rgb: np.ndarray


TABLES = (
    *("cloud.ply", "text.ply", "a.glb", "map.npz", "packed.npz", "a.pcd", "text.pcd"),
    *("packed.pcd", "a.xyz", "a.csv", "a.pts"),
)
CLOUDS = ("a.las", "a.laz", "new.laz", "a.e57", *TABLES)
PCD = "FIELDS x y z rgb\nSIZE 4 4 4 4\nTYPE F F F U\nCOUNT 1 1 1 1\nWIDTH 60\nHEIGHT 1\nDATA "


@pytest.fixture(scope="session")
def cloud_files(tmp_path_factory) -> CloudFiles:
    """One cloud in every format, mostly by other packages."""
    pye57, trimesh = pytest.importorskip("pye57"), pytest.importorskip("trimesh")
    laspy = pytest.importorskip("laspy")
    folder, rng = tmp_path_factory.mktemp("clouds"), np.random.default_rng(0)
    xyz, rgb = rng.normal(size=(60, 3)).round(3), rng.integers(0, 256, (60, 3)).astype(np.uint8)
    for name, kind, version in (("a.las", 3, "1.2"), ("a.laz", 3, "1.2"), ("new.laz", 7, "1.4")):
        las = laspy.LasData(laspy.LasHeader(point_format=kind, version=version))
        las.x, las.y, las.z = xyz.T
        las.write(folder / name)
    file = pye57.E57(str(folder / "a.e57"), mode="w")
    file.write_scan_raw({f"cartesian{axis}": xyz[:, i].copy() for i, axis in enumerate("XYZ")})
    file.close()
    cloud = trimesh.PointCloud(xyz, colors=rgb)
    cloud.export(folder / "cloud.ply")
    cloud.export(folder / "text.ply", encoding="ascii")
    cloud.export(folder / "a.glb")
    np.savez(folder / "map.npz", xyz=xyz, rgb=rgb)
    maps = {"pts3d": np.asfortranarray(xyz.reshape(6, 10, 3)), "conf": np.full((6, 10), 3.0)}
    np.savez_compressed(folder / "packed.npz", **maps, rgb=rgb.reshape(6, 10, 3))
    rows = np.zeros(60, [("xyz", "<f4", 3), ("rgb", "<u4")])
    rows["xyz"], rows["rgb"] = xyz, rgb @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    (folder / "a.pcd").write_bytes(f"{PCD}binary\n".encode() + rows.tobytes())
    lines = "\n".join(f"{p[0]:.3f} {p[1]:.3f} {p[2]:.3f} {c}" for p, c in rows.tolist())
    (folder / "text.pcd").write_text(f"{PCD}ascii\n{lines}\n")
    columns = np.ascontiguousarray(rows["xyz"].T).tobytes() + rows["rgb"].tobytes()
    runs = (columns[at : at + 32] for at in range(0, len(columns), 32))
    packed = b"".join(bytes([len(run) - 1]) + run for run in runs)  # LZF of literal runs
    body = struct.pack("<II", len(packed), len(columns)) + packed
    (folder / "packed.pcd").write_bytes(f"{PCD}binary_compressed\n".encode() + body)
    table, kinds = np.hstack([xyz, rgb]), ["%.3f"] * 3 + ["%d"] * 3
    np.savetxt(folder / "a.xyz", table, kinds)
    np.savetxt(folder / "a.csv", table, kinds, ",", header="X,Y,Z,R,G,B", comments="")
    with_intensity = np.insert(table, 3, -900, axis=1)
    np.savetxt(folder / "a.pts", with_intensity, [*kinds, "%d"], header="60", comments="")
    return CloudFiles(folder, xyz, rgb)
