"""Noise must be a fixed, smooth function of the position."""

from __future__ import annotations

import numpy as np

from splatseed.synthetic.texture import Mottled, Tiles, value_noise

GRAIN = Mottled(((0.5,) * 3, (1.5,) * 3), (9.0, 9.0, 9.0), octaves=2)


def test_noise_is_bounded_smooth_and_differs_by_seed(rng):
    xyz = rng.uniform(-20, 20, (5000, 3))
    noise = value_noise(xyz, 3, seed=1)
    assert noise.min() >= 0
    assert noise.max() <= 1
    assert noise.std() > 0.05
    step = np.abs(value_noise(xyz + 1e-6, 3, seed=1) - noise)
    assert step.max() < 1e-4
    assert np.abs(value_noise(xyz, 3, seed=2) - noise).max() > 0.2


def test_a_tile_has_one_colour_without_its_grain():
    flat = Mottled(((1.0,) * 3, (1.0,) * 3), (1, 1, 1), octaves=1)
    tiles = Tiles(((0.1, 0.2, 0.3), (0.9, 0.8, 0.7)), (1.0, 1.0, 1.0), flat)
    # Cells start 0.37 of a cell before the integers.
    same = tiles(np.array([[0.0, 0.0, 0.0], [0.6, 0.6, 0.6], [1.0, 0.0, 0.0]]))
    np.testing.assert_array_equal(same[0], same[1])
    assert np.abs(same[0] - same[2]).max() > 1e-3
