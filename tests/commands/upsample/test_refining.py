"""``splatseed upsample --refine-poses``: poses of a device, mended before points are made."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.camera import quat_from_rotation
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.synthetic import make_capture, write_capture

pytest.importorskip("pycolmap", reason="poses are refined by pycolmap")


def test_poses_are_refined_and_points_triangulated(tmp_path, splatseed):
    capture = make_capture(0, num_views=10, width=320, height=240)
    truth = load_scene(write_capture(capture, tmp_path / "room"))
    rng = np.random.default_rng(0)
    turned = tuple(
        dataclasses.replace(
            image,
            quat=quat_from_rotation(
                Rotation.from_rotvec(np.radians(rng.normal(0, 0.5, 3))).as_matrix()
                @ image.camera.cam_from_world[:3, :3]
            ),
        )
        for image in truth.images
    )
    bare = truth.replace(images=turned, points=PointCloud.empty(), tracks=None, depths=None)
    write_scene(bare, tmp_path / "bare", require_points=False)
    run = splatseed("upsample", tmp_path / "bare", "-o", tmp_path / "out", "--refine-poses")
    assert run.code == 0, run.err
    assert "note: Refined poses lower the mean reprojection error from" in run.out
    out = load_scene(tmp_path / "out")
    assert out.points.num_original > 100  # those that were triangulated
    assert len(out.points) > out.points.num_original
    assert _median_turn(out, truth) < 0.2 * _median_turn(bare, truth)


def _median_turn(scene, truth):
    """Degrees between the cameras' directions to each other, whatever the world's frame."""
    of = {image.name: image.camera.cam_from_world[:3, :3] for image in truth.images}
    pairs = [(image.camera.cam_from_world[:3, :3], of[image.name]) for image in scene.images]
    apart = [found @ true.T for found, true in pairs]
    relative = [Rotation.from_matrix(apart[0].T @ each).magnitude() for each in apart[1:]]
    return np.degrees(np.median(relative))


def test_without_photographs_it_is_one_line(tmp_path, splatseed):
    (tmp_path / "cloud.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n1 0 0\n0 1 0\n"
    )
    run = splatseed(
        "upsample", tmp_path / "cloud.ply", "--method", "linear", "--ratio", "2", "--refine-poses",
        "-o", tmp_path / "out",
    )  # fmt: skip
    assert run.code == 2
    assert "--refine-poses" in run.err
