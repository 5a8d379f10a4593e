"""What PatchMatch may and may not do to planes, and that its costs are those of the formula."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.stereo.cost import make_quads
from splatseed.depth.stereo.patchmatch import STEEPEST, QuadImages, begin, sweep

from .references import best_of, cost_in

GRID, ROWS, COLUMNS = 3, 9, 37
BOUNDS = np.array([0.2, 0.5], np.float32)
FOCAL = 60.0
KEY = np.uint64(12345)


@pytest.fixture
def images(rough):
    return [rough(ROWS * GRID + 1, COLUMNS * GRID + 2) for _ in range(3)]


@pytest.fixture
def warps():
    """Sources to the left and to the right."""
    move = np.array([[20.0], [0.0], [0.0]])
    return [np.hstack([np.eye(3), side * move]) for side in (-1, 1)]


@pytest.fixture
def quad_images(images, warps) -> QuadImages:
    height, width = images[0].shape
    quads = [make_quads(image).ravel() for image in images]
    packed = np.array([[*warp[:, :3].ravel(), *warp[:, 3]] for warp in warps], np.float32)
    return QuadImages(
        quads[0], np.array([width, height], np.int64), np.concatenate(quads[1:]),
        np.array([[width, height]] * 2, np.int64), np.cumsum([0, *map(len, quads[1:])]), packed,
        GRID, FOCAL, BOUNDS,
    )  # fmt: skip


@pytest.fixture
def state(quad_images, rng):
    """Planes drawn between the bounds, and their costs."""
    guesses = np.zeros((2, 3, ROWS, COLUMNS), np.float32)
    guesses[:, 0] = rng.uniform(*BOUNDS, (2, ROWS, COLUMNS))
    planes, costs = np.zeros(guesses.shape[1:], np.float32), np.empty((ROWS, COLUMNS), np.float32)
    begin(quad_images, guesses, planes, costs)
    return guesses, planes, costs


def cost_at(images, warps, planes, row: int, column: int) -> float:
    u, v = (column + 0.5) * GRID, (row + 0.5) * GRID
    each = [
        cost_in(images[0], image, warp, u, v, planes[:, row, column].astype(float))
        for image, warp in zip(images[1:], warps, strict=True)
    ]
    return best_of(each)


def test_the_best_guess_is_taken(images, warps, state):
    guesses, planes, costs = state
    for row, column in [(0, 0), (ROWS - 1, COLUMNS - 1), (4, 16), (5, 17)]:
        each = [cost_at(images, warps, guess, row, column) for guess in guesses]
        assert costs[row, column] == pytest.approx(min(each), abs=2e-3)
        assert planes[0, row, column] in guesses[:, 0, row, column]


def test_sweeps_lower_costs_and_keep_to_the_bounds(images, warps, quad_images, state):
    _, planes, costs = state
    before = costs.copy()
    for number in range(2):
        for color in range(2):
            sweep(quad_images, color, number, KEY, planes, costs)
    assert (costs <= before).all()
    assert costs.mean() < 0.9 * before.mean()
    w, slope = planes[0], np.hypot(planes[1], planes[2])
    assert ((w >= BOUNDS[0]) & (w <= BOUNDS[1])).all()
    assert (slope <= STEEPEST * w / FOCAL * (1 + 1e-6)).all()
    for row, column in [(0, 0), (ROWS - 1, COLUMNS - 1), (3, 8), (8, 30)]:
        expected = cost_at(images, warps, planes, row, column)
        assert costs[row, column] == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize("color", [0, 1])
def test_a_half_sweep_changes_one_colour_only(color, quad_images, state):
    _, planes, costs = state
    before = planes.copy()
    sweep(quad_images, color, 0, KEY, planes, costs)
    changed = (planes != before).any(axis=0)
    visited = np.indices(costs.shape).sum(axis=0) % 2 == color
    assert not changed[~visited].any()
    assert changed[visited].mean() > 0.5


def test_random_numbers_come_from_the_key(quad_images, state):
    _, planes, costs = state
    runs = []
    for key in (KEY, KEY, np.uint64(7)):
        mine = planes.copy()
        sweep(quad_images, 0, 0, key, mine, costs.copy())
        runs.append(mine)
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()
