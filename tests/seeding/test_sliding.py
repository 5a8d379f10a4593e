"""The slide to where photographs agree, against the search and its cost as literal loops."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.depth.stereo._kernels.patchmatch import QuadImages
from splatseed.depth.stereo.quads import make_quads
from splatseed.seeding._kernels.verify import FLOOR, MAX_MOVE, OFFSETS, REFINEMENTS, slide
from splatseed.seeding.verify import SETTINGS

from ..depth.stereo.references import OFFSETS as WINDOW, best_of, bilinear, cost_in, window_weights

HEIGHT, WIDTH = 34, 46
NUM = 21
"""Points: sixteen lanes, and some more."""


@pytest.fixture
def images(rng):
    """A picture and three others: the same shifted by its planes' parallax, darker, and noise in
    it."""
    wide = rng.uniform(0, 255, (HEIGHT, WIDTH + 40))
    for axis in (0, 1):
        wide = (np.roll(wide, 1, axis) + 2 * wide + np.roll(wide, -1, axis)) / 4
    moved = [wide[:, 20 + shift : 20 + shift + WIDTH] for shift in SHIFTS]
    noisy = [0.7 * each + rng.normal(scale=3, size=each.shape) for each in moved]
    return [each.astype(np.uint8) for each in (wide[:, 20 : 20 + WIDTH], *noisy)]


SHIFTS = (8, -9, 14)
WARPS = [np.hstack([np.eye(3), [[-shift], [0.0], [0.0]]]) for shift in SHIFTS]
"""Cameras to the side: at inverse depth 1 the images lie on each other."""


@pytest.fixture
def points(rng):
    """Pixels, planes and how far a spacing moves them: uv, planes, reach."""
    uv = rng.uniform([2, 2], [WIDTH - 2, HEIGHT - 2], (NUM, 2)).astype(np.float32)
    w = rng.uniform(0.7, 1.3, NUM)
    planes = np.stack([w, *rng.normal(scale=0.005, size=(2, NUM))], axis=1).astype(np.float32)
    return uv, planes, rng.uniform(-0.3, -0.1, NUM).astype(np.float32)


def run(images, uv, planes, reach):
    warps = WARPS[: len(images) - 1]
    quads = [make_quads(image).ravel() for image in images]
    packed = np.array([[*warp[:, :3].ravel(), *warp[:, 3]] for warp in warps], np.float32)
    quad_images = QuadImages(
        quads[0], np.array([WIDTH, HEIGHT], np.int64), np.concatenate(quads[1:]),
        np.array([[WIDTH, HEIGHT]] * len(warps), np.int64),
        np.cumsum([0, *map(len, quads[1:])]), packed, 1, 1.0, np.array([0.0, np.inf], np.float32),
    )  # fmt: skip
    moves, costs, variances = np.full((3, len(uv)), np.nan, np.float32)
    slide(quad_images, uv, planes, reach, moves, costs, variances)
    return moves, costs, variances


def cost_of(images, uv, plane, reach, t):
    """The cost of a point that has moved by t spacings."""
    moved = plane.astype(float) / (1 + t * float(reach))
    u, v = uv.astype(float)
    return best_of(
        [cost_in(images[0], o, w, u, v, moved) for o, w in zip(images[1:], WARPS, strict=False)]
    )


def search(cost):
    """Evenly spaced places, then half steps about the best: the t that wins, and its value."""
    values = {}

    def best(places):
        for t in places:
            values.setdefault(t, (cost(t) + FLOOR) * (1 + t * t))
        return min(values, key=values.__getitem__)

    step = 2 * MAX_MOVE / (OFFSETS - 1)
    t = best([step * (k - OFFSETS // 2) for k in range(OFFSETS)])
    for _ in range(REFINEMENTS):
        step /= 2
        t = best([t - step, t + step])
    return t, values[t]


@pytest.mark.parametrize("num_sources", [1, 3])
def test_the_offset_equals_the_loop(num_sources, images, points):
    images = images[: num_sources + 1]
    moves, costs, _ = run(images, *points)
    same = 0
    for i, (uv, plane, reach) in enumerate(zip(*points, strict=True)):

        def cost(t, at=(uv, plane, reach)):
            return cost_of(images, *at, t)

        t, value = search(cost)
        assert costs[i] == pytest.approx(cost(float(moves[i])), abs=2e-3)
        # Rounding may decide between places that are as good.
        assert (costs[i] + FLOOR) * (1 + moves[i] ** 2) == pytest.approx(value, abs=1e-2)
        same += abs(moves[i] - t) < 1e-6
    assert same >= 0.8 * NUM
    assert np.ptp(moves) > 1.0  # the loop above compared different things


def test_the_variance_equals_the_window(images, points):
    faint = (images[0] // 10).astype(np.uint8)  # about as faint as no texture
    _, _, variances = run([faint, *images[1:]], *points)
    assert variances.min() < SETTINGS.min_variance < variances.max()
    for (u, v), found in zip(points[0].astype(float), variances, strict=True):
        c = window_weights(faint, u, v)
        r = np.array([bilinear(faint, u + dx - 0.5, v + dy - 0.5) for dx, dy in WINDOW])
        assert found == pytest.approx(c @ (r - c @ r) ** 2, rel=0.02)
