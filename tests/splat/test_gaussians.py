"""Seeds to Gaussians, their first colours, and the training frame."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.camera import Camera, rotation_from_quat
from splatseed.errors import PointCloudError
from splatseed.io.ply import read_ply
from splatseed.photos.loading import load_split
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import (
    INITIALIZATION,
    fit_harmonics,
    initial_gaussians,
    neighbor_distances,
)
from splatseed.splat.gaussians import SH_C0, SH_C1
from splatseed.splat.training_frame import training_frame

SIDE = 64


def _cloud(xyz, rgb=(100, 100, 100)):
    return PointCloud(np.asarray(xyz, np.float32), np.tile(np.uint8(rgb), (len(xyz), 1)))


# Seeds to Gaussians -------------------------------------------------------------------------------


def test_a_written_cloud_shows_the_seeds_colours(tmp_path, rng):
    seeds = PointCloud(rng.random((50, 3)), rng.integers(0, 256, (50, 3), np.uint8))
    write_gaussians(tmp_path / "g.ply", initial_gaussians(seeds))
    assert np.array_equal(read_ply(tmp_path / "g.ply").rgb, seeds.rgb)


def test_initial_scale_is_the_distance_to_three_neighbours(rng):
    xyz = rng.random((200, 3))
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    expected = np.sqrt((nearest**2).mean(axis=1))
    assert np.allclose(neighbor_distances(xyz), expected, rtol=1e-5)
    gaussians = initial_gaussians(_cloud(xyz), opacity=0.3)
    assert np.allclose(np.exp(gaussians.scales), expected[:, None], rtol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-gaussians.opacities)), 0.3)


def test_known_sizes_are_used_and_bounded(rng):
    xyz, sizes = rng.normal(size=(200, 3)), rng.uniform(1e-3, 10.0, 200)
    sizes[::3] = np.nan
    cloud, largest = _cloud(xyz), rng.uniform(0.01, 5.0, 200)
    free = initial_gaussians(cloud, scale_factor=0.5)
    told = initial_gaussians(cloud.replace(sizes=sizes), scale_factor=0.5, max_sizes=largest)
    expected = np.where(np.isnan(sizes), np.exp(free.scales[:, 0]), 0.5 * sizes)
    expected = np.minimum(expected, largest)
    assert np.allclose(np.exp(told.scales), expected[:, None], rtol=1e-5)


def test_seeds_with_normals_become_discs(rng):
    normals = rng.normal(size=(200, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[6::3] = np.nan
    cloud = _cloud(rng.normal(size=(200, 3)))
    balls, discs = initial_gaussians(cloud), initial_gaussians(cloud.replace(normals=normals))
    known = ~np.isnan(normals[:, 0])
    for i in np.flatnonzero(known):
        thin = rotation_from_quat(discs.quats[i])[:, 2]
        assert abs(thin @ normals[i]) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(np.linalg.norm(discs.quats, axis=1), 1.0, atol=1e-6)
    shrunk = np.exp(discs.scales - balls.scales)
    assert np.allclose(shrunk[known], [1.0, 1.0, 0.1])
    assert np.array_equal(discs.scales[~known], balls.scales[~known])
    assert np.array_equal(discs.quats[~known], balls.quats[~known])


@settings(deadline=None, max_examples=40)
@given(
    count=st.integers(1, 40),
    copies=st.integers(0, 30),
    far=st.sampled_from([0.0, 1e3, 1e6]),
    seed=st.integers(0, 99),
)
def test_initial_scales_are_finite_and_near_the_median(count, copies, far, seed):
    rng = np.random.default_rng(seed)
    xyz = np.concatenate([rng.normal(size=(count, 3)), np.zeros((copies, 3)), [[far, 0, 0]]])
    distinct = len(np.unique(xyz.astype(np.float32), axis=0))
    cloud = _cloud(xyz)
    if distinct < 2:
        with pytest.raises(PointCloudError, match="distinct"):
            initial_gaussians(cloud)
        return
    scales = initial_gaussians(cloud).scales
    assert np.isfinite(scales).all()
    assert np.ptp(scales) <= np.log(1000) + 1e-3


# First colours: least squares over the views that show a seed -------------------------------------


def _view_from(x, value):
    """A photograph of one grey by a camera at (x, 0, -3) that looks along z."""
    pose, K = np.eye(4), np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    pose[:3, 3] = [-x, 0.0, 3.0]
    return View(f"{x}.png", np.full((SIDE, SIDE, 3), value, np.uint8), Camera(K, SIDE, SIDE, pose))


def test_fitted_harmonics_minimise_the_sum_of_squares():
    """Against a general solver on the rows that the docstring's sum has."""
    seeds, values = _cloud([[0.1, 0.2, 0.0]]), (60, 120, 200)
    views = [_view_from(x, v) for x, v in zip((-1, 0, 1), values, strict=True)]
    rows, right = [], []
    for view, value in zip(views, values, strict=True):
        d = seeds.xyz[0] + view.cam_from_world[:3, 3]
        d = d / np.linalg.norm(d)
        rows.append([SH_C0, -SH_C1 * d[1], SH_C1 * d[2], -SH_C1 * d[0]])
        right.append(value / 255 - 0.5)
    rows += [
        np.sqrt(INITIALIZATION.color_weight) * np.array([SH_C0, 0, 0, 0]),
        *(np.sqrt(INITIALIZATION.smoothness_weight) * SH_C1 * np.eye(4)[1:]),
    ]
    right += [np.sqrt(INITIALIZATION.color_weight) * (100 / 255 - 0.5), 0, 0, 0]
    expected = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    for channel in fit_harmonics(seeds, views)[0].T:
        np.testing.assert_allclose(channel, expected, rtol=1e-4, atol=1e-5)


