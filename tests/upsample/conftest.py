"""Clouds on which the methods are tested."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed import PointCloud

from .references import Cloud


def wavy_cloud(num, seed=0, noise=0.01):
    """A noisy sheet z = f(x, y) about 2 wide, with irregular spacing and a few outliers."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-1.0, 1.0, (2, num))
    z = 0.2 * np.sin(3.0 * x) * np.cos(2.0 * y) + noise * rng.normal(size=num)
    z[:: max(num // 4, 1)] += 1.5
    xyz = np.stack([x, y, z], axis=1).astype(np.float32)
    return PointCloud(xyz, rng.integers(0, 256, (num, 3), np.uint8))


@pytest.fixture(scope="session")
def wavy():
    """160 points."""
    return wavy_cloud(160)


@pytest.fixture(scope="session")
def wavy_exact(wavy):
    """The same in float64, as the references take them."""
    return Cloud(wavy.xyz.astype(np.float64), wavy.rgb.astype(np.float64))
