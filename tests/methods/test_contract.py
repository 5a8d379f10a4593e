"""What every method promises, checked over all of them, in both profiles."""

from __future__ import annotations

import numba
import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from splatseed import METHODS, PointCloud

from .contract import KINDS, PHOTOGRAPH_METHODS, named

pytestmark = pytest.mark.usefixtures("third_party")

every_kind = pytest.mark.parametrize("kind", KINDS, ids=str)
NUM_NEW = 600
OFFSET = np.array([2000.0, -1000.0, 3000.0])


def mean_spacing(cloud):
    return cKDTree(cloud.xyz).query(cloud.xyz, 7)[0][:, 1:].mean()


def assert_same_points(actual, expected, tolerance):
    """At least 99% of the positions agree, and their colours but for rounding.

    A few may differ: the axes of a round neighbourhood, or the order of two neighbours that are
    equally far, are decided by the last bit.
    """
    same = np.linalg.norm(actual.xyz.astype(np.float64) - expected.xyz, axis=1) <= tolerance
    assert same.mean() >= 0.99
    off = np.abs(actual.rgb[same].astype(int) - expected.rgb[same])
    assert (off <= 1).mean() >= 0.999


def moved(cloud, function):
    return cloud.replace(xyz=function(cloud.xyz.astype(np.float64)).astype(np.float32))


def test_the_suite_covers_every_method():
    assert {kind.method for kind in KINDS} == set(METHODS) - {*PHOTOGRAPH_METHODS, "cloud"}


@every_kind
def test_new_points_are_finite_and_as_many_as_asked(kind, wavy):
    seeds = kind(wavy, num_points=1003)
    assert len(seeds) == 1003
    assert seeds.finite.all()


@every_kind
def test_originals_come_first_and_bit_equal(kind, wavy):
    seeds = kind(wavy, ratio=3)
    first = seeds.select(slice(len(wavy)))
    assert first.xyz.tobytes() == wavy.xyz.tobytes()
    assert first.rgb.tobytes() == wavy.rgb.tobytes()
    assert seeds.num_original == len(wavy)
    assert len(set(seeds.source[len(wavy) :])) == 1


@every_kind
def test_bytes_follow_from_the_seed_whatever_the_threads(kind, wavy):
    available = numba.config.NUMBA_NUM_THREADS
    results = []
    try:
        for threads in (1, min(2, available), available):
            numba.set_num_threads(threads)
            seeds = kind(wavy, seed=7)
            results.append(seeds.xyz.tobytes() + seeds.rgb.tobytes())
    finally:
        numba.set_num_threads(available)
    assert len(set(results)) == 1
    assert kind(wavy, seed=8).xyz.tobytes() != seeds.xyz.tobytes()


@every_kind
def test_colors_stay_within_those_of_the_originals(kind, wavy):
    dull = wavy.replace(rgb=(100 + wavy.rgb // 8).astype(np.uint8))
    rgb = kind.new(dull, NUM_NEW).rgb
    assert (rgb >= dull.rgb.min(axis=0)).all()
    assert (rgb <= dull.rgb.max(axis=0)).all()


@pytest.mark.parametrize("kind", named(turns_with_the_cloud=True), ids=str)
@pytest.mark.parametrize("seed", [0, 1])
def test_new_points_turn_with_the_cloud(kind, wavy, seed):
    turn = Rotation.random(random_state=seed)
    shift = np.array([0.3, -0.7, 0.2])
    actual = kind.new(moved(wavy, lambda xyz: turn.apply(xyz) + shift), NUM_NEW)
    expected = moved(kind.new(wavy, NUM_NEW), lambda xyz: turn.apply(xyz) + shift)
    assert_same_points(actual, expected, 1e-4 * mean_spacing(wavy))


@every_kind
@pytest.mark.parametrize("scale", [1e-3, 1e6])
def test_new_points_grow_with_the_cloud(kind, wavy, scale):
    actual = kind.new(moved(wavy, lambda xyz: xyz * scale), NUM_NEW)
    expected = moved(kind.new(wavy, NUM_NEW), lambda xyz: xyz * scale)
    assert_same_points(actual, expected, 1e-4 * scale * mean_spacing(wavy))


@every_kind
@pytest.mark.parametrize("scale", [2.0**-10, 2.0**20])
def test_no_length_is_built_in(kind, wavy, scale):
    # A power of two changes no mantissa: any absolute constant in a formula would show.
    actual = kind.new(moved(wavy, lambda xyz: xyz * scale), NUM_NEW)
    expected = moved(kind.new(wavy, NUM_NEW), lambda xyz: xyz * scale)
    np.testing.assert_array_equal(actual.xyz, expected.xyz)
    np.testing.assert_array_equal(actual.rgb, expected.rgb)


@every_kind
def test_new_points_move_with_the_cloud(kind, wavy):
    far = moved(wavy, lambda xyz: xyz + OFFSET)
    near = moved(far, lambda xyz: xyz - OFFSET)  # what float32 left of the positions out there
    expected = moved(kind.new(near, NUM_NEW), lambda xyz: xyz + OFFSET)
    two_last_places = 2 * np.spacing(np.float32(np.abs(OFFSET).max()))
    assert_same_points(kind.new(far, NUM_NEW), expected, two_last_places * np.sqrt(3))


@every_kind
def test_points_that_are_not_finite_are_kept_and_never_used(kind, wavy):
    holes = wavy.xyz.copy()
    holes[3] = np.nan
    holes[40, 1] = np.inf
    holes[41, 2] = -np.inf
    cloud = wavy.replace(xyz=holes)
    seeds = kind(cloud, num_points=len(cloud) + NUM_NEW)
    assert seeds.xyz[: len(cloud)].tobytes() == holes.tobytes()
    without = kind.new(cloud.select(cloud.finite), NUM_NEW)
    np.testing.assert_array_equal(seeds.xyz[len(cloud) :], without.xyz)
    np.testing.assert_array_equal(seeds.rgb[len(cloud) :], without.rgb)


@every_kind
def test_duplicates_are_kept_and_count_once(kind, wavy):
    twice = PointCloud.concatenate(wavy, wavy)
    seeds = kind(twice, num_points=len(twice) + NUM_NEW)
    assert seeds.xyz[: len(twice)].tobytes() == twice.xyz.tobytes()
    once = kind.new(wavy, NUM_NEW)
    np.testing.assert_array_equal(seeds.xyz[len(twice) :], once.xyz)


@every_kind
def test_earlier_new_points_are_replaced(kind, wavy):
    again = kind(kind(wavy, ratio=2, seed=1), ratio=3)
    np.testing.assert_array_equal(again.xyz, kind(wavy, ratio=3).xyz)
