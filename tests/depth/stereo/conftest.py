"""Fixtures of the stereo tests: what takes seconds is made once."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from splatseed.depth.stereo.depths import StereoResult, find_stereo
from splatseed.depth.stereo.maps import StereoSettings
from splatseed.scene import Scene
from splatseed.synthetic.surfaces import Union
from splatseed.views.view import load_views
from splatseed.views.visibility import find_visibility

from .made import arc, ball_before_wall, photograph, tilted_plane

SETTINGS = StereoSettings(grid=2)
"""The made views are small: a finer grid gives more to judge by."""


@dataclass(frozen=True, eq=False)
class Planted:
    """A made scene, its surfaces, and what stereo found."""

    scene: Scene
    surfaces: Union
    stereo: StereoResult


def find(scene: Scene) -> StereoResult:
    views = load_views(scene, scene.images)
    return find_stereo(views, scene.images, find_visibility(scene), SETTINGS)


def plant(folder, surfaces: Union, **options) -> Planted:
    scene = photograph(folder, surfaces, arc(), **options)
    return Planted(scene, surfaces, find(scene))


@pytest.fixture(scope="session")
def plane(tmp_path_factory) -> Planted:
    return plant(tmp_path_factory.mktemp("plane"), tilted_plane())


@pytest.fixture(scope="session")
def ball(tmp_path_factory) -> Planted:
    return plant(tmp_path_factory.mktemp("ball"), ball_before_wall())
