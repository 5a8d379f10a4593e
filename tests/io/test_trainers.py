"""What we write passes what each trainer's loader demands, done as strictly (docs/trainers.md)."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.io import colmap, load_scene, write_scene
from splatseed.pointcloud import PointCloud

ROW = np.dtype([("xyz", "<f4", 3), ("normal", "<f4", 3), ("rgb", "u1", 3)])
HEAD = [
    *("ply", "format binary_little_endian 1.0", "element vertex 40"),
    *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")),
    *(f"property uchar {name}" for name in ("red", "green", "blue")),
]


@pytest.fixture
def outputs(scene_dir, rng, tmp_path):
    """A scene with gaps in its ids, upsampled, with a duplicate and a point at infinity."""
    scene = load_scene(scene_dir)
    xyz = np.concatenate([rng.normal(size=(30, 3)), scene.points.xyz[:1], [[np.inf, 0, 0]]])
    rgb = rng.integers(0, 256, xyz.shape).astype(np.uint8)
    new = PointCloud(xyz, rgb, np.full(len(xyz), 1, np.uint8))
    scene = scene.replace(points=PointCloud.concatenate(scene.points, new))
    return [
        write_scene(scene, tmp_path / form, format=form).path for form in ("colmap", "transforms")
    ]


def test_graphdeco_and_opensplat_read_a_ply_of_all_points_with_contiguous_ids(outputs):
    model = outputs[0] / "sparse/0"
    head, body = (model / "points3D.ply").read_bytes().split(b"end_header\n", 1)
    assert head.decode("ascii").splitlines() == HEAD  # columns in a row, and nothing else
    rows = np.frombuffer(body, ROW)
    points, tracks = colmap.read_points3d(model / "points3D.bin")
    assert not rows["normal"].any()
    np.testing.assert_array_equal(rows["xyz"], points.xyz)
    np.testing.assert_array_equal(rows["rgb"], points.rgb)
    assert np.isfinite(rows["xyz"]).all()
    assert len(np.unique(rows["xyz"], axis=0)) == len(rows) == 40
    assert tracks.point_ids.max() == 40  # a table of depth scales is as long as the largest id
    assert max(im.observations.point_ids.max() for im in load_scene(outputs[0]).images) <= 40


def test_each_finds_one_format_and_one_cloud(outputs):
    """Brush loads any PLY in the root; OpenSplat takes one format; LichtFeld has its own name."""
    colmap_out, nerfstudio_out = outputs
    assert not (colmap_out / "transforms.json").exists()
    assert not (nerfstudio_out / "sparse").exists()
    assert [path.parent.name for path in colmap_out.rglob("*.ply")] == ["0"]
    names = {path.name: path.read_bytes() for path in nerfstudio_out.glob("*.ply")}
    assert names.keys() == {"sparse_pc.ply", "pointcloud.ply"}
    assert len(set(names.values())) == 1  # whichever it takes
    meta = json.loads((nerfstudio_out / "transforms.json").read_text())
    assert meta["camera_model"]  # OpenSplat throws without, even where frames have their own
    assert meta["ply_file_path"] in names
    for frame in meta["frames"]:
        assert (nerfstudio_out / frame["file_path"]).is_file()
        assert {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "p1", "p2"} <= {*meta, *frame}
