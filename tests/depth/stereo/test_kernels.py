"""Stereo's kernels (quads, costs, PatchMatch, confirmation) against their formulas as loops."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from splatseed.depth.stereo._kernels.agreement import confirm
from splatseed.depth.stereo._kernels.cost import (
    NOISE,
    SAMPLES,
    UNSEEN_COST,
    best_cost,
    prepare_window,
    sample,
)
from splatseed.depth.stereo._kernels.patchmatch import (
    MAX_SLOPE,
    QuadImages,
    initialise,
    red_black_sweep,
)
from splatseed.depth.stereo.matching import grey_image, make_quads
from splatseed.runtime.simd import LANES, load, store

from .references import OFFSETS, agrees, best_of, bilinear, cost_in, window_weights

SIZE = (40, 30)
IDENTITY = np.hstack([np.eye(3), np.zeros((3, 1))])
BEHIND = np.hstack([-np.eye(3), np.zeros((3, 1))])


@pytest.fixture
def rough(rng):
    """Makes grey images of noise, a few pixels wide, so that interpolation has something to do."""

    def make(height, width):
        image = rng.uniform(0, 255, (height, width))
        for axis in (0, 1):
            image = (np.roll(image, 1, axis) + 2 * image + np.roll(image, -1, axis)) / 4
        return image.astype(np.uint8)

    return make


# Grey images, and what lies between their pixels --------------------------------------------------


@njit
def _sample(quads, width, height, columns, rows, out):
    store(out, 0, sample(quads, width, height, load(columns, 0), load(rows, 0)))


def sampled(image, columns, rows):
    out = np.full(LANES, -1.0, np.float32)
    places = [np.resize(np.float32(each), LANES) for each in (columns, rows)]
    _sample(make_quads(image).ravel(), *image.shape[::-1], *places, out)
    return out


@pytest.mark.parametrize("shape", [(7, 9), (1, 5), (6, 1), (1, 1)])
def test_sampling_interpolates_and_clamps_at_the_border(shape, rough, rng):
    image = rough(*shape)
    for _ in range(20):
        columns = rng.uniform(-3, shape[1] + 2, LANES).astype(np.float32)
        rows = rng.uniform(-3, shape[0] + 2, LANES).astype(np.float32)
        expected = [bilinear(image, x, y) for x, y in zip(columns, rows, strict=True)]
        np.testing.assert_allclose(sampled(image, columns, rows), expected, atol=1e-3)
    odd = [np.nan, np.inf, -np.inf, 3e38, -3e38]  # places that are no numbers read some pixel
    expected = [image[0, 0], image[0, -1], image[0, 0], image[0, -1], image[0, 0]]
    np.testing.assert_array_equal(sampled(image, odd, [0.0])[: len(odd)], expected)


def test_grey_is_the_luma_of_the_colours(rng):
    image = rng.integers(0, 256, (8, 5, 3), dtype=np.uint8)
    expected = np.rint(image.astype(float) @ [0.299, 0.587, 0.114])
    assert np.abs(grey_image(image) - expected).max() <= 1  # where rounding is a toss-up
    flat = np.arange(256, dtype=np.uint8)[None, :, None].repeat(3, axis=2)
    np.testing.assert_array_equal(grey_image(flat)[0], np.arange(256))


# The photometric cost of a plane ------------------------------------------------------------------


def window(image, places):
    """Weights and normalised samples of windows, float32 [2, SAMPLES, 16]."""
    out = np.zeros((2, SAMPLES * LANES), np.float32)
    prepare_window(make_quads(image).ravel(), *image.shape[::-1], *places, *out)
    return out


def packed(warps):
    return np.array([[*warp[:, :3].ravel(), *warp[:, 3]] for warp in warps], np.float32)


def costs_of(image, others, warps, places, planes):
    """``best_cost`` at sixteen places, from plain images."""
    out = np.full(LANES, -1.0, np.float32)
    sources = np.concatenate([make_quads(other).ravel() for other in others])
    sizes = np.array([other.shape[::-1] for other in others], np.int64)
    offsets = np.cumsum([0, *(other.size for other in others)])
    best_cost(
        sources, sizes, offsets, packed(warps), *places, planes.astype(np.float32).ravel(),
        *window(image, places), out,
    )  # fmt: skip
    return out


@pytest.fixture
def places(rng):
    """Sixteen pixels, some so near the border that their windows reach over it."""
    return np.stack([rng.uniform(0, side, LANES) for side in SIZE]).astype(np.float32)


@pytest.fixture
def planes(rng):
    """Sixteen planes, w0, gx, gy: [3, 16]."""
    w = rng.uniform(0.3, 1.0, LANES)
    return np.stack([w, *(rng.normal(scale=0.01, size=(2, LANES)) * w)])


def make_warps(rng, num):
    """Cameras turned and moved a little: (A | b) each."""
    turned = np.eye(3) + rng.normal(
        scale=[[0.02, 0.02, 0.5]] * 2 + [[1e-4, 1e-4, 0.02]], size=(num, 3, 3)
    )
    moved = rng.normal(scale=[4.0, 4.0, 0.05], size=(num, 3))
    return list(np.concatenate([turned, moved[:, :, None]], axis=2))


def test_weights_and_normalised_samples_equal_the_formula(rough, places):
    image = rough(*SIZE[::-1])
    weights, samples = window(image, places).reshape(2, SAMPLES, LANES)
    for lane, (u, v) in enumerate(places.T.astype(float)):
        c = window_weights(image, u, v)
        np.testing.assert_allclose(weights[:, lane], c, rtol=1e-3)
        r = np.array([bilinear(image, u + dx - 0.5, v + dy - 0.5) for dx, dy in OFFSETS])
        apart = r - c @ r
        expected = c * apart / np.sqrt(c @ apart**2 + NOISE)
        np.testing.assert_allclose(samples[:, lane], expected, atol=2e-4)


@pytest.mark.parametrize("num", [1, 2, 5])
def test_cost_equals_the_formula(num, rough, rng, places, planes):
    image, others = rough(*SIZE[::-1]), [rough(25 + 3 * i, 45 - 2 * i) for i in range(num)]
    warps = make_warps(rng, num)
    ours = costs_of(image, others, warps, places, planes)
    for lane, (u, v) in enumerate(places.T.astype(float)):
        each = [
            cost_in(image, other, warp, u, v, planes[:, lane])
            for other, warp in zip(others, warps, strict=True)
        ]
        assert ours[lane] == pytest.approx(best_of(each), abs=2e-3)
    assert np.ptp(ours) > 0.1  # the loop above compared different things


def test_the_negative_costs_most_and_grey_costs_one(rough, places, planes):
    image = rough(*SIZE[::-1])
    assert costs_of(image, [255 - image], [IDENTITY], places, planes).min() > 1.9
    for level in (0, 128, 255):
        grey = np.full(SIZE[::-1], level, np.uint8)
        for first, second in [(image, grey), (grey, image), (grey, grey)]:
            ours = costs_of(first, [second], [IDENTITY], places, planes)
            np.testing.assert_allclose(ours, 1.0, atol=5e-3)


def test_a_view_without_the_point_has_the_unseen_cost(rough, places, planes):
    image = rough(*SIZE[::-1])
    beside = IDENTITY + np.array([[0, 0, 500.0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    for warp in (BEHIND, beside, np.zeros((3, 4))):
        assert (costs_of(image, [image], [warp], places, planes) == UNSEEN_COST).all()
    ours = costs_of(image, [image] * 3, [BEHIND, IDENTITY, IDENTITY], places, planes)
    assert ours.max() < 0.02  # the best two count


# PatchMatch: what it may and may not do to planes -------------------------------------------------

GRID, ROWS, COLUMNS = 3, 9, 37
BOUNDS = np.array([0.2, 0.5], np.float32)
FOCAL = 60.0
KEY = np.uint64(12345)
WARPS = [np.hstack([np.eye(3), [[side * 20.0], [0.0], [0.0]]]) for side in (-1, 1)]
"""Sources to the left and to the right."""


@pytest.fixture
def images(rough):
    return [rough(ROWS * GRID + 1, COLUMNS * GRID + 2) for _ in range(3)]


@pytest.fixture
def quad_images(images):
    size = np.array(images[0].shape[::-1], np.int64)
    quads = [make_quads(image).ravel() for image in images]
    return QuadImages(
        quads[0], size, np.concatenate(quads[1:]), np.stack([size, size]),
        np.cumsum([0, *map(len, quads[1:])]), packed(WARPS), GRID, FOCAL, BOUNDS,
    )  # fmt: skip


@pytest.fixture
def state(quad_images, rng):
    """Planes drawn between the bounds, and their costs."""
    guesses = np.zeros((2, 3, ROWS, COLUMNS), np.float32)
    guesses[:, 0] = rng.uniform(*BOUNDS, (2, ROWS, COLUMNS))
    planes, costs = np.zeros(guesses.shape[1:], np.float32), np.empty((ROWS, COLUMNS), np.float32)
    initialise(quad_images, guesses, planes, costs)
    return guesses, planes, costs


def cost_at(images, planes, row, column):
    u, v = (column + 0.5) * GRID, (row + 0.5) * GRID
    plane = planes[:, row, column].astype(float)
    pairs = zip(images[1:], WARPS, strict=True)
    return best_of([cost_in(images[0], image, warp, u, v, plane) for image, warp in pairs])


def test_initialise_takes_the_cheapest_plane(images, state):
    guesses, planes, costs = state
    for row, column in [(0, 0), (ROWS - 1, COLUMNS - 1), (4, 16), (5, 17)]:
        each = [cost_at(images, guess, row, column) for guess in guesses]
        assert costs[row, column] == pytest.approx(min(each), abs=2e-3)
        assert planes[0, row, column] in guesses[:, 0, row, column]


def test_sweeps_lower_costs_within_the_bounds(images, quad_images, state):
    _, planes, costs = state
    before = costs.copy()
    for number in range(2):
        for color in range(2):
            red_black_sweep(quad_images, color, number, KEY, planes, costs)
    assert (costs <= before).all()
    assert costs.mean() < 0.9 * before.mean()
    w, slope = planes[0], np.hypot(planes[1], planes[2])
    assert ((w >= BOUNDS[0]) & (w <= BOUNDS[1])).all()
    assert (slope <= MAX_SLOPE * w / FOCAL * (1 + 1e-6)).all()
    for row, column in [(0, 0), (ROWS - 1, COLUMNS - 1), (3, 8), (8, 30)]:
        assert costs[row, column] == pytest.approx(cost_at(images, planes, row, column), abs=2e-3)


@pytest.mark.parametrize("color", [0, 1])
def test_a_half_sweep_changes_one_colour_and_depends_on_its_key(color, quad_images, state):
    _, before, costs = state
    runs = []
    for key in (KEY, KEY, np.uint64(7)):
        runs.append(before.copy())
        red_black_sweep(quad_images, color, 0, key, runs[-1], costs.copy())
    changed = (runs[0] != before).any(axis=0)
    visited = np.indices(costs.shape).sum(axis=0) % 2 == color
    assert not changed[~visited].any()
    assert changed[visited].mean() > 0.5
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (runs[0] != runs[2]).any()


# Which views confirm a depth ----------------------------------------------------------------------

TOLERANCE, MAX_COST = 0.05, 0.5


def make_map(rng, rows, columns):
    """Planes about depth 2 and costs, a fifth of them too high."""
    planes = [rng.uniform(0.48, 0.52, (rows, columns)), *rng.normal(0, 1e-3, (2, rows, columns))]
    costs = np.where(rng.random((rows, columns)) < 0.2, 0.9, 0.1)
    return np.float32(planes), costs.astype(np.float32)


@pytest.mark.parametrize(
    "warp",
    [
        np.hstack([np.eye(3), [[12.0], [-7.0], [0.02]]]),
        np.array([[0.9, 0.3, 2.0, 1.0], [-0.3, 0.9, 9.0, 3.0], [0.002, 0.001, 1.0, -0.03]]),
        BEHIND,
    ],
    ids=["moved", "turned", "behind"],
)
def test_confirmation_equals_a_loop(warp, rng):
    (planes, costs), (other, other_costs) = make_map(rng, 12, 15), make_map(rng, 10, 17)
    bit, out = np.uint8(4), np.ones(costs.shape, np.uint8)  # an earlier witness has said something
    confirm(planes, costs, MAX_COST, 4, warp, other, other_costs, TOLERANCE, bit, out)
    assert (out & 1).all()
    bits = (out & bit) != 0
    usable = np.where(other_costs > MAX_COST, np.nan, other)
    for row, column in np.ndindex(costs.shape):
        off = agrees(planes, 4, row, column, warp, usable)
        if abs(off - TOLERANCE) > 1e-5:
            expected = costs[row, column] <= MAX_COST and off <= TOLERANCE
            assert bits[row, column] == expected
    if warp is not BEHIND:
        assert 0.2 < bits.mean() < 0.9
