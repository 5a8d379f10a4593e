"""Strategy grow: what Gaussians paint, what goes, what is split, and the budget."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from splatseed.camera import Camera
from splatseed.photos.view import View
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.rendering import render_features
from splatseed.training.parameters import make_optimizers, make_parameters
from splatseed.training.settings import TrainSettings
from splatseed.training.state import make_strategy
from splatseed.training.strategies.candidates import draw_candidates, join_candidates
from splatseed.training.strategies.grow import GROWTH, contributions

SIDE = 32


@pytest.fixture
def view():
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    pixels = np.zeros((SIDE, SIDE, 3), np.uint8)
    return View("a.png", pixels, Camera(matrix, SIDE, SIDE, np.eye(4)))


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


def grow(params, view, truth, budget, steps=range(101), depth=None):
    """A run's rounds on one view, with nothing learnt; the first round ends at step 100."""
    asked = TrainSettings(strategy="grow", max_steps=1500, cap_max=budget)
    strategy = make_strategy(asked, depths={} if depth is None else {view.name: depth})
    optimizers = make_optimizers(params, asked.schedule)
    torch.manual_seed(0)
    grey = torch.full((SIDE, SIDE, 3), 0.5)
    for step in steps:
        strategy.observe(params, view, grey, truth, step)
        strategy.after_step(params, optimizers, step, {})
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


