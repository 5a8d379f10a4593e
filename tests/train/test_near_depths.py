"""Near depths: against a literal loop, handed on with Gaussians, and the unit of their steps."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from splatseed.splat.gaussians import initial_gaussians
from splatseed.train.parameters import length_units, make_optimizers, make_parameters, optimize
from splatseed.train.schedule import make_schedule
from splatseed.train.seeds import MARGIN, NEAREST, near_depths
from splatseed.views.view import View, load_split

CPU = torch.device("cpu")


def _literal(xyz, views):
    """Point by point and view by view."""
    depths = np.full(len(xyz), np.nan)
    for i, point in enumerate(xyz):
        for view in views:
            x, y, z = (view.cam_from_world @ [*point, 1.0])[:3]
            if z <= NEAREST:
                continue
            u, v, _ = view.K @ [x / z, y / z, 1.0]
            across = -MARGIN * view.width <= u <= (1 + MARGIN) * view.width
            if across and -MARGIN * view.height <= v <= (1 + MARGIN) * view.height:
                depths[i] = np.fmin(depths[i], z)
    return np.where(np.isnan(depths), np.nanmedian(depths), depths)


def _view(center, width=64, height=48):
    cam_from_world = np.eye(4)
    cam_from_world[:3, 3] = -np.asarray(center, float)
    K = np.array([[60.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View("", np.empty((0, 0, 3), np.uint8), K, width, height, cam_from_world)


def test_they_are_what_a_literal_loop_finds(room, rng):
    train, _ = load_split(room)
    xyz = np.concatenate([room.points.xyz[::20], rng.normal(scale=5.0, size=(50, 3))])
    assert np.allclose(near_depths(xyz, train), _literal(xyz, train), rtol=1e-5)


def test_the_nearest_view_that_sees_a_point_counts():
    views = [_view([0, 0, 0]), _view([0, 0, 2.0]), _view([30.0, 0, 3.9])]
    xyz = np.array([[0, 0, 4.0], [0, 0, 1.0], [0, 0, -5.0]])
    # The third point is behind all cameras: the median of the others.
    assert near_depths(xyz, views).tolist() == [2.0, 1.0, 1.5]


def test_what_no_view_sees_at_all_is_one_extent_away():
    assert near_depths(np.array([[0, 0, -1.0]]), [_view([0, 0, 0])]).tolist() == [1.0]


def test_many_views_are_sampled_evenly(monkeypatch):
    views = [_view([0, 0, -0.01 * i]) for i in range(1000)]
    one = np.array([[0, 0, 1.0]])
    assert near_depths(one, views[::-1])[0] == pytest.approx(1.0)
    monkeypatch.setattr("splatseed.train.seeds.MOST_PROJECTIONS", 1)
    assert near_depths(one, views)[0] == pytest.approx(1.0)  # the first is among those asked
    assert near_depths(one, views[1:] + views[:1])[0] == pytest.approx(1.0)  # and the last


@settings(deadline=None, max_examples=30)
@given(
    shift=st.floats(-100, 100), scale=st.floats(0.1, 10), seed=st.integers(0, 99)
)  # fmt: skip
def test_they_scale_with_the_scene_and_do_not_move_with_it(shift, scale, seed):
    rng = np.random.default_rng(seed)
    xyz, center = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3)), rng.normal(size=3)
    here = near_depths(xyz, [_view([0, 0, 0]), _view(center)])
    there = near_depths(
        scale * xyz + shift, [_view([shift] * 3), _view(scale * center + shift)]
    )  # fmt: skip
    assert np.allclose(there, scale * here, rtol=1e-3)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_whatever_adds_or_moves_gaussians_hands_them_on(begin, strategy):
    run = begin(strategy=strategy, max_steps=60, cap_max=3000)
    first = set(run.state.params["near_depths"].tolist())
    count = len(run.state.params["means"])
    run.train()
    lengths = run.state.params["near_depths"]
    assert len(lengths) == len(run.state.params["means"]) > count
    assert set(lengths.tolist()) <= first
    assert not lengths.requires_grad


def test_3dgs_conventions_have_one_yardstick_for_all(begin):
    run = begin(strategy="default-3dgs", max_steps=60, cap_max=3000)
    count = len(run.state.params["means"])
    run.train()
    assert length_units(run.state.params).tolist() == pytest.approx([1.1])
    assert len(run.state.params["means"]) > count


def test_steps_of_positions_are_in_near_depths(room):
    """Adam's first step is the learning rate, whatever the gradient."""
    gaussians = initial_gaussians(room.points)
    lengths = np.linspace(0.1, 9.0, len(gaussians)).astype(np.float32)
    params = make_parameters(gaussians, CPU, lengths)
    optimizers = make_optimizers(params, make_schedule("none", 100, as_3dgs=False))
    for value in params.values():
        value.grad = torch.ones_like(value) if value.requires_grad else None
    optimize(params, optimizers, dict.fromkeys(optimizers, 1e-2))
    moved = gaussians.means - params["means"].detach().numpy()
    assert np.allclose(moved, 1e-2 * lengths[:, None], rtol=1e-3, atol=1e-6)
    changed = gaussians.scales - params["scales"].detach().numpy()
    assert np.allclose(changed, 1e-2, rtol=1e-3)


def test_small_steps_of_far_positions_are_not_lost(room):
    """At the end of a full run a step is far below the last digit of a far position's own."""
    rate, far = 1.6e-6, 100.0
    gaussians = initial_gaussians(room.points)
    away = dataclasses.replace(gaussians, means=np.full_like(gaussians.means, far))
    params = make_parameters(away, CPU, np.full(len(away), far, np.float32))
    optimizers = make_optimizers(params, make_schedule("none", 100, as_3dgs=False))
    for _ in range(50):
        for value in params.values():
            value.grad = torch.ones_like(value) if value.requires_grad else None
        optimize(params, optimizers, dict.fromkeys(optimizers, rate))
    moved = far - params["means"].detach().double()
    assert float(moved.mean()) == pytest.approx(50 * rate * far, rel=0.05)


def test_a_views_size_matters_and_not_its_pixels(room):
    train, _ = load_split(room)
    half = [
        dataclasses.replace(
            v, width=v.width // 2, height=v.height // 2, K=np.diag([0.5, 0.5, 1]) @ v.K
        )
        for v in train
    ]
    assert np.array_equal(near_depths(room.points.xyz, train), near_depths(room.points.xyz, half))
