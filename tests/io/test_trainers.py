"""What each trainer's loader demands of a scene folder, checked on what we write.

Each test does in a few lines what that loader does with the files, with the strictness it has; the
table of these rules is in docs/formats.md.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud


@pytest.fixture
def scene(scene_dir, rng):
    """A scene with gaps in its ids, upsampled, with a duplicate and a point at infinity."""
    scene = load_scene(scene_dir)
    xyz = np.concatenate([rng.normal(size=(30, 3)), scene.points.xyz[:1], [[np.inf, 0, 0]]])
    rgb = rng.integers(0, 256, xyz.shape).astype(np.uint8)
    new = PointCloud(xyz, rgb, np.full(len(xyz), 1, np.uint8))
    return scene.replace(points=PointCloud.concatenate(scene.points, new))


@pytest.fixture
def colmap_out(scene, tmp_path):
    return write_scene(scene, tmp_path / "colmap").path


@pytest.fixture
def nerfstudio_out(scene, tmp_path):
    return write_scene(scene, tmp_path / "nerfstudio", format="transforms").path


def ply_parts(path: Path):
    head, body = path.read_bytes().split(b"end_header\n", 1)
    return head.decode("ascii").splitlines(), body


def records(path: Path, head: str, tail):
    """The records of a COLMAP file, one by one; ``tail`` says how many bytes follow a head."""
    data, offset = path.read_bytes(), 8
    records_read = []
    for _ in range(struct.unpack_from("<Q", data)[0]):
        values = struct.unpack_from(head, data, offset)
        offset += struct.calcsize(head)
        size = tail(values, data, offset)
        records_read.append((values, data[offset : offset + size]))
        offset += size
    return records_read, len(data) - offset


def points_of(folder):
    return records(folder / "points3D.bin", "<Q3d3BdQ", lambda head, *_: 8 * head[-1])


def images_of(folder):
    def tail(_head, data, offset):
        name_end = data.index(b"\0", offset) + 1
        return name_end - offset + 8 + 24 * struct.unpack_from("<Q", data, name_end)[0]

    return records(folder / "images.bin", "<I7dI", tail)


def test_graphdeco_reads_a_ply_of_all_points_without_normals(colmap_out):
    _, body = ply_parts(colmap_out / "sparse/0/points3D.ply")
    rows = np.frombuffer(body, [("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
    assert not rows["normal"].any()
    heads = [head for head, _ in points_of(colmap_out / "sparse/0")[0]]
    np.testing.assert_array_equal(rows["xyz"], np.array([h[1:4] for h in heads], np.float32))
    np.testing.assert_array_equal(rows["rgb"], [h[4:7] for h in heads])
    assert np.isfinite(rows["xyz"]).all()
    assert len(np.unique(rows["xyz"], axis=0)) == len(rows) == 40


def test_graphdeco_depth_scales_index_an_array_by_point_id(colmap_out):
    ids = [head[0] for head, _ in points_of(colmap_out / "sparse/0")[0]]
    table = np.zeros((max(ids) + 1, 3))  # a gap of 2^40 would not fit in memory
    assert len(table) == len(ids) + 1
    for _, tail in images_of(colmap_out / "sparse/0")[0]:
        name_end = tail.index(b"\0") + 1
        features = np.frombuffer(tail[name_end + 8 :], [("xy", "<f8", 2), ("id", "<i8")])
        assert (features["id"] < len(table)).all()


def test_nerfstudio_finds_photographs_poses_and_cameras(nerfstudio_out):
    meta = json.loads((nerfstudio_out / "transforms.json").read_text())
    assert "property uchar red" in ply_parts(nerfstudio_out / meta["ply_file_path"])[0]
    for frame in meta["frames"]:
        assert np.shape(frame["transform_matrix"]) == (4, 4)
        assert (nerfstudio_out / frame["file_path"]).is_file()
        values = {**meta, **frame}
        assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"} <= set(values)


def test_each_finds_one_format_and_one_cloud(colmap_out, nerfstudio_out):
    """Brush loads any PLY in the root; OpenSplat takes one format; LichtFeld has its own name."""
    assert not (colmap_out / "transforms.json").exists()
    assert not (nerfstudio_out / "sparse").exists()
    assert [path.parent.name for path in colmap_out.rglob("*.ply")] == ["0"]
    names = {path.name: path.read_bytes() for path in nerfstudio_out.glob("*.ply")}
    assert names.keys() == {"sparse_pc.ply", "pointcloud.ply"}
    assert len(set(names.values())) == 1  # whichever it takes
    meta = json.loads((nerfstudio_out / "transforms.json").read_text())
    assert meta["camera_model"]  # OpenSplat throws without, even where frames have their own
    assert meta["ply_file_path"] in names


def test_opensplat_ply_has_contiguous_columns_and_nothing_else(colmap_out):
    lines, body = ply_parts(colmap_out / "sparse/0/points3D.ply")
    assert lines == [
        "ply",
        "format binary_little_endian 1.0",
        "element vertex 40",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
    ]
    assert len(body) == 40 * (6 * 4 + 3)


def test_lichtfeld_finds_no_trailing_bytes(colmap_out):
    folder = colmap_out / "sparse/0"
    assert points_of(folder)[1] == 0
    assert images_of(folder)[1] == 0
    num_params = {1: 4, 4: 8}
    cameras, rest = records(
        folder / "cameras.bin", "<IiQQ", lambda head, *_: 8 * num_params[head[1]]
    )
    assert (len(cameras), rest) == (2, 0)
