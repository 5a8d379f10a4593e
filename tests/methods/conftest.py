"""Clouds on which the methods are tested, and a third party's method."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from splatseed import METHODS, PointCloud

from .contract import Copies
from .references import Cloud


@pytest.fixture
def third_party(monkeypatch):
    """Installs a package that registers the method "copies", and one that wants to be "mls"."""
    entry = {"value": "copies:Copies", "dist": None, "load": lambda: Copies}
    found = [SimpleNamespace(name=name, **entry) for name in ("copies", "mls")]
    monkeypatch.setattr(
        "splatseed.methods.registry.entry_points", lambda *, group: found if group else []
    )
    METHODS.__dict__.pop("_plugins", None)
    yield
    METHODS.__dict__.pop("_plugins", None)


@pytest.fixture(scope="session")
def wavy():
    """160 points of a noisy sheet z = f(x, y) about 2 wide, irregular, with a few outliers."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1.0, 1.0, (2, 160))
    z = 0.2 * np.sin(3.0 * x) * np.cos(2.0 * y) + 0.01 * rng.normal(size=160)
    z[::40] += 1.5
    xyz = np.stack([x, y, z], axis=1).astype(np.float32)
    return PointCloud(xyz, rng.integers(0, 256, (160, 3), np.uint8))


@pytest.fixture(scope="session")
def wavy_exact(wavy):
    """The same in float64, as the references take them."""
    return Cloud(wavy.xyz.astype(np.float64), wavy.rgb.astype(np.float64))
