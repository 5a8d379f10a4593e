"""The colours of Gaussians that no photograph shows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.splat.gaussians import Gaussians
from splatseed.training.hidden import recolored, visible_fractions
from splatseed.training.parameters import gaussians_of, make_parameters

SIDE = 64
RED, GREEN = [1.0, -1.0, -1.0], [-1.0, 1.0, -1.0]  # as harmonics
WALL, BEHIND, AROUND = slice(0, 162), slice(162, 166), slice(166, None)


def view_from(x):
    """A view along z, of half a radian to each side."""
    pose = np.eye(4)
    pose[0, 3] = -x
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    return View(f"{x}.png", np.zeros((SIDE, SIDE, 3), np.uint8), Camera(matrix, SIDE, SIDE, pose))


@pytest.fixture
def params():
    """A red wall of two layers, four red Gaussians behind it, and green ones around these."""
    side = np.linspace(-0.4, 0.4, 9)
    wall = [[x, y, z] for z in (2.0, 2.05) for y in side for x in side]
    behind = [[x, y, 4.0] for x in (-0.15, 0.15) for y in (-0.15, 0.15)]
    far = np.linspace(-1.6, 1.6, 9)
    around = [[x, y, 4.0] for x in far for y in far if max(abs(x), abs(y)) > 1.1]
    means = np.array([*wall, *behind, *around])
    count = len(means)
    sizes = np.full(count, 0.1)
    sizes[BEHIND] = 0.15
    colors = np.tile(RED, (count, 1))
    colors[AROUND] = GREEN
    gaussians = Gaussians(
        means=means.astype(np.float32),
        scales=np.log(np.repeat(sizes[:, None], 3, axis=1)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacities=np.full(count, np.log(0.9 / 0.1), np.float32),
        sh0=colors[:, None].astype(np.float32),
        shN=np.ones((count, 15, 3), np.float32),
    )
    return make_parameters(gaussians, torch.device("cpu"))


def test_what_is_behind_a_wall_takes_the_colour_of_what_is_beside_it(params):
    before, after = gaussians_of(params), recolored(params, [view_from(0.0)], dropout=0.6)
    np.testing.assert_allclose(after.sh0[BEHIND, 0], [GREEN] * 4, atol=0.02)
    assert np.abs(after.shN[BEHIND]).max() < 0.02
    for name, values in after.arrays().items():
        rest = slice(None) if name not in ("sh0", "shN") else AROUND
        np.testing.assert_array_equal(values[rest], before.arrays()[name][rest])


def test_what_another_view_shows_keeps_its_colour(params):
    after = recolored(params, [view_from(0.0), view_from(1.6)], dropout=0.6)
    np.testing.assert_array_equal(after.sh0[BEHIND, 0], [RED] * 4)


def test_the_visible_fraction_is_the_transmittance_in_front():
    """One Gaussian alone, behind a wide one, across a frame's edge, and outside all frames."""
    means = [[0.0, 0.0, 3.0], [0.0, 0.0, 2.0], [1.4, 0.0, 3.0], [9.0, 0.0, 3.0]]
    sizes = np.array([0.05, 4.0, 0.2, 0.05])
    front = 0.8
    gaussians = Gaussians(
        means=np.array(means, np.float32),
        scales=np.log(np.repeat(sizes[:, None], 3, axis=1)).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (4, 1)),
        opacities=np.array([0.0, np.log(front / (1 - front)), 0.0, 0.0], np.float32),
        sh0=np.zeros((4, 1, 3), np.float32),
        shN=np.zeros((4, 15, 3), np.float32),
    )
    params = make_parameters(gaussians, torch.device("cpu"))
    shown = visible_fractions(params, [view_from(0.0)])
    assert shown[0] == pytest.approx(1 - front, rel=0.03)
    assert shown[2] == 1.0
    assert np.isnan(shown[3])
