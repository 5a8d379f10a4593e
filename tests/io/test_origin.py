"""Scenes far from 0: whatever their offset, they are worked on, and written, around their own."""

from __future__ import annotations

import json

import numpy as np
import pytest

from splatseed.errors import SceneFormatError
from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.origin import (
    RECENTER,
    choose_origin,
    find_shift,
    offset_beside,
    translated,
    write_offset,
)
from splatseed.io.ply import read_ply_float64

from ..findings import texts

UTM, ECEF = (218248.62, 1925986.38, 179.47), (-1288000.5, -4720500.25, 4079400.75)
GRIDS = {"utm": UTM, "ecef": ECEF, "high": (0.0, 0.0, 3e6)}


def write_far(scene, offset, folder):
    """The scene elsewhere, in COLMAP's double precision."""
    write_scene(scene, folder)
    far, model = translated(scene, -np.array(offset)), folder / "sparse" / "0"
    colmap.write_images(model / "images.bin", far.images)
    colmap.write_points3d(model / "points3D.bin", far.points, far.tracks)
    (model / "points3D.ply").unlink()
    (folder / RECENTER).unlink(missing_ok=True)


def double_ply(path, xyz):
    kinds = "".join(f"property double {axis}\n" for axis in "xyz")
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n{kinds}end_header\n"
    path.write_bytes(head.encode() + np.ascontiguousarray(xyz, "<f8").tobytes())
    return path


def centers_of(scene):
    return np.array([image.camera.center for image in scene.images])


@pytest.mark.parametrize("layout", ["colmap", "transforms"])
@pytest.mark.parametrize("grid", GRIDS)
def test_a_scene_far_from_0_is_read_and_written_around_its_own_origin(room, tmp_path, grid, layout):
    plain = room
    if layout == "transforms":  # whose world is turned
        write_scene(room, tmp_path / "plain", format=layout)
        plain = load_scene(tmp_path / "plain")
        content = json.loads((tmp_path / "plain" / "transforms.json").read_text())
        for frame in content["frames"]:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] += GRIDS[grid]
            frame["transform_matrix"] = matrix.tolist()
        (tmp_path / "far").mkdir()
        (tmp_path / "far" / "transforms.json").write_text(json.dumps(content))
        double_ply(tmp_path / "far" / "sparse_pc.ply", plain.points.xyz + np.array(GRIDS[grid]))
    else:
        write_far(room, GRIDS[grid], tmp_path / "far")
    scene = load_scene(tmp_path / "far")
    assert len(scene.points) == len(plain.points)  # none falls on another
    assert sum(RECENTER in note for note in texts(scene)) == 1
    assert np.abs(scene.points.xyz).max() < 30
    report = write_scene(scene, tmp_path / "out")
    assert RECENTER in report.files
    again = load_scene(tmp_path / "out")
    assert not again.origin.any()
    assert not [note for note in texts(again) if RECENTER in note]
    for read in (scene, again):
        places = centers_of(read) + read.offset - GRIDS[grid]
        np.testing.assert_allclose(places, centers_of(plain), atol=1e-7)
        xyz = read.points.xyz + read.offset - GRIDS[grid]
        np.testing.assert_allclose(xyz, plain.points.xyz, atol=5e-6)
    # Written once more, nothing changes.
    write_scene(again, tmp_path / "twice")
    assert offset_beside(tmp_path / "twice").tolist() == again.offset.tolist()
    np.testing.assert_array_equal(centers_of(load_scene(tmp_path / "twice")), centers_of(again))


def test_what_becomes_of_the_world_is_turned_with_another_layout(room, tmp_path):
    write_far(room, UTM, tmp_path / "far")
    write_scene(load_scene(tmp_path / "far"), tmp_path / "out", format="transforms")
    turned, plain = load_scene(tmp_path / "out"), tmp_path / "plain"
    write_scene(room, plain, format="transforms")
    applied = np.array(json.loads((plain / "transforms.json").read_text())["applied_transform"])
    places = centers_of(turned) + turned.offset - applied[:, :3] @ UTM
    np.testing.assert_allclose(places, centers_of(load_scene(plain)), atol=1e-7)


def test_ordinary_scenes_are_not_moved(room, rng):
    assert not room.origin.any()
    assert not room.offset.any()
    orbit = rng.normal(size=(40, 3))
    for places in (orbit, 1e4 * orbit, 1e-4 * orbit, orbit + 50, 1e6 * orbit + 1e7, orbit[:1] + 60):
        assert not choose_origin(places, in_order=True).any()
    clip = np.arange(40)[:, None] * [2.0, 0, 0] + [1500.0, 800, 0]  # a drive in a map's frame
    assert not choose_origin(clip, in_order=True).any()


