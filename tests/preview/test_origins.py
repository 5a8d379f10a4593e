"""Each point has the colour of its origin, and the legend says which that is."""

from __future__ import annotations

import numpy as np
from PIL import Image as PillowImage

from splatseed.camera import Camera
from splatseed.pointcloud import PointCloud
from splatseed.preview import origin_legend, origin_picture, preview_origins
from splatseed.preview.origins import COLORS, origin_colors
from splatseed.scene import Scene
from splatseed.upsample.registry import SOURCE_CODES

K = np.array([[50.0, 0, 20], [0, 50.0, 15], [0, 0, 1]])
CAMERA = Camera(K, 40, 30, np.eye(4))


def seeds():
    """An original, a stereo and a cover seed in the middle of three pixels, all of one colour."""
    uv = np.array([[5.5, 5.5], [20.5, 15.5], [35.5, 25.5]])
    source = np.array([0, SOURCE_CODES["stereo"], SOURCE_CODES["cover"]], np.uint8)
    return PointCloud(CAMERA.unproject(uv, np.full(3, 2.0)), np.full((3, 3), 90, np.uint8), source)


def test_every_code_has_a_colour_of_its_own():
    codes = np.array([0, *SOURCE_CODES.values(), 255], np.uint8)
    assert len(np.unique(origin_colors(codes), axis=0)) == len(codes)
    assert origin_colors(np.array([77], np.uint8)).tolist() == [list(COLORS[255])]


def test_points_are_drawn_in_the_colours_of_their_origins():
    picture = origin_picture(seeds(), CAMERA)
    for (row, column), code in zip([(5, 5), (15, 20), (25, 35)], (0, 8, 9), strict=True):
        assert picture[row, column].tolist() == list(COLORS[code])
    assert picture[15, 5].tolist() == [255, 255, 255]


def test_the_photograph_behind_is_grey_and_pale():
    photograph = np.zeros((60, 80, 3), np.uint8)
    photograph[:, :40] = [250, 10, 10]
    picture = origin_picture(seeds(), CAMERA, photograph, scale=2.0).astype(int)
    assert picture.shape == (60, 80, 3)
    left, right = picture[50, 5], picture[10, 70]
    assert len(set(left)) == len(set(right)) == 1
    assert 170 < right[0] < left[0] < 255


def test_the_legend_names_what_is_there():
    strip = origin_legend(seeds(), 600)
    assert strip.shape == (44, 600, 3)
    for code, color in COLORS.items():  # letters have greys
        assert ((strip == color).all(axis=2).sum() > 100) == (code in {0, 8, 9})


def test_a_page_of_a_bare_cloud_has_both_pictures(tmp_path):
    path = preview_origins(Scene(seeds()), seeds(), tmp_path / "origins.png")
    picture = np.asarray(PillowImage.open(path).convert("RGB"))
    left, right = np.array_split(picture[40:-44], 2, axis=1)
    stereo = COLORS[SOURCE_CODES["stereo"]]
    assert not (left == stereo).all(axis=2).any()
    assert (right == stereo).all(axis=2).any()
