"""Preparing a cloud: what is kept, whose neighbour, who may be a base; colours in between."""

from __future__ import annotations

import numpy as np
import pytest
import scipy

from splatseed import PointCloud, Scene
from splatseed.methods import configure
from splatseed.methods.neighbors import draw_bases, prepare, trusted_originals
from splatseed.progress import silent
from splatseed.tracks import Tracks

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


def test_bases_are_drawn_by_weight(prepared, rng):
    weight = np.linspace(0.0, 2.0, len(prepared))
    bases = draw_bases(prepared, 100_000, rng, weight=weight)
    assert bases.total == bases.count.sum() == 100_000
    assert bases.count[0] == 0
    expected = weight[1:] / weight.sum() * 100_000
    assert scipy.stats.chisquare(bases.count[1:], expected).pvalue > 1e-3


def scene_with(lengths, errors):
    n, offsets = len(lengths), np.concatenate([[0], np.cumsum(lengths)])
    xyz, seen = np.random.default_rng(0).random((n, 3)), np.zeros(offsets[-1], np.uint32)
    tracks = Tracks(np.arange(1, n + 1), xyz, np.asarray(errors, float), offsets, seen, seen)
    return Scene(PointCloud(xyz, np.zeros((n, 3), np.uint8)), tracks=tracks)


def test_short_and_bad_together_are_not_trusted_and_unknown_errors_are():
    found = trusted_originals(scene_with([3, 3, 9, 9, 5], [0.5, 5.0, 0.5, 5.0, 0.5]))
    np.testing.assert_array_equal(found, [True, False, True, True, True])
    assert trusted_originals(scene_with([2, 2], [-1.0, -1.0])) is None
    assert trusted_originals(scene_with([2, 2, 2], [-1.0, 1.0, 1.0])).all()


@pytest.mark.parametrize(("profile", "weight"), [("default", 0.0), ("paper", 1.0)])
def test_a_mistrusted_point_is_a_neighbor_but_no_base(profile, weight):
    scene = scene_with(np.full(300, 3), np.where(np.arange(300) == 7, 50.0, 0.5))
    cloud = prepare(scene.points, trusted_originals(scene))
    neighbors = cloud.neighbors(8)
    weights, _ = configure("linear", profile).base_weights(cloud, neighbors, silent)
    assert weights[cloud.rank == 7] == weight
    assert 7 in cloud.rank[neighbors.idx]
