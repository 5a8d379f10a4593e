"""Maps are drawn pixel for pixel, and what they do not know is grey."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image as PillowImage

from splatseed.camera import Camera, Intrinsics
from splatseed.depth.stereo import StereoMap
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource
from splatseed.view.maps import depth_picture, map_tiles, normal_picture, preview_maps
from splatseed.view.page import UNKNOWN

WIDTH, HEIGHT = 20, 12
K = np.array([[20.0, 0, 10], [0, 20.0, 6], [0, 0, 1]])


@pytest.fixture
def maps():
    """A slope that comes nearer to the right; its left half is not known."""
    depth = np.tile(np.linspace(8.0, 2.0, WIDTH, dtype=np.float32), (HEIGHT, 1))
    normal = np.tile(np.array([0, 0, -1], np.float32), (HEIGHT, WIDTH, 1))
    depth[:, : WIDTH // 2] = normal[:, : WIDTH // 2] = np.nan
    camera = Camera(K, WIDTH, HEIGHT, np.eye(4))
    return StereoMap("a.png", camera, depth, normal, np.nan_to_num(depth / 8), (), np.empty(0))


def test_unknown_is_grey_and_near_is_brighter_than_far(maps):
    picture = depth_picture(maps.depth).astype(int)
    unknown = np.isnan(maps.depth)
    assert (picture[unknown] == UNKNOWN).all()
    assert not (picture[~unknown] == UNKNOWN).all(axis=1).any()
    brightness = picture[0, WIDTH // 2 :].sum(axis=1)
    assert (np.diff(brightness) >= 0).all()
    assert brightness[-1] > brightness[0] + 200


@pytest.mark.parametrize("value", [np.nan, 3.0, np.inf, 0.0, -1.0])
def test_a_map_of_one_value_is_drawn(value):
    assert depth_picture(np.full((3, 4), value)).shape == (3, 4, 3)


def test_normals_have_the_colours_of_their_axes():
    normal = np.zeros((1, 4, 3))
    normal[0, 0, 2] = -1  # toward the camera
    normal[0, 1, 0] = 1  # to the right
    normal[0, 2, 1] = -1  # upward
    normal[0, 3] = np.nan
    picture = normal_picture(normal)[0].tolist()
    assert picture == [[128, 128, 255], [255, 128, 128], [128, 255, 128], list(UNKNOWN)]


def test_a_row_has_four_pictures_of_the_photographs_size(maps):
    photograph = np.full((3 * HEIGHT, 3 * WIDTH, 3), 40, np.uint8)
    tiles = map_tiles(maps, photograph)
    assert [tile.picture.shape for tile in tiles] == [photograph.shape] * 4
    assert tiles[0].picture is photograph
    assert [tile.label.split()[0] for tile in tiles] == [
        *("a.png", "depth", "normals", "confidence,")
    ]
    assert "50% known" in tiles[1].label
    for tile in tiles[1:]:  # no pixel is a blend of known and unknown
        left = tile.picture[:, : 3 * WIDTH // 2]
        assert (left == UNKNOWN).all()


def test_a_map_of_nothing_has_a_row_too(maps):
    maps.depth[:] = np.nan
    tiles = map_tiles(maps, np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert "0% known" in tiles[1].label
    assert (tiles[3].picture == UNKNOWN).all()


@pytest.mark.parametrize("there", [True, False])
def test_a_page_shows_some_of_the_maps_beside_their_photographs(maps, tmp_path, there):
    if there:
        PillowImage.new("RGB", (WIDTH, HEIGHT), (10, 200, 30)).save(tmp_path / "a.png")
    intrinsics = Intrinsics(1, "PINHOLE", WIDTH, HEIGHT, (20.0, 20.0, 10.0, 6.0))
    image = Image("a.png", 1, intrinsics, np.array([1.0, 0, 0, 0]), np.zeros(3))
    points = PointCloud(np.zeros((1, 3)), np.zeros((1, 3), np.uint8))
    source = SceneSource("colmap", tmp_path, tmp_path, image_dir=tmp_path)
    scene = Scene(points, (image,), (intrinsics,), source=source)
    path = preview_maps(scene, [maps] * 5, tmp_path / "out.png", most=2)
    picture = np.asarray(PillowImage.open(path).convert("RGB"))
    assert (picture == [10, 200, 30]).all(axis=2).sum() == (2 * 440 * 264 if there else 0)
