"""Drawn points must be where, in front of and as many as they should be."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PillowImage

from splatseed.camera import Camera, Intrinsics
from splatseed.errors import OutputError, PointCloudError
from splatseed.io import load_scene
from splatseed.pointcloud import PointCloud
from splatseed.preview import preview_errors, preview_methods, preview_pair, render_points
from splatseed.scene import Image, Scene, SceneSource

K = np.array([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]])
CAMERA = Camera(K, 40, 30, np.eye(4))
RED, GREEN, WHITE = [255, 0, 0], [0, 255, 0], [255, 255, 255]


def _cloud(xyz, rgb):
    return PointCloud(np.array(xyz, float).reshape(-1, 3), np.array(rgb, np.uint8).reshape(-1, 3))


def _at(column, row, depth):
    """The world point in the middle of a pixel."""
    return CAMERA.unproject(np.array([[column + 0.5, row + 0.5]]), np.array([depth]))[0]


def test_a_point_in_the_middle_of_a_pixel_colours_that_pixel_alone():
    picture = render_points(_cloud(_at(7, 22, 3.0), RED), CAMERA, point_size=1)
    assert picture.shape == (30, 40, 3)
    assert picture[22, 7].tolist() == RED
    assert (picture != 255).any(axis=2).sum() == 1


@pytest.mark.parametrize("swap", [False, True])
def test_the_nearer_point_hides_the_farther(swap):
    xyz, rgb = [_at(20, 15, 5.0), _at(20, 15, 2.0)], [RED, GREEN]
    cloud = _cloud(xyz[::-1] if swap else xyz, rgb[::-1] if swap else rgb)
    picture = render_points(cloud, CAMERA, point_size=2)
    assert picture[15, 20].tolist() == GREEN


def test_a_near_disc_covers_a_far_point_beside_its_centre():
    cloud = _cloud([_at(20, 15, 2.0), _at(22, 15, 9.0)], [GREEN, RED])
    picture = render_points(cloud, CAMERA, point_size=8)
    assert picture[15, 22].tolist() == GREEN


def test_points_behind_beside_and_nowhere_are_left_out():
    xyz = [[0, 0, -2.0], [0, 0, 0], [900.0, 0, 1], [np.nan, 0, 2], [0, np.inf, 2], [0, -1e30, 1]]
    picture = render_points(_cloud(xyz, [RED] * 6), CAMERA, point_size=3)
    assert (picture == 255).all()


def test_an_empty_cloud_gives_the_background():
    picture = render_points(_cloud([], []), CAMERA, background=(9, 8, 7))
    assert (picture == [9, 8, 7]).all()


def test_each_point_shows_however_small_its_disc():
    cloud = _cloud([_at(5, 5, 2.0)], [RED])
    assert (render_points(cloud, CAMERA, point_size=0.01) != 255).any()


def test_denser_clouds_cover_more_and_nothing_is_drawn_twice_the_size(rng):
    uv, depth = rng.uniform([0, 0], [40, 30], (400, 2)), np.full(400, 3.0)
    xyz = CAMERA.unproject(uv, depth)
    ink = [
        (render_points(_cloud(xyz[:n], [RED] * n), CAMERA, point_size=1) != 255).any(axis=2).mean()
        for n in (50, 400)
    ]
    assert ink[1] > 3 * ink[0]


def test_near_points_are_larger_up_to_a_limit():
    def ink(depth):
        others = [_at(2, 2, 4.0), _at(37, 2, 4.0), _at(2, 27, 4.0)]
        cloud = _cloud([*others, _at(20, 15, depth)], [RED] * 3 + [GREEN])
        picture = render_points(cloud, CAMERA, point_size=4).astype(int)
        return (picture[..., 0] < 128).sum()

    assert ink(4.0) < ink(2.5) < ink(1.0) == ink(0.3)


def test_scale_changes_the_size_and_keeps_the_place():
    picture = render_points(_cloud(_at(10, 20, 2.0), RED), CAMERA, point_size=2, scale=2.5)
    assert picture.shape == (75, 100, 3)
    row, column = np.argwhere((picture != 255).any(axis=2)).mean(axis=0) + 0.5
    assert row == pytest.approx(20.5 * 2.5, abs=0.5)
    assert column == pytest.approx(10.5 * 2.5, abs=0.5)


def test_drawing_matches_a_loop_over_points(rng):
    xyz = CAMERA.unproject(rng.uniform([-2, -2], [42, 32], (200, 2)), rng.uniform(1, 9, 200))
    rgb = rng.integers(0, 255, (200, 3))
    size = 5.0
    uv, depth = CAMERA.project(xyz.astype(np.float32))
    shown = (np.abs(uv / [40, 30] - 0.5) < 0.5 + 2 * size / np.array([40, 30])).all(axis=1)
    radius = size * np.clip(np.median(depth[shown]) / depth, 0.75, 2.0)
    expected = np.full((60, 80, 3), 255.0)
    v, u = np.mgrid[:60, :80] + 0.5
    for i in np.argsort(-depth):
        expected[np.hypot(u - 2 * uv[i, 0], v - 2 * uv[i, 1]) <= radius[i]] = rgb[i]
    expected = expected.reshape(30, 2, 40, 2, 3).mean(axis=(1, 3))
    picture = render_points(_cloud(xyz, rgb), CAMERA, point_size=size)
    np.testing.assert_allclose(picture, expected, atol=0.51)


@pytest.fixture
def scene(tmp_path, rng):
    folder = tmp_path / "images"
    folder.mkdir()
    PillowImage.new("RGB", (40, 30), (10, 200, 30)).save(folder / "a.png")
    intrinsics = Intrinsics(1, "PINHOLE", 40, 30, (50.0, 50.0, 20.0, 15.0))
    image = Image("a.png", 1, intrinsics, np.array([1.0, 0, 0, 0]), np.zeros(3))
    xyz = CAMERA.unproject(rng.uniform([0, 0], [40, 30], (150, 2)), rng.uniform(2, 4, 150))
    points = _cloud(xyz, np.full((150, 3), 60))
    source = SceneSource("colmap", tmp_path, tmp_path / "points3D.bin", image_dir=folder)
    return Scene(points, (image,), (intrinsics,), source=source)


def _read(path):
    with PillowImage.open(path) as file:
        assert file.format == "PNG"
        return np.asarray(file.convert("RGB")).astype(int)


def test_a_pair_shows_both_clouds(scene, tmp_path):
    dense = PointCloud.concatenate(
        scene.points, scene.points.replace(xyz=scene.points.xyz + np.float32(0.03))
    )
    picture = _read(preview_pair(scene, dense, tmp_path / "out" / "pair.png", title="twice"))
    left, right = np.array_split(picture[60:], 2, axis=1)
    assert picture.shape[1] > 2 * picture.shape[0] > 600
    assert 0 < (left < 100).mean() < (right < 100).mean()
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["pair.png"]


def test_the_grid_starts_with_the_photograph_where_there_is_one(scene, tmp_path):
    clouds = {"one": scene.points, "two": scene.points}
    with_photo = _read(preview_methods(scene, clouds, tmp_path / "with.png"))
    green = (with_photo == [10, 200, 30]).all(axis=2)
    assert green.sum() == 600 * 450
    assert not green[:, 615:].any()
    bare = _read(preview_methods(scene.replace(source=None), clouds, tmp_path / "without.png"))
    assert not (bare == [10, 200, 30]).all(axis=2).any()


def test_errors_are_coloured_by_distance(scene, tmp_path):
    def picture(value):
        path = preview_errors(
            {"new": scene.points},
            {"new": np.full(len(scene.points), value)},
            CAMERA,
            tmp_path / "errors.png",
        )
        return _read(path)[40:480, 12:600]

    good, bad, worse = picture(0.0), picture(1.0), picture(70.0)
    inked = (good.min(axis=2) < 250) & (bad.min(axis=2) < 250)
    assert good[inked][:, 2].mean() > good[inked][:, 1].mean() + 50  # blue
    assert bad[inked][:, 0].mean() > bad[inked][:, 2].mean() + 100  # yellow
    np.testing.assert_array_equal(bad, worse)


def test_errors_that_do_not_fit_the_points_are_refused(scene, tmp_path):
    with pytest.raises(PointCloudError, match="one distance for each"):
        preview_errors({"a": scene.points}, {"a": np.zeros(3)}, CAMERA, tmp_path / "x.png")
    assert not (tmp_path / "x.png").exists()


def test_a_picture_that_cannot_be_written_is_our_error(scene, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        preview_pair(scene, scene.points, tmp_path / "file" / "pair.png")


def test_the_same_cloud_gives_the_same_bytes(scene, tmp_path):
    first = preview_pair(scene, scene.points, tmp_path / "1.png").read_bytes()
    assert first == preview_pair(scene, scene.points, tmp_path / "2.png").read_bytes()


@pytest.mark.parametrize("name", ["fern", "fox", "mipnerf360_sfm/stump"])
def test_real_scenes_fill_a_good_part_of_the_picture(scenes, tmp_path, name):
    real = load_scene(scenes / name)
    picture = _read(preview_pair(real, real.points, tmp_path / "real.png"))
    left, right = np.array_split(picture[40:] < 200, 2, axis=1)
    assert left.mean() > 0.01
    assert right.mean() == pytest.approx(left.mean(), rel=0.05)
