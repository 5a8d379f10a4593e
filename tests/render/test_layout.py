"""What lies between PyTorch's arrays and blending's: records of Gaussians, and images in blocks."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.kernels.simd import LANES
from splatseed.render import layout
from splatseed.render.binning import RECORD, TILE
from splatseed.render.blending import BLOCKS, CHANNELS


def _records(conics: np.ndarray) -> np.ndarray:
    num = len(conics)
    records = np.full(RECORD * num, np.nan, np.float32)
    zeros = np.zeros((num, 3), np.float32)
    layout.gather(
        np.arange(num, dtype=np.int32), zeros[:, :2].copy(), conics, zeros[:, 0].copy(), zeros, 0,
        records
    )  # fmt: skip
    return records.reshape(num, RECORD)


def test_records_hold_ellipses_and_leave_those_that_are(rng) -> None:
    """Float32 rounds needles to either side; no record may have a negative sigma anywhere."""
    a, c = np.exp(rng.uniform(-20, 2, (2, 3000)))
    b = rng.choice([-1, 1], 3000) * np.sqrt(a * c) * (1 + rng.choice([-1e-3, 0, 1e-7, 1e-3], 3000))
    conics = np.stack([a, b, c], axis=1).astype(np.float32)
    recorded = _records(conics)[:, 2:5].astype(np.float64) * [-16, -8, -16]
    exact = conics.astype(np.float64)
    given, kept = (m[:, 0] * m[:, 2] - m[:, 1] ** 2 for m in (exact, recorded))
    assert (given < 0).sum() > 500
    assert (kept >= 0).all()
    np.testing.assert_array_equal(recorded[given >= 0], exact[given >= 0])
    np.testing.assert_allclose(recorded, exact, rtol=2e-3)


@pytest.mark.parametrize("shape", [(8, 8, 3), (13, 9, 3), (5, 22, 2), (16, 7, 1)])
def test_an_image_goes_to_blocks_and_back(rng, shape) -> None:
    height, width, channels = shape
    columns, rows = -(-width // TILE), -(-height // TILE)
    lanes = columns * rows * TILE**2
    image = rng.normal(size=shape).astype(np.float32)
    ones = np.ones((height, width), np.float32)
    gradient, behind = (np.full(n, np.nan, np.float32) for n in (lanes * CHANNELS, lanes))
    layout.to_blocks(image, image, ones, ones, columns, 0, gradient, behind)
    assert np.isfinite(gradient).all()
    inside = behind != 0
    assert inside.sum() <= height * width
    again, passing = np.empty_like(image), np.empty((height, width), np.float32)
    layout.from_blocks(gradient, behind, columns, np.zeros(channels, np.float32), 0, again, passing)
    np.testing.assert_array_equal(again, image)
    np.testing.assert_allclose(passing, (image**2).sum(axis=2) - 1, rtol=1e-5, atol=1e-5)
    by_block = gradient.reshape(-1, BLOCKS, CHANNELS, LANES)
    assert not by_block[:, :, channels:].any()
