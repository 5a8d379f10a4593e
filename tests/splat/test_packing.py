"""A far Gaussian, a glaring colour or a huge size costs the others nothing in any packed format."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import KDTree

from splatseed.errors import ParameterError
from splatseed.splat.formats import WRITTEN_SUFFIXES, read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.packing import morton_order, shells_of

COUNT = 600
RNG = np.random.default_rng(5)
SOME = np.arange(0, 6 * 7, 7)  # 1%
FAR = {
    "one": ([5], [[0, 0, 1e4]]),
    "one, very": ([5], [[1e6, -1e6, 1e6]]),
    "one, beyond any": ([5], [[0, 1e15, 0]]),
    "a hundredth": (SOME, 1e6 * RNG.normal(size=(6, 3))),
    "at all distances": (SOME, RNG.normal(size=(6, 3)) * 10.0 ** np.arange(2, 8)[:, None]),
    "along an axis": (SOME, np.eye(3)[[0] * 6] * np.geomspace(1e3, 1e6, 6)[:, None]),
    "a cluster": (SOME, RNG.normal((1e5, 0, 0), 1, (6, 3))),
    "a fifth": (np.arange(0, COUNT, 5), 1e4 * RNG.normal(size=(COUNT // 5, 3))),
}
STEPS = {".ply": 0, ".splat": 0, ".spz": 0.002, ".sog": 0.004}
"""Largest errors of positions in a ball of radius 3, whose Gaussians have a size of 0.05."""


@pytest.fixture(scope="module")
def near():
    arrays = {
        "means": np.clip(RNG.normal(size=(COUNT, 3)), -3, 3),
        "scales": 0.2 * RNG.normal(size=(COUNT, 3)) - 3,
        "quats": RNG.normal(size=(COUNT, 4)),
        "opacities": RNG.normal(size=COUNT),
        "sh0": RNG.uniform(-1.7, 1.7, (COUNT, 1, 3)),
        "shN": np.zeros((COUNT, 0, 3)),
    }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _written(path, model):
    """What comes back from a file, and the findings of its writer, as printed."""
    notes = []
    write_gaussians(path, model, note=lambda finding: notes.append(str(finding)))
    return read_gaussians(path), notes


@pytest.mark.parametrize("case", FAR)
@pytest.mark.parametrize("suffix", WRITTEN_SUFFIXES)
def test_distant_gaussians_do_not_displace_the_others(near, suffix, case, tmp_path):
    rows, places = FAR[case]
    means = near.means.copy()
    means[rows] = places
    model, notes = _written(tmp_path / f"m{suffix}", dataclasses.replace(near, means=means))
    others = np.delete(np.arange(COUNT), rows)
    errors, match = KDTree(model.means).query(means[others])
    assert errors.max() <= 2 * STEPS[suffix]
    assert len(set(match)) == len(others)
    colors = np.abs(model.sh0[match] - near.sh0[others]).max()
    assert colors < 0.03
    kept = np.isin(np.arange(COUNT), rows, invert=True)
    if len(model) == COUNT:  # far ones stay about where they were
        assert not notes
        errors = KDTree(model.means).query(means[rows])[0]
        assert (errors < 0.05 * np.abs(means[rows]).max(axis=1)).all()
    else:
        (note,) = notes
        assert suffix == ".spz"
        assert f"{COUNT - len(model)} Gaussian" in note
        assert len(model) >= np.count_nonzero(kept)


def test_spz_keeps_large_distant_gaussians_and_refuses_positions_out_of_range(near, tmp_path):
    scales, means = near.scales.copy(), near.means.copy()
    means[:60] *= 2e5 / np.abs(means[:60]).max(axis=1, keepdims=True)
    scales[:60] = 9  # a sky
    model, (note, sizes) = _written(
        tmp_path / "m.spz", dataclasses.replace(near, scales=scales, means=means)
    )
    assert len(model) == COUNT
    assert "0.0312" in note
    assert "sizes from 4.5e-05 to 379 units: 60 Gaussians" in sizes
    with pytest.raises(ParameterError, match="of the origin"):
        write_gaussians(
            tmp_path / "m.spz", dataclasses.replace(near, means=near.means + np.float32(9e6))
        )


@pytest.mark.parametrize(("name", "value"), [("scales", 15.0), ("scales", -80.0), ("sh0", 1e6)])
def test_an_extreme_size_or_colour_does_not_degrade_codebooks(near, name, value, tmp_path):
    array = getattr(near, name).copy()
    array.reshape(COUNT, 3)[9, 1] = value
    for suffix in WRITTEN_SUFFIXES:
        model, _ = _written(tmp_path / f"m{suffix}", dataclasses.replace(near, **{name: array}))
        assert len(model) == COUNT
        others = np.delete(np.arange(COUNT), 9)
        match = KDTree(model.means).query(near.means[others])[1]
        for each, limit in (("scales", 0.06), ("sh0", 0.04)):
            errors = np.abs(getattr(model, each)[match] - getattr(near, each)[others])
            assert errors.max() < limit, (suffix, each)


def test_shells_and_z_curve_ignore_outliers():
    means = np.zeros((9, 3), np.float32)
    means[:, 0] = [-1, 1, -1, 1, -1, 1, 7, 100, 4e4]  # median 1; distances 2 0 2 0 2 0 6 99 4e4
    assert shells_of(means).tolist() == [0, 0, 0, 0, 0, 0, 0, 1, 2]
    line = np.linspace(-1, 1, 50, dtype=np.float32)[:, None] * np.ones(3, np.float32)
    with_far = np.vstack([line, [[1e12, 1e12, 1e12]]]).astype(np.float32)
    assert np.array_equal(morton_order(with_far), np.arange(51))


def test_the_z_curve_of_a_wide_flat_model_is_short():
    """A plane's Z curve steps 1.7 cells in the mean; the height's noise must not cut it up."""
    x, z = (each.ravel() for each in np.meshgrid(np.arange(64.0), np.arange(64.0)))
    y = np.random.default_rng(0).normal(0, 0.05, 4096)
    means = np.column_stack([x, y, z]).astype(np.float32)
    steps = np.linalg.norm(np.diff(means[morton_order(means)], axis=0), axis=1)
    assert steps.mean() < 2