def test_an_invisible_seed_keeps_its_colour():
    """Behind the camera, beside its picture, or far behind a wall that fills the cells."""
    wall = [[x, y, 0.0] for x in np.linspace(-1, 1, 40) for y in np.linspace(-1, 1, 40)]
    seeds = _cloud([[0, 0, -9.0], [50.0, 0, 0], [0, 0, 3.0], *wall], (30, 60, 90))
    harmonics = fit_harmonics(seeds, [_view_from(0.0, 250)])
    shown = 0.5 + SH_C0 * harmonics[:, 0]
    np.testing.assert_allclose(shown[:3], np.array([[30, 60, 90]] * 3) / 255, atol=1e-5)
    assert np.abs(harmonics[:3, 1:]).max() < 1e-5
    assert shown[3:].mean() > 0.5


def test_harmonics_are_truncated_or_padded_to_the_degree():
    harmonics = np.arange(24, dtype=np.float32).reshape(2, 4, 3)
    for degree, rest in ((0, 0), (1, 3), (3, 15)):
        seeds = _cloud([[0, 0, 0.0], [1, 0, 0.0]])
        gaussians = initial_gaussians(seeds, sh_degree=degree, harmonics=harmonics)
        filled = np.concatenate([harmonics[:, 1 : rest + 1], np.zeros((2, max(rest - 3, 0), 3))], 1)
        np.testing.assert_array_equal(gaussians.sh0[:, 0], harmonics[:, 0])
        np.testing.assert_array_equal(gaussians.shN, filled)


# The frame ----------------------------------------------------------------------------------------


def test_the_frame_depends_on_cameras_alone_and_round_trips(room, rng):
    train, _ = load_split(room)
    frame = training_frame(train)
    centers = np.array([np.linalg.inv(frame.view(v).cam_from_world)[:3, 3] for v in train])
    assert np.allclose(centers.mean(axis=0), 0, atol=1e-9)
    assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1.0)
    gaussians = initial_gaussians(_cloud(rng.normal(size=(20, 3))))
    moved = frame.gaussians_from_world(gaussians)
    assert np.array_equal(moved.means, frame.points_from_world(gaussians.means))
    assert np.allclose(np.exp(moved.scales), frame.scale * np.exp(gaussians.scales), rtol=1e-5)
    back = frame.gaussians_to_world(moved)
    assert np.allclose(back.means, gaussians.means, atol=1e-5)
    assert np.allclose(back.scales, gaussians.scales, atol=1e-5)
    assert training_frame(train[:1] * 2).scale == 1.0


def test_sizes_scale_with_the_frame(room):
    frame, sizes = training_frame(load_split(room)[0]), np.full(len(room.points), 0.3)
    sizes[:2] = np.nan, 1e-38
    cloud = frame.cloud_from_world(room.points.replace(sizes=sizes))
    assert np.array_equal(cloud.xyz, frame.points_from_world(room.points.xyz))
    assert np.allclose(cloud.sizes[2:], 0.3 * frame.scale)
    assert np.isnan(cloud.sizes[0])
    assert cloud.sizes[1] > 0
    assert frame.cloud_from_world(room.points).sizes is None