@pytest.mark.parametrize("opacity", [0.9, 1 - 1e-9])  # the sigmoid of the second's logit is 1
def test_the_gaussian_in_wrong_pixels_is_split(view, opacity):
    params = planted(row(4), [0.06] * 4, opacity)
    truth = torch.full((SIDE, SIDE, 3), 0.5)
    truth[:, : SIDE // 4] = 1.0  # where the first one is
    grow(params, view, truth, budget=8)
    near_first = params["means"].detach()[:, 0] < -0.6
    assert len(params["means"]) == 5
    assert int(near_first.sum()) == 2
    assert params["opacities"].isfinite().all()


def test_nothing_is_split_where_nothing_is_wrong(view):
    params = planted(row(4), [0.06] * 4)
    grow(params, view, torch.full((SIDE, SIDE, 3), 0.5), budget=100)
    assert len(params["means"]) == 4


def test_the_faint_and_the_hidden_go(view):
    """What is large stays: a bare wall is best shown by few."""
    wall = [[0.0, 0.0, 1.0]] * 6
    hidden, faint, large = [0.0, 0.0, 3.0], [0.9, 0.9, 2.0], [-0.9, -0.9, 2.0]
    params = planted(
        [*wall, *row(3), hidden, faint, large],
        [*[0.04] * 6, *[0.06] * 3, 0.01, 0.05, 0.5],
        [*[0.99] * 6, *[0.9] * 3, 0.9, 0.004, 0.9],
    )
    grow(params, view, torch.full((SIDE, SIDE, 3), 0.5), budget=100)
    depths = params["means"].detach()[:, 2]
    assert int((depths == 3.0).sum()) == 0
    assert torch.sigmoid(params["opacities"].detach()).min() > 0.005
    assert int((torch.exp(params["scales"].detach()).amax(dim=-1) > 0.4).sum()) == 1


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


def test_a_budget_that_growth_filled_is_not_spent_again(view):
    means = []
    for last in (601, 701):  # the budget is full at step 600
        params = planted(row(12), [0.06] * 12)
        grow(params, view, torch.ones((SIDE, SIDE, 3)), budget=15, steps=range(last))
        means.append(params["means"].detach())
    assert len(means[0]) == 15
    torch.testing.assert_close(*means)


@settings(deadline=None, max_examples=30)
@given(count=st.integers(2, 12), budget=st.integers(2, 40))
def test_the_budget_is_never_exceeded(count, budget):
    matrix = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    image = np.zeros((SIDE, SIDE, 3), np.uint8)
    view = View("a.png", image, Camera(matrix, SIDE, SIDE, np.eye(4)))
    params = planted(row(count), [0.06] * count)
    rounds = [step for end in range(100, 800, 100) for step in (end - 4, end - 2, end)]
    grow(params, view, torch.ones((SIDE, SIDE, 3)), budget, rounds)
    assert len(params["means"]) <= max(count, budget)


def wrong_on_the_left(value=1.0):
    truth = torch.full((SIDE, SIDE, 3), 0.5)
    truth[:, : SIDE // 4] = value
    return truth


def test_most_of_what_is_added_goes_to_wrong_pixels_at_their_depth(view):
    """Depth is a wall at 3, behind the Gaussians at 2; what is added there is white, as it is."""
    params = planted(row(12), [0.06] * 12)
    before = {tuple(mean.tolist()) for mean in params["means"].detach()}
    grow(params, view, wrong_on_the_left(), budget=100, depth=torch.full((8, 8), 3.0))
    means = params["means"].detach()
    placed = (means[:, 2] - 3.0).abs() < 1e-4
    added = len(means) - len(before)
    assert added >= 4
    assert int(placed.sum()) == round(GROWTH.placed * added)
    u = SIDE * means[placed, 0] / 3.0 + SIDE / 2
    assert u.max() < SIDE // 4
    colors = 0.5 + SH_C0 * params["sh0"].detach()[placed, 0]
    torch.testing.assert_close(colors, torch.ones_like(colors))
    sizes = torch.exp(params["scales"].detach())[placed]
    torch.testing.assert_close(sizes, torch.full_like(sizes, 3.0 / SIDE))  # a pixel, at depth 3
    torch.testing.assert_close(params["min_view_depth"].detach()[placed], means[placed, 2])


def test_nothing_is_placed_where_the_depth_is_unknown(view):
    depth = torch.zeros((SIDE, SIDE))
    depth[:, SIDE // 2 :] = 3.0  # where nothing is wrong
    params = planted(row(12), [0.06] * 12)
    grow(params, view, wrong_on_the_left(), budget=100, depth=depth)
    assert len(params["means"]) > 12
    assert params["means"].detach()[:, 2].max() < 2.5


@settings(deadline=None)
@given(
    height=st.integers(1, 9), width=st.integers(1, 9), count=st.integers(1, 50),
    seed=st.integers(0, 9),
)  # fmt: skip
def test_candidates_lie_on_wrong_pixels_of_known_depth(height, width, count, seed):
    """Where they fall in the picture is found by projecting them, turned camera and all."""
    rng = np.random.default_rng(seed)
    matrix = np.array([[7.0, 0, width / 3], [0, 5.0, height / 3], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.random(random_state=seed).as_matrix(), rng.normal(size=3)
    view = View("a", np.zeros((height, width, 3), np.uint8), Camera(matrix, width, height, pose))
    error = torch.as_tensor(rng.choice([0.0, 0.3, 1.0], (height, width)))
    depth = torch.as_tensor(rng.choice([0.0, 1.0, 2.5], (height, width)).astype(np.float32))
    photograph = torch.as_tensor(rng.random((height, width, 3)).astype(np.float32))
    torch.manual_seed(seed)
    drawn = join_candidates([draw_candidates(view, depth, error, photograph, count)])
    assert len(drawn["depths"]) <= count
    assert (len(drawn["depths"]) > 0) == bool(((error > 0) & (depth > 0)).any())
    x, y, z = pose[:3, :3] @ drawn["means"].double().numpy().T + pose[:3, 3:]
    columns = np.floor(matrix[0, 0] * x / z + matrix[0, 2]).astype(int)
    rows = np.floor(matrix[1, 1] * y / z + matrix[1, 2]).astype(int)
    assert (error[rows, columns] > 0).all()
    np.testing.assert_allclose(depth[rows, columns], z, rtol=1e-4)
    np.testing.assert_array_equal(photograph[rows, columns], drawn["colors"])
    assert len(set(zip(rows, columns, strict=True))) == len(rows)


def test_more_wrong_pixels_are_drawn_more_often(view):
    error = torch.zeros((SIDE, SIDE))
    error[0, :10], error[1, :10] = 0.1, 1.0
    torch.manual_seed(0)
    rows = [
        draw_candidates(view, torch.ones((1, 1)), error, torch.zeros((SIDE, SIDE, 3)), 1)["means"]
        for _ in range(200)
    ]
    lower = torch.cat(rows)[:, 1] > (1 - SIDE / 2) / SIDE
    assert 0.9 < float(lower.double().mean()) < 1.0  # 1 in 101 is of the upper row
