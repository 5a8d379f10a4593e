"""Points are drawn where, in front of and as many as they should be; pages show what they say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image as PillowImage

from splatseed.camera import Camera, Intrinsics
from splatseed.depth.stereo import StereoMap
from splatseed.errors import OutputError
from splatseed.methods import SOURCE_CODES
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.viewer import clouds as pages
from splatseed.viewer.maps import map_tiles, normal_picture
from splatseed.viewer.page import (
    GROUND,
    UNKNOWN,
    Tile,
    color_bar,
    depth_picture,
    legend,
    write_grid,
)
from splatseed.viewer.points import COLORS, origin_colors, points_over, render_points

K = np.array([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]])
CAMERA = Camera(K, 40, 30, np.eye(4))
PHOTOGRAPH = [10, 200, 30]


def _cloud(xyz, rgb):
    return PointCloud(np.array(xyz, float).reshape(-1, 3), np.array(rgb, np.uint8).reshape(-1, 3))


def _at(column, row, depth):
    """The world point in the middle of a pixel."""
    return CAMERA.unproject(np.array([[column + 0.5, row + 0.5]]), np.array([depth]))[0]


def _read(path):
    with PillowImage.open(path) as file:
        assert file.format == "PNG"
        return np.asarray(file.convert("RGB")).astype(int)


# Points -------------------------------------------------------------------------------------------


def test_a_point_in_the_middle_of_a_pixel_colours_that_pixel_alone():
    for size in (1, 0.01):  # however small its disc
        picture = render_points(_cloud(_at(7, 22, 3.0), [255, 0, 0]), CAMERA, point_size=size)
        assert np.argwhere((picture != GROUND).any(axis=2)).tolist() == [[22, 7]]


def test_drawing_matches_a_loop_over_points(rng):
    """The nearer hides the farther, and is larger; those behind, beside or nowhere are left out."""
    seen = CAMERA.unproject(rng.uniform([-2, -2], [42, 32], (200, 2)), rng.uniform(1, 9, 200))
    lost = [[0, 0, -2.0], [0, 0, 0], [900.0, 0, 1], [np.nan, 0, 2], [0, np.inf, 2], [0, -1e30, 1]]
    rgb, size = rng.integers(0, 255, (206, 3)), 5.0
    uv, depth = CAMERA.project(seen.astype(np.float32))
    shown = (np.abs(uv / [40, 30] - 0.5) < 0.5 + 2 * size / np.array([40, 30])).all(axis=1)
    radius = size * np.clip(np.median(depth[shown]) / depth, 0.75, 2.0)
    expected = np.full((60, 80, 3), GROUND, float)
    v, u = np.mgrid[:60, :80] + 0.5
    for i in np.argsort(-depth):
        expected[np.hypot(u - 2 * uv[i, 0], v - 2 * uv[i, 1]) <= radius[i]] = rgb[i]
    expected = expected.reshape(30, 2, 40, 2, 3).mean(axis=(1, 3))
    picture = render_points(_cloud([*seen, *lost], rgb), CAMERA, point_size=size)
    np.testing.assert_allclose(picture, expected, atol=0.51)
    nothing = render_points(_cloud(lost, rgb[:6]), CAMERA, background=(9, 8, 7))
    assert (nothing == [9, 8, 7]).all()


# Pages of clouds ----------------------------------------------------------------------------------


@pytest.fixture
def scene(tmp_path, rng):
    folder = tmp_path / "images"
    folder.mkdir()
    PillowImage.new("RGB", (40, 30), tuple(PHOTOGRAPH)).save(folder / "a.png")
    intrinsics = Intrinsics(1, "PINHOLE", 40, 30, (50.0, 50.0, 20.0, 15.0))
    image = Image("a.png", 1, intrinsics, np.array([1.0, 0, 0, 0]), np.zeros(3))
    xyz = CAMERA.unproject(rng.uniform([0, 0], [40, 30], (150, 2)), rng.uniform(2, 4, 150))
    points = _cloud(xyz, np.full((150, 3), 60))
    source = SceneSource("colmap", tmp_path, tmp_path / "points3D.bin", image_dir=folder)
    return Scene(points, (image,), (intrinsics,), source=source)


def test_every_origin_has_a_colour_of_its_own():
    codes = np.array([0, *SOURCE_CODES.values(), 255], np.uint8)
    assert len(np.unique(origin_colors(codes), axis=0)) == len(codes)
    assert origin_colors(np.array([77], np.uint8)).tolist() == [list(COLORS[255])]
    seeds = _cloud([_at(5, 5, 2.0), _at(20, 15, 2.0)], origin_colors(np.array([0, 8], np.uint8)))
    picture = points_over(seeds, CAMERA, np.zeros((60, 80, 3), np.uint8), scale=2.0).astype(int)
    for (row, column), code in (((11, 11), 0), ((31, 41), 8)):
        assert picture[row, column].tolist() == list(COLORS[code])


def test_a_pair_shows_both_clouds(scene, tmp_path):
    moved = scene.points.replace(xyz=scene.points.xyz + np.float32(0.03))
    dense = PointCloud.concatenate(scene.points, moved)
    path = pages.preview_pair(scene, dense, tmp_path / "out" / "pair.png", title="twice")
    picture = _read(path)
    left, right = np.array_split(picture[60:], 2, axis=1)
    assert picture.shape[1] > 2 * picture.shape[0] > 600
    assert 0 < (left < 100).mean() < (right < 100).mean()
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["pair.png"]
    again = pages.preview_pair(scene, dense, tmp_path / "again.png", title="twice")
    assert path.read_bytes() == again.read_bytes()
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OutputError):
        pages.preview_pair(scene, dense, tmp_path / "file" / "pair.png")


def test_a_scene_without_points_is_shown_by_its_photograph(scene, tmp_path):
    bare = scene.replace(points=PointCloud.empty(), tracks=None)
    shown, with_points = (
        _read(pages.preview_pair(each, scene.points, tmp_path / name))
        for each, name in ((bare, "bare.png"), (scene, "both.png"))
    )
    left, right = np.array_split(shown[60:], 2, axis=1)
    assert (np.abs(left - PHOTOGRAPH) < 9).all(axis=2).mean() > 0.9
    same = np.array_split(with_points[60:], 2, axis=1)[1]
    np.testing.assert_array_equal(right, same)


def test_white_walls_show_and_guessed_seeds_are_marked(scene, tmp_path):
    """On a ground that is neither; without guesses there is no third picture."""
    source = np.where(np.arange(150) % 3, SOURCE_CODES["stereo"], SOURCE_CODES["cover"])
    white = scene.points.replace(rgb=np.full((150, 3), 255, np.uint8))
    seeds = white.replace(source=source.astype(np.uint8))
    path = pages.preview_pair(scene.replace(points=white), seeds, tmp_path / "pair.png")
    left, right, marked = np.array_split(_read(path)[60:], 3, axis=1)
    orange = np.array(COLORS[SOURCE_CODES["cover"]])
    for picture in (left, right, marked):
        assert (picture == GROUND).all(axis=2).mean() > 0.5
    drawn = [(np.abs(p - orange) < 9).all(axis=2).sum() for p in (left, right, marked)]
    assert drawn[:2] == [0, 0]
    assert drawn[2] >= 50  # of 50 guesses
    pair = _read(pages.preview_pair(scene, white, tmp_path / "again.png"))
    assert pair.shape[1] < 2 * 830


def test_a_legend_has_all_colours_in_as_many_rows_as_it_needs():
    entries = {f"origin {i} 123,456": (i, 200, 9) for i in range(6)}
    for width, rows in ((2000, 1), (600, 2), (150, 6)):
        strip = legend(entries, width)
        assert (strip.shape[1], len(strip) // len(legend({}, width))) == (width, rows)
        assert all((strip == color).all(axis=2).any() for color in entries.values())


def test_the_grid_starts_with_the_photograph(scene, tmp_path):
    clouds = {"one": scene.points, "two": scene.points}
    picture = _read(pages.preview_methods(scene, clouds, tmp_path / "methods.png"))
    assert (picture[:, :615] == PHOTOGRAPH).all(axis=2).sum() == 600 * 450


@settings(deadline=None)
@given(data=st.data(), height=st.integers(1, 20), width=st.integers(1, 20), cell=st.integers(1, 9))
def test_a_pixel_is_dimmed_or_tinted_as_its_cell_is(data, height, width, cell):
    covered = data.draw(hnp.arrays(bool, (-(-height // cell), -(-width // cell))))
    picture = pages.cell_picture(np.full((height, width, 3), 200, np.uint8), covered, cell).astype(
        int
    )
    seeded = covered.repeat(cell, axis=0).repeat(cell, axis=1)[:height, :width]
    assert (picture[seeded] == 150).all()
    assert (picture[~seeded][:, [0, 2]] > picture[~seeded][:, [1]] + 50).all()


def test_a_label_in_any_script_is_drawn(tmp_path):
    for name in ("日本語の部屋", "방 $a_1$", r"\frac $", "\U0001f3e0", "x" * 400):
        write_grid([Tile(name, np.zeros((50, 300, 3), np.uint8))], tmp_path / "a.png")


# Maps ---------------------------------------------------------------------------------------------


@pytest.fixture
def maps():
    """A slope that comes nearer to the right; its left half is not known."""
    depth = np.tile(np.linspace(8.0, 2.0, 40, dtype=np.float32), (30, 1))
    normal = np.tile(np.array([0, 0, -1], np.float32), (30, 40, 1))
    depth[:, :20] = normal[:, :20] = np.nan
    return StereoMap(
        "a.png", CAMERA, depth, normal, np.nan_to_num(depth / 8), (), *[np.empty(0)] * 2
    )


def test_unknown_is_grey_and_near_is_brighter_than_far(maps):
    picture = depth_picture(maps.depth).astype(int)
    unknown = np.isnan(maps.depth)
    assert (picture[unknown] == UNKNOWN).all()
    assert not (picture[~unknown] == UNKNOWN).all(axis=1).any()
    brightness = picture[0, 20:].sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert brightness[-1] > brightness[0] + 200
    for value in (np.nan, 3.0, np.inf, 0.0, -1.0):
        assert depth_picture(np.full((3, 4), value)).shape == (3, 4, 3)


def test_labels_of_a_colour_bar_are_complete():
    bar = color_bar("0 spacings", "1 spacing or more from the surface")
    assert bar.min() < 50
    assert (bar[:, :8] == 255).all()
    assert (bar[:, -8:] == 255).all()


def test_normals_have_the_colours_of_their_axes():
    normal = np.array([[[0, 0, -1], [1, 0, 0], [0, -1, 0], [np.nan, 0, 0]]])
    picture = normal_picture(normal)[0].tolist()  # toward the camera, right, up
    assert picture == [[128, 128, 255], [255, 128, 128], [128, 255, 128], list(UNKNOWN)]


def test_a_row_has_four_pictures_of_the_photographs_size(maps):
    photograph = np.full((90, 120, 3), 40, np.uint8)
    tiles = map_tiles(maps, photograph)
    assert [tile.picture.shape for tile in tiles] == [photograph.shape] * 4
    assert tiles[0].picture is photograph
    for tile in tiles[1:]:  # no pixel is a blend of known and unknown
        assert (tile.picture[:, :60] == UNKNOWN).all()
