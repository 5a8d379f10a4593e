"""Points without colours take those of the photographs, wherever seeds are made."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed import upsample
from splatseed.progress import silent
from splatseed.seeding.clouds.point_colors import encoded_if_linear, lacks_color, with_colors
from splatseed.seeding.photo_methods import Cover


def in_color(scene, color):
    rgb = np.full_like(scene.points.rgb, color)
    return scene.with_points(scene.points.replace(rgb=rgb))


@pytest.mark.parametrize("color", [0, 128, 255])
def test_points_of_one_color_get_those_of_the_photographs(room, color):
    found = []
    colored = with_colors(in_color(room, color), 8, found.append, silent)
    assert [each.kind for each in found] == ["colors-of-photographs"]
    assert f"({color}, {color}, {color})" in found[0].text
    assert np.array_equal(colored.points.xyz, room.points.xyz)
    assert (colored.tracks is None) == (room.tracks is None)
    difference = np.abs(colored.points.rgb.astype(int) - room.points.rgb).max(axis=1)
    assert np.median(difference) < 12
    assert lacks_color(in_color(room, color).points.rgb).all()


def test_points_with_colors_keep_them(room):
    found = []
    assert with_colors(room, 0, found.append, silent) is room
    few = room.with_points(room.points.select(np.arange(5)))
    assert with_colors(in_color(few, 0), 0, found.append, silent).points.rgb.max() == 0
    bare = in_color(room, 0).replace(images=())
    assert with_colors(bare, 0, found.append, silent) is bare
    assert not found


def test_originals_beside_new_points_have_colors(room):
    found = []
    seeds = upsample(in_color(room, 0), Cover(), note=found.append)
    assert seeds.originals.rgb.max() > 100
    assert sum(each.kind == "colors-of-photographs" for each in found) == 1


def test_many_black_points_among_others_take_the_photographs_colours(room):
    rgb, black = room.points.rgb.copy(), np.arange(len(room.points)) % 2 == 0
    rgb[black] = 0
    some = room.with_points(room.points.replace(rgb=rgb))
    colored = with_colors(some, 8, lambda _: None, silent).points.rgb
    assert np.array_equal(colored[~black], rgb[~black])
    difference = np.abs(colored[black].astype(int) - room.points.rgb[black]).max(axis=1)
    assert np.median(difference) < 12
    rgb = room.points.rgb.copy()
    rgb[::20] = 0  # a dark scene
    assert not lacks_color(rgb).any()


def test_linear_colours_are_encoded_where_the_photographs_say_so():
    """IEC 61966-2-1: 0.216 of white is encoded as 0.502, 0.055 as 0.260."""
    linear, seen = np.uint8([[55, 14, 255]] * 20), np.uint8([[128, 66, 255]] * 20)
    encoded = encoded_if_linear(linear, seen, np.arange(20))
    assert encoded[0].tolist() == [128, 66, 255]
    assert encoded_if_linear(seen, seen, np.arange(20)) is None