def test_cameras_in_one_place_but_for_rounding_are_not_moved(rng):
    for far in (1.2, 1500.0):
        places = far * (1 + rng.integers(-2, 3, (6, 3)) * 2.0**-52)
        assert not choose_origin(places, in_order=True).any()
    assert choose_origin(places + UTM).any()


def test_few_cameras_elsewhere_do_not_choose_the_origin(rng):
    for scale in (1.0, 1e-3, 1e3):  # of the unit of length
        walk = scale * (np.arange(40)[:, None] * [0.1, 0, 0] + np.array(UTM))
        origin = choose_origin(walk, in_order=True)
        assert np.abs(np.median(walk, axis=0) - origin).max() <= 5 * scale
        walk[::3] = 0.0
        walk[4] = np.nan
        walk[5] = 1e30
        found = choose_origin(walk, in_order=True)
        assert np.abs(np.median(walk[np.isfinite(walk).all(1)], axis=0) - found).max() <= 5 * scale


def test_a_long_walk_is_moved_though_it_is_as_long_as_it_is_far():
    rails = np.arange(2000)[:, None] * [5.0, 0, 0] + [2e5, 1e5, 0]  # 10 km
    assert choose_origin(rails, in_order=True).any()
    assert not choose_origin(rails * [1, 0, 0] + [0, 0, 0.0], in_order=False).any()


def test_a_bare_cloud_is_moved_by_its_points(room, tmp_path):
    xyz = room.points.xyz + np.array(ECEF)
    exact = load_scene(double_ply(tmp_path / "points.ply", xyz))
    assert len(exact.points) == len(xyz)
    np.testing.assert_allclose(exact.points.xyz + exact.offset, xyz, atol=1e-6)
    write_scene(exact, tmp_path / "out")
    points = tmp_path / "out" / "sparse" / "0" / "points3D.ply"
    np.testing.assert_array_equal(read_ply_float64(points)[0].xyz, exact.points.xyz)
    rounded = load_scene(double_ply(tmp_path / "single.ply", xyz.astype(np.float32)))
    assert any("single precision" in note for note in texts(rounded))
    assert not any("single precision" in note for note in texts(exact))


def test_points_in_another_frame_than_the_poses_are_noted(room, tmp_path):
    write_scene(room, tmp_path / "mixed")
    model = tmp_path / "mixed" / "sparse" / "0"
    (model / "points3D.bin").unlink()
    double_ply(model / "points3D.ply", room.points.xyz + np.array(UTM))
    notes = " ".join(texts(load_scene(tmp_path / "mixed")))
    assert "in different frames" in notes
    assert RECENTER not in notes


def test_positions_from_elsewhere_are_recognised(room, tmp_path):
    write_far(room, UTM, tmp_path / "far")
    scene, xyz = load_scene(tmp_path / "far"), room.points.xyz.astype(np.float64)
    write_scene(scene, tmp_path / "out")
    around, local = load_scene(tmp_path / "out"), xyz + UTM - scene.offset
    for each in (scene, around):
        np.testing.assert_allclose(xyz + UTM + find_shift(each, xyz + UTM), local, atol=1e-6)
        assert not find_shift(each, local, unrecorded=True).any()
        assert not find_shift(each, local, scene.offset).any()
        other = np.array([218000.0, 1926000.0, 0])
        shift = find_shift(each, xyz + UTM - other, other)
        np.testing.assert_allclose(xyz + UTM - other + shift, local, atol=1e-6)
        # A wrong record: it is where the cameras are as it is.
        assert not find_shift(each, local, np.array([9e6, 0, 0]), unrecorded=True).any()
    assert not find_shift(room, xyz + UTM).any()


def test_a_file_beside_that_holds_no_offset_is_an_error(tmp_path):
    write_offset(tmp_path / "a.ply", np.array([1.0, 2, 3]))
    assert offset_beside(tmp_path / "a.ply").tolist() == [1, 2, 3]
    assert offset_beside(tmp_path / "b.ply") is None
    write_offset(tmp_path / "a.ply", np.zeros(3))  # another model of that name
    assert offset_beside(tmp_path / "a.ply") is None
    for text in ('{"offset": [1, 2]}', '{"offset": ["x", 1, 2]}', "[]", '{"offset": [1, 2, NaN]}'):
        (tmp_path / RECENTER).write_text(text)
        with pytest.raises(SceneFormatError, match="three numbers as offset"):
            offset_beside(tmp_path)
