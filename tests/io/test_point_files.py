"""Points that a scene has twice: which are read, and what is said of the others."""

from __future__ import annotations

import json
import os

import numpy as np
import pytest

from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud

from ..findings import texts


def notes_of(path):
    return [each for each in texts(load_scene(path)) if " are used; " in each]


@pytest.mark.parametrize("age", [-100, 100])
def test_a_ply_that_somebody_edited_is_named_and_so_is_the_way_to_use_it(scene_dir, model, age):
    folder = scene_dir / "sparse/0"
    path = folder / "points3D.ply"
    write_ply(path, model.points.select(np.arange(9, -1, -1)))
    assert not notes_of(scene_dir)  # in another order, rounded to float32
    write_ply(path, model.points.select(np.arange(7)))
    when = (folder / "points3D.bin").stat().st_mtime + age
    os.utime(path, (when, when))
    (note,) = notes_of(scene_dir)
    assert "10 points of points3D.bin are used; points3D.ply, which is " in note
    assert ("newer" if age > 0 else "older") in note
    assert "has 7, and graphdeco's trainer starts from it" in note
    assert f"move points3D.bin out of {folder}" in note
    (folder / "points3D.bin").rename(scene_dir / "points3D.bin")
    scene = load_scene(scene_dir)
    assert (len(scene.points), scene.tracks, len(scene.images)) == (7, None, 4)
    assert not notes_of(scene_dir)
    out = write_scene(scene, scene_dir.with_name("out")).path
    assert len(load_scene(out).points) == 7
    assert not notes_of(out)


def test_one_point_that_moved_is_enough(scene_dir, model):
    xyz = model.points.xyz.copy()
    xyz[3, 1] += 0.5
    write_ply(scene_dir / "sparse/0/points3D.ply", model.points.replace(xyz=xyz))
    (note,) = notes_of(scene_dir)
    assert "has 10 at other" in note


def test_text_and_binary_may_differ_too(scene_dir):
    folder = scene_dir / "sparse/0"
    (folder / "points3D.txt").write_text("# one point\n1 0 0 0 7 7 7 0.5\n")
    (note,) = notes_of(scene_dir)
    assert "points3D.txt has 1, and is not used" in note or "points3D.txt, which" in note
    write_ply(folder / "points3D.ply", PointCloud(np.eye(3), np.zeros((3, 3), np.uint8)))
    assert f"move points3D.bin and points3D.txt out of {folder}" in notes_of(scene_dir)[1]


def test_an_empty_file_gives_way_to_one_with_points(scene_dir, model):
    folder = scene_dir / "sparse/0"
    colmap.write_points3d(folder / "points3D.bin", PointCloud.empty(), None)
    write_ply(folder / "points3D.ply", model.points)
    scene = load_scene(scene_dir)
    assert (len(scene.points), scene.source.points_path.name) == (10, "points3D.ply")
    assert f"{folder / 'points3D.bin'} holds no points" in " ".join(texts(scene))


def test_plys_beside_transforms_json_and_init_ply(scene_dir, model):
    scene = load_scene(scene_dir)
    out = write_scene(scene, scene_dir.with_name("out"), format="transforms").path
    assert not notes_of(out)
    write_ply(out / "pointcloud.ply", model.points.select(np.arange(4)))
    write_ply(out / "init.ply", model.points.select(np.arange(5)))
    notes = notes_of(out)
    assert [each.split(" has ")[1][0] for each in notes] == ["4", "5"]
    assert "LichtFeld" in notes[0]
    assert "Brush" in notes[1]
    path = out / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "ply_file_path": "init.ply"}))
    assert len(load_scene(out).points) == 5
    write_ply(scene_dir / "init.ply", model.points.select(np.arange(5)))
    (note,) = notes_of(scene_dir)
    assert "init.ply has 5, and Brush starts from it" in note or "init.ply, which is" in note
