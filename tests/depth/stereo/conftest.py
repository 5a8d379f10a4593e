"""Fixtures of the stereo tests: what takes seconds is made once."""

from __future__ import annotations

from collections import namedtuple

import pytest

from splatseed.depth.stereo.maps import StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo
from splatseed.photos.loading import load_views
from splatseed.photos.visibility import find_visibility

from .made import arc, ball_before_wall, photograph, tilted_plane

SETTINGS = StereoSettings(grid=2)
"""The made views are small: a finer grid gives more to judge by."""
Planted = namedtuple("Planted", "scene surfaces stereo")  # noqa: PYI024  (and what stereo found)


def plant(folder, surfaces):
    scene = photograph(folder, surfaces, arc())
    views, visibility = load_views(scene, scene.images), find_visibility(scene)
    return Planted(scene, surfaces, find_stereo(views, scene.images, visibility, SETTINGS))


@pytest.fixture(scope="session")
def plane(tmp_path_factory):
    return plant(tmp_path_factory.mktemp("plane"), tilted_plane())


@pytest.fixture(scope="session")
def ball(tmp_path_factory):
    return plant(tmp_path_factory.mktemp("ball"), ball_before_wall())
