"""Regions, opacities, importance and neighbours choose the right Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.errors import ParameterError
from splatseed.io.regions import parse_region
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.selection import filter_gaussians, isolated, largest, visible_area


def gaussians_at(means, size=0.02, opacity=0.9):
    count = len(means)
    arrays = {
        "means": means,
        "scales": np.log(np.broadcast_to(np.asarray(size)[..., None], (count, 3))),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacities": np.broadcast_to(np.log(opacity / (1 - np.asarray(opacity))), count),
        "sh0": np.zeros((count, 1, 3)),
        "shN": np.zeros((count, 0, 3)),
    }
    return Gaussians(**{name: np.array(each, np.float32) for name, each in arrays.items()})


def test_crop_and_min_opacity_filter_gaussians(rng):
    model = gaussians_at(rng.normal(size=(700, 3)) * 2, opacity=rng.uniform(0.05, 0.95, 700))
    kept = filter_gaussians(model, parse_region("-1,-2,-3,1,2,3"), 0.25)
    inside = (np.abs(model.means) <= [1, 2, 3]).all(axis=1)
    opaque = 1 / (1 + np.exp(-model.opacities)) >= 0.25
    np.testing.assert_array_equal(kept.means, model.means[inside & opaque])
    assert filter_gaussians(model) is model
    with pytest.raises(ParameterError, match="none of 700"):
        filter_gaussians(model, parse_region("90,90,90,91,91,91"))


def test_isolated_gaussians_are_found_at_every_scale(rng):
    """Before a wall of details, and a background of few, large Gaussians."""

    def wall(side, step, depth):
        x, y = (each.ravel() for each in np.meshgrid(*[np.arange(-side, side, step)] * 2))
        return np.stack([x, y, np.full(len(x), depth)], axis=1)

    parts = [wall(1, 0.05, 2.0), wall(40, 4.0, 90.0), rng.uniform(-0.6, 0.6, (12, 3))]
    sizes = np.concatenate(
        [np.full(len(p), s) for p, s in zip(parts, (0.04, 3.0, 0.02), strict=True)]
    )
    model = gaussians_at(np.concatenate(parts), sizes)
    found = isolated(model)
    assert not found[:-12].any()
    assert found[-12:].all()
    # Faint Gaussians are neither floaters nor neighbours.
    opacities = np.where(np.arange(len(model)) < len(model) - 6, 0.9, 0.05)
    found = isolated(gaussians_at(np.concatenate(parts), sizes, opacities))
    np.testing.assert_array_equal(found[-12:], np.arange(12) < 6)
    assert not isolated(model.select(np.arange(3))).any()


def test_importance_without_photographs():
    """A Gaussian's opacity times its two larger sizes; of equal ones, the first stay."""
    model = gaussians_at(np.zeros((3, 3)), np.array([0.1, 0.2, 0.2]), np.array([0.8, 0.5, 0.5]))
    np.testing.assert_allclose(visible_area(model), [0.008, 0.02, 0.02], rtol=1e-5)
    assert largest(visible_area(model), 2).tolist() == [False, True, True]
    assert largest(visible_area(model), 1).tolist() == [False, True, False]
