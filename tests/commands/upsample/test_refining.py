"""``splatseed upsample --refine-poses``: poses of a device, mended before points are made."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed.io import load_scene

pytest.importorskip("pycolmap", reason="poses are refined by pycolmap")


def test_poses_are_refined_and_points_triangulated(sharp_room, sharp_bare, tmp_path, splatseed):
    run = splatseed("upsample", sharp_bare, "-o", tmp_path / "out", "--refine-poses")
    assert run.code == 0, run.err
    assert "note: Refined poses lower the mean reprojection error from" in run.out
    out = load_scene(tmp_path / "out")
    assert out.points.num_original > 100  # those that were triangulated
    assert len(out.points) > out.points.num_original
    bare = load_scene(sharp_bare, require_points=False)
    assert _median_turn(out, sharp_room) < 0.2 * _median_turn(bare, sharp_room)


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
