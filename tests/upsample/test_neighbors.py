"""Preparing a cloud: what is kept, who is whose neighbour, who may be a base."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scipy import stats

from splatseed import PointCloud
from splatseed.upsample.nearest_points import distances_of
from splatseed.upsample.neighbors import draw_bases, prepare, sound_bases

from . import references as slow


@pytest.fixture
def prepared(wavy):
    return prepare(wavy)


def in_file_order(prepared, values):
    ordered = np.empty_like(values)
    ordered[prepared.rank] = values
    return ordered


def test_rows_are_the_distinct_finite_originals(wavy):
    xyz = np.concatenate([wavy.xyz, wavy.xyz[10:30], [[np.nan, 0, 0], [9, 9, 9]]])
    rgb = np.concatenate([wavy.rgb, 255 - wavy.rgb[10:30], np.zeros((2, 3), np.uint8)])
    source = np.zeros(len(xyz), np.uint8)
    source[-1] = 4  # a point that an earlier run made
    prepared = prepare(PointCloud(xyz, rgb, source))
    np.testing.assert_allclose(
        in_file_order(prepared, prepared.xyz) + prepared.center, wavy.xyz, rtol=0, atol=1e-12
    )
    np.testing.assert_array_equal(in_file_order(prepared, prepared.rgb), wavy.rgb)


def test_zero_has_no_sign():
    xyz = np.array([[0.0, 1, 2], [-0.0, 1, 2], [3, -0.0, 1], [3, 0.0, 1]], np.float32)
    assert len(prepare(PointCloud(xyz, np.zeros((4, 3), np.uint8)))) == 2


def test_duplicates_are_found_among_many(rng):
    xyz = rng.integers(0, 12, (5000, 3)).astype(np.float32)  # nearly every place is taken twice
    prepared = prepare(PointCloud(xyz, np.zeros((5000, 3), np.uint8)))
    _, first = np.unique(xyz, axis=0, return_index=True)
    found = in_file_order(prepared, prepared.xyz + prepared.center)
    np.testing.assert_allclose(found, xyz[np.sort(first)], rtol=0, atol=1e-9)


def test_an_empty_choice_of_trusted_rows_trusts_all(prepared, rng):
    bases = draw_bases(prepared, 500, rng, weight=np.zeros(len(prepared)))
    assert np.count_nonzero(bases.count) > 100


def test_untrusted_points_are_neighbors_but_never_bases(wavy, rng):
    trusted = np.arange(len(wavy)) % 3 > 0
    prepared = prepare(wavy, trusted)
    neighbors = prepared.neighbors(16)
    bases = draw_bases(prepared, 3000, rng, weight=sound_bases(prepared, neighbors))
    assert in_file_order(prepared, bases.count)[~trusted].sum() == 0
    assert not trusted[prepared.rank[neighbors.idx]].all()


@pytest.mark.parametrize("k", [1, 6, 25, 159, 1000])
def test_neighbors_are_those_of_brute_force(wavy_exact, prepared, k):
    found = prepared.neighbors(k)
    for row in range(0, len(prepared), 7):
        i = prepared.rank[row]
        rows, distance = slow.neighbors(wavy_exact.xyz, i, k)
        np.testing.assert_allclose(found.distance[row], distance, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(prepared.rank[found.idx[row]], rows)
    first = found.nearest(4)
    np.testing.assert_array_equal(first.idx, found.idx[:, :4])


def test_distances_are_the_same_bytes_without_numba(rng, monkeypatch):
    xyz = rng.normal(size=(30_000, 3)) * 10.0 ** rng.integers(-6, 6, (30_000, 1))
    idx = rng.integers(0, len(xyz), (20_000, 5)).astype(np.int32)
    by_kernel = distances_of(xyz, idx, 1e-3)
    monkeypatch.delitem(sys.modules, "numba")
    np.testing.assert_array_equal(distances_of(xyz, idx, 1e-3), by_kernel)
    assert by_kernel.min() == 1e-3


def test_spacing_is_the_mean_of_six(wavy_exact, prepared):
    fast = in_file_order(prepared, prepared.neighbors(16).spacing)
    expected = [slow.spacing(wavy_exact.xyz, i) for i in range(len(wavy_exact.xyz))]
    np.testing.assert_allclose(fast, expected, rtol=1e-12)


@pytest.mark.parametrize("k", [8, 16, 25])
def test_isolated_points_are_those_of_the_rule(wavy_exact, prepared, k):
    fast = in_file_order(prepared, sound_bases(prepared, prepared.neighbors(k)))
    expected = slow.base_weights(wavy_exact.xyz, k, reject_isolated=True)
    np.testing.assert_array_equal(fast, expected)
    assert 0 < np.count_nonzero(expected == 0) < 10  # the planted outliers


def test_bases_are_drawn_by_weight(prepared, rng):
    weight = np.linspace(0.0, 2.0, len(prepared))
    bases = draw_bases(prepared, 100_000, rng, weight=weight)
    assert bases.total == bases.count.sum() == 100_000
    assert bases.count[0] == 0
    expected = weight[1:] / weight.sum() * 100_000
    assert stats.chisquare(bases.count[1:], expected).pvalue > 1e-3


def test_outputs_are_laid_out_by_rank_without_gaps(prepared, rng):
    bases = draw_bases(prepared, 999, rng, weight=np.ones(len(prepared)))
    start, count = (in_file_order(prepared, a) for a in (bases.start, bases.count))
    np.testing.assert_array_equal(start, np.cumsum(count) - count)
