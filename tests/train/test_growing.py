"""Strategy grow: what Gaussians paint, what goes, what is split, and the budget."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st

from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import render_features
from splatseed.train.parameters import make_optimizers, make_parameters
from splatseed.train.settings import TrainSettings
from splatseed.train.strategies import make_strategy
from splatseed.train.strategies.contributions import contributions
from splatseed.views.view import View

SIDE = 32


@pytest.fixture
def view():
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    pixels = np.zeros((SIDE, SIDE, 3), np.uint8)
    return View(
        name="a.png", K=matrix, cam_from_world=np.eye(4), width=SIDE, height=SIDE, image=pixels
    )


def planted(xyz, sizes, opacities=0.9):
    """Grey balls, with near depths of 1."""
    count = len(xyz)
    opacities = np.broadcast_to(np.float64(opacities), count)
    gaussians = Gaussians(
        means=np.asarray(xyz, np.float32),
        scales=np.log(np.repeat(np.asarray(sizes, np.float32)[:, None], 3, axis=1)),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1)),
        opacities=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh0=np.zeros((count, 1, 3), np.float32),
        shN=np.zeros((count, 15, 3), np.float32),
    )
    return make_parameters(gaussians, torch.device("cpu"), np.ones(count, np.float32))


def row(count, depth=2.0):
    """Places side by side in the picture."""
    return [[x, 0.0, depth] for x in np.linspace(-0.8, 0.8, count)]


def grow(params, view, truth, budget, steps=range(101)):
    """A run's rounds on one view, with nothing learnt; the first round ends at step 100."""
    asked = TrainSettings(strategy="grow", max_steps=1500, cap_max=budget)
    strategy = make_strategy(asked)
    optimizers = make_optimizers(params, asked.schedule)
    torch.manual_seed(0)
    grey = torch.full((SIDE, SIDE, 3), 0.5)
    for step in steps:
        strategy.observe(params, view, grey, truth, step)
        strategy.after(params, optimizers, step, {})
    return strategy


def test_contributions_are_sums_of_blending_weights(view):
    """Against weights found one Gaussian at a time: what it alone adds to the picture."""
    params = planted([*row(4), [0.0, 0.1, 4.0]], [0.05, 0.1, 0.2, 0.02, 0.5], 0.6)
    error = torch.rand((SIDE, SIDE), generator=torch.Generator().manual_seed(0))
    pixels, errors = contributions(params, view, error)
    for i in range(5):
        weights = render_features(params, view, torch.eye(5)[:, i : i + 1].contiguous())[..., 0]
        torch.testing.assert_close(pixels[i], weights.sum(), rtol=1e-4, atol=1e-4)
        torch.testing.assert_close(errors[i], (weights * error).sum(), rtol=1e-4, atol=1e-4)
    assert all(value.grad is None for value in params.values())


def test_the_gaussian_in_wrong_pixels_is_split(view):
    params = planted(row(4), [0.06] * 4)
    truth = torch.full((SIDE, SIDE, 3), 0.5)
    truth[:, : SIDE // 4] = 1.0  # where the first one is
    grow(params, view, truth, budget=8)
    near_first = params["means"].detach()[:, 0] < -0.6
    assert len(params["means"]) == 5
    assert int(near_first.sum()) == 2


def test_nothing_is_split_where_nothing_is_wrong(view):
    params = planted(row(4), [0.06] * 4)
    grow(params, view, torch.full((SIDE, SIDE, 3), 0.5), budget=100)
    assert len(params["means"]) == 4


def test_the_faint_the_large_and_the_hidden_go(view):
    wall = [[0.0, 0.0, 1.0]] * 6
    hidden, faint, large = [0.0, 0.0, 3.0], [0.9, 0.9, 2.0], [-0.9, -0.9, 2.0]
    params = planted(
        [*wall, *row(3), hidden, faint, large],
        [*[0.04] * 6, *[0.06] * 3, 0.01, 0.05, 0.2],
        [*[0.99] * 6, *[0.9] * 3, 0.9, 0.004, 0.9],
    )
    grow(params, view, torch.full((SIDE, SIDE, 3), 0.5), budget=100)
    depths = params["means"].detach()[:, 2]
    assert int((depths == 3.0).sum()) == 0
    assert torch.exp(params["scales"].detach()).max() < 0.1
    assert torch.sigmoid(params["opacities"].detach()).min() > 0.005


def test_what_no_view_shows_is_not_taken_away_for_painting_nothing(view):
    params = planted([*row(4), [0.0, 0.0, -2.0]], [0.06] * 5)
    grow(params, view, torch.ones((SIDE, SIDE, 3)), budget=5)
    assert -2.0 in params["means"].detach()[:, 2]


def test_a_full_budget_is_spent_again(view):
    """Of 20, the two that paint least make way for halves of two that paint what is wrong."""
    sizes = np.full(20, 0.03)
    sizes[:2] = 0.015
    params = planted(row(20), sizes)
    truth = torch.full((SIDE, SIDE, 3), 0.5)
    truth[:, SIDE // 2 :] = 1.0
    grow(params, view, truth, budget=20)
    across = params["means"].detach()[:, 0]
    assert len(across) == 20
    assert across.min() > -0.8 + 1e-3
    assert int((across > 0).sum()) == 12


@settings(deadline=None)
@given(count=st.integers(2, 12), budget=st.integers(2, 40))
def test_the_budget_is_never_exceeded(count, budget):
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    view = View(
        name="a.png", K=matrix, cam_from_world=np.eye(4), width=SIDE, height=SIDE, image=image
    )
    params = planted(row(count), [0.06] * count)
    rounds = [step for end in range(100, 800, 100) for step in (end - 4, end - 2, end)]
    grow(params, view, torch.ones((SIDE, SIDE, 3)), budget, rounds)
    assert len(params["means"]) <= max(count, budget)
