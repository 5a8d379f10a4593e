"""Folders with a file per pose: projections, depth, and what is left out."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.errors import SceneFormatError, SceneNotFoundError

from .exports import SIZE, check_projections, kinds, load, made_cameras, write_photographs

FOUND = {"assumed-intrinsics"}


def pinhole(made, view, fx, fy, cx, cy):
    rays = made.rays(view)
    return rays[:, :2] / rays[:, 2:] * [fx, fy] + [cx, cy]


def write_poses(made, paths):
    for i, path in enumerate(paths):
        pose = np.eye(4)
        pose[:3] = np.column_stack([made.rotations[i].T, made.centers[i]])
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("".join("\t ".join(map(repr, row)) + "\t \n" for row in pose.tolist()))


def write_7scenes(root, made):
    stems = [f"frame-{i:06}" for i in range(4)]
    names = [f"{stem}.color.png" for stem in stems]
    write_photographs(root, names)
    write_poses(made, [root / f"{stem}.pose.txt" for stem in stems])
    for stem in stems:
        depth = np.full(SIZE[::-1], 65535, np.uint16)
        PilImage.fromarray(depth).save(root / f"{stem}.depth.png")
    return names


def test_7scenes(tmp_path):
    made, root = made_cameras(), tmp_path / "chess/seq-01"
    names = write_7scenes(root, made)
    read = load(root)
    assert (read.source.format, kinds(read), read.depths) == ("poses", FOUND, None)
    f = 525 * SIZE[0] / 640
    expected = [pinhole(made, i, f, f, SIZE[0] / 2, SIZE[1] / 2) for i in range(4)]
    check_projections(read, made, expected, names)
    camera = {"w": SIZE[0], "h": SIZE[1], "fx": 81.0, "fy": 82.0, "cx": 47.0, "cy": 36.5}
    (root.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    read = load(root)
    assert read.findings == ()
    expected = [pinhole(made, i, 81, 82, 47, 36.5) for i in range(4)]
    check_projections(read, made, expected, names)
    with pytest.raises(SceneNotFoundError, match=r"found scenes in it: seq-01"):
        load(root.parent)


def test_scannet(tmp_path):
    made = made_cameras()
    names = ["0.jpg", "20.jpg", "100.jpg", "2040.jpg"]
    write_photographs(tmp_path / "color", names)
    write_poses(made, [tmp_path / f"pose/{name[:-4]}.txt" for name in names])
    (tmp_path / "intrinsic").mkdir()
    K = "81 0 47.25 0\n0 82 35.5 0\n0 0 1 0\n0 0 0 1\n"
    (tmp_path / "intrinsic/intrinsic_color.txt").write_text(K)
    (tmp_path / "depth").mkdir()
    for i, name in enumerate(names):
        depth = np.full((SIZE[1] // 2, SIZE[0] // 2), 1000 + i, np.uint16)
        PilImage.fromarray(depth).save(tmp_path / f"depth/{name[:-4]}.png")
    read = load(tmp_path)
    assert (read.source.format, read.findings) == ("poses", ())
    order = sorted(range(4), key=lambda i: names[i])
    expected = [pinhole(made, i, 81, 82, 47.75, 36) for i in order]
    check_projections(read, made, expected, [names[i] for i in order])
    np.testing.assert_allclose(read.depths.read("2040.jpg").values, 1.003)


def test_what_is_left_out_is_stated(tmp_path):
    made = made_cameras()
    names = write_7scenes(tmp_path, made)
    lost = "\n".join(["-inf -inf -inf -inf"] * 4)
    (tmp_path / "frame-000001.pose.txt").write_text(lost)
    (tmp_path / "frame-000002.color.png").unlink()
    (tmp_path / "frame-000003.pose.txt").unlink()
    read = load(tmp_path)
    assert [image.name for image in read.images] == names[:1]
    assert {(each.kind, each.subjects) for each in read.findings} == {
        ("assumed-intrinsics", ()),
        ("missing-poses", (names[1], names[3])),
        ("missing-photographs", ("frame-000002",)),
    }
    (tmp_path / "frame-000000.pose.txt").write_text("1 0 0 0\n0 1 0 0")
    with pytest.raises(SceneFormatError, match=r"4 rows of 4 numbers in .*frame-000000"):
        load(tmp_path)
    for path in tmp_path.glob("*.color.png"):
        path.unlink()
    with pytest.raises(SceneNotFoundError, match=r"such as frame-000000\.color\.jpg"):
        load(tmp_path)
