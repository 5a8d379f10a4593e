"""The photometric cost of a plane, against its formula as loops."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.stereo.cost import (
    NOISE,
    SAMPLES,
    UNSEEN,
    best_cost,
    make_quads,
    prepare_window,
)
from splatseed.runtime.simd import LANES

from .references import OFFSETS, best_of, bilinear, cost_in, window_weights

SIZE = (40, 30)
IDENTITY = np.hstack([np.eye(3), np.zeros((3, 1))])


def window(image: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Weights and normalised samples of windows, float32 [2, SAMPLES, 16]."""
    out = np.zeros((2, SAMPLES * LANES), np.float32)
    height, width = image.shape
    prepare_window(make_quads(image).ravel(), width, height, places[0], places[1], out[0], out[1])
    return out


def costs(image, others, warps, places, planes) -> np.ndarray:
    """``best_cost`` at sixteen places, from plain images."""
    ready, out = window(image, places), np.full(LANES, -1.0, np.float32)
    sources = np.concatenate([make_quads(other).ravel() for other in others])
    sizes = np.array([other.shape[::-1] for other in others], np.int64)
    offsets = np.cumsum([0, *(other.size for other in others)])
    packed = np.array([[*warp[:, :3].ravel(), *warp[:, 3]] for warp in warps], np.float32)
    best_cost(
        sources, sizes, offsets, packed, places[0], places[1],
        planes.astype(np.float32).ravel(), ready[0], ready[1], out,
    )  # fmt: skip
    return out


@pytest.fixture
def places(rng) -> np.ndarray:
    """Sixteen pixels, some so near the border that their windows reach over it."""
    return np.stack([rng.uniform(0, side, LANES) for side in SIZE]).astype(np.float32)


@pytest.fixture
def planes(rng) -> np.ndarray:
    """Sixteen planes, w0, gx, gy: [3, 16]."""
    w = rng.uniform(0.3, 1.0, LANES)
    return np.stack([w, *(rng.normal(scale=0.01, size=(2, LANES)) * w)])


def make_warps(rng, num: int) -> list[np.ndarray]:
    """Cameras turned and moved a little: (A | b) each."""
    turned = np.eye(3) + rng.normal(
        scale=[[0.02, 0.02, 0.5]] * 2 + [[1e-4, 1e-4, 0.02]], size=(num, 3, 3)
    )
    moved = rng.normal(scale=[4.0, 4.0, 0.05], size=(num, 3))
    return list(np.concatenate([turned, moved[:, :, None]], axis=2))


def test_weights_and_normalised_samples_are_those_of_the_formula(rough, places):
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
def test_cost_is_that_of_the_formula(num, rough, rng, places, planes):
    image, others = rough(*SIZE[::-1]), [rough(25 + 3 * i, 45 - 2 * i) for i in range(num)]
    warps = make_warps(rng, num)
    ours = costs(image, others, warps, places, planes)
    for lane, (u, v) in enumerate(places.T.astype(float)):
        each = [
            cost_in(image, other, warp, u, v, planes[:, lane])
            for other, warp in zip(others, warps, strict=True)
        ]
        assert ours[lane] == pytest.approx(best_of(each), abs=2e-3)
    assert np.ptp(ours) > 0.1  # the loop above compared different things


def test_the_negative_costs_most(rough, places, planes):
    image = rough(*SIZE[::-1])
    assert costs(image, [255 - image], [IDENTITY], places, planes).min() > 1.9


@pytest.mark.parametrize("level", [0, 128, 255])
def test_without_texture_nothing_is_like_anything(level, rough, places, planes):
    image, grey = rough(*SIZE[::-1]), np.full(SIZE[::-1], level, np.uint8)
    for first, second in [(image, grey), (grey, image), (grey, grey)]:
        ours = costs(first, [second], [IDENTITY], places, planes)
        np.testing.assert_allclose(ours, 1.0, atol=5e-3)


def test_a_view_that_does_not_hold_the_point_says_nothing(rough, places, planes):
    image = rough(*SIZE[::-1])
    behind = np.hstack([-np.eye(3), np.zeros((3, 1))])
    beside = IDENTITY + np.array([[0, 0, 500.0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    at_camera = np.zeros((3, 4))
    for warp in (behind, beside, at_camera):
        assert (costs(image, [image], [warp], places, planes) == UNSEEN).all()
    ours = costs(image, [image, image, image], [behind, IDENTITY, IDENTITY], places, planes)
    assert ours.max() < 0.02  # the best two count
