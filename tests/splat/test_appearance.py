"""First colours: least squares over the views that show a seed, against a plain one and planted
ones."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.pointcloud import PointCloud
from splatseed.splat.gaussians import EVEN, OWN, SH_C0, SH_C1, fit_harmonics, initial_gaussians
from splatseed.views.view import View

SIDE = 64
DARK, BRIGHT = 0.42, 0.58


def view_from(x, pixels):
    """A camera at (x, 0, -3) that looks along z."""
    pose = np.eye(4)
    pose[:3, 3] = [-x, 0.0, 3.0]
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    return View(
        name=f"{x}.png", photograph=pixels, K=matrix, width=SIDE, height=SIDE, cam_from_world=pose
    )


def flat(value):
    return np.full((SIDE, SIDE, 3), value, np.uint8)


def cloud(xyz, rgb=(100, 100, 100)):
    return PointCloud(np.asarray(xyz, np.float32), np.tile(np.uint8(rgb), (len(xyz), 1)))


def color_towards(harmonics, direction):
    x, y, z = direction / np.linalg.norm(direction)
    basis = np.array([SH_C0, -SH_C1 * y, SH_C1 * z, -SH_C1 * x])
    return 0.5 + basis @ harmonics


def test_the_fit_is_the_least_of_its_sum():
    """Against a general solver on the rows that the docstring's sum has."""
    seeds, values = cloud([[0.1, 0.2, 0.0]]), (60, 120, 200)
    views = [view_from(x, flat(v)) for x, v in zip((-1, 0, 1), values, strict=True)]
    rows, right = [], []
    for view, value in zip(views, values, strict=True):
        d = seeds.xyz[0] + view.cam_from_world[:3, 3]
        d = d / np.linalg.norm(d)
        rows.append([SH_C0, -SH_C1 * d[1], SH_C1 * d[2], -SH_C1 * d[0]])
        right.append(value / 255 - 0.5)
    rows += [np.sqrt(OWN) * np.array([SH_C0, 0, 0, 0]), *(np.sqrt(EVEN) * SH_C1 * np.eye(4)[1:])]
    right += [np.sqrt(OWN) * (100 / 255 - 0.5), 0, 0, 0]
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    for channel in fit_harmonics(seeds, views)[0].T:
        np.testing.assert_allclose(channel, expected, rtol=1e-4, atol=1e-5)


def test_colors_follow_the_side_that_is_looked_at():
    """Dark from the left and bright from the right, as a shining surface is."""
    views = [view_from(x, flat(80 if x < 0 else 180)) for x in np.linspace(-1.3, 1.3, 24)]
    harmonics = fit_harmonics(cloud([[0.0, 0.0, 0.0]]), views)[0]
    left, right = (color_towards(harmonics, np.array([-x, 0, 3.0])).mean() for x in (-1.3, 1.3))
    assert left < DARK
    assert right > BRIGHT


def test_a_seed_that_no_view_shows_keeps_its_color():
    views = [view_from(0.0, flat(200))]
    seeds = cloud([[0, 0, -9.0], [50.0, 0, 0]], (30, 60, 90))
    gaussians = initial_gaussians(seeds, harmonics=fit_harmonics(seeds, views))
    shown = 0.5 + SH_C0 * gaussians.sh0[:, 0]
    np.testing.assert_allclose(shown, np.array([[30, 60, 90]] * 2) / 255, atol=1e-6)
    assert not gaussians.shN.any()


def test_what_is_hidden_does_not_take_the_color_of_what_hides_it():
    """A wall in front fills the cells; the seed far behind it is not looked at."""
    wall = [[x, y, 0.0] for x in np.linspace(-1, 1, 40) for y in np.linspace(-1, 1, 40)]
    seeds = cloud([*wall, [0.0, 0.0, 3.0]], (10, 10, 10))
    harmonics = fit_harmonics(seeds, [view_from(0.0, flat(250))])
    toward = np.array([0.0, 0, 1])
    assert color_towards(harmonics[-1], toward).mean() == pytest.approx(10 / 255, abs=1e-5)
    assert color_towards(harmonics[0], toward).mean() > 0.5


@pytest.mark.parametrize(("degree", "rest"), [(0, 0), (1, 3), (3, 15)])
def test_harmonics_are_cut_or_filled_to_the_degree(degree, rest):
    seeds = cloud([[0, 0, 0.0], [1, 0, 0.0]])
    harmonics = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    gaussians = initial_gaussians(seeds, sh_degree=degree, harmonics=harmonics)
    assert gaussians.shN.shape == (2, rest, 3)
    np.testing.assert_array_equal(gaussians.sh0[:, 0], harmonics[:, 0])
    if rest:
        np.testing.assert_array_equal(gaussians.shN[:, :3], harmonics[:, 1:])
        assert not gaussians.shN[:, 3:].any()
