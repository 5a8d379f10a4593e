"""Clouds that are hardly clouds: too few points, points on a line, on a plane, on a lattice."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from splatseed import PointCloud
from splatseed.errors import PointCloudError

from .contract import KINDS, named

pytestmark = pytest.mark.usefixtures("third_party")

# Depth is lifted from images, whatever the shape of the cloud; see tests/depth.
OF_POINTS = named(needs_scene=False)
every_kind = pytest.mark.parametrize("kind", OF_POINTS, ids=str)
needs_neighbors = pytest.mark.parametrize(
    "kind", [kind for kind in OF_POINTS if not kind.takes_any_cloud], ids=str
)
on_flat_sets = pytest.mark.parametrize("kind", named(stays_on_flat_sets=True), ids=str)
TURN = Rotation.from_euler("xyz", [0.4, 0.9, -0.3])
SHIFT = np.array([0.5, -2.0, 1.0])


def cloud_of(xyz):
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    return PointCloud(xyz, np.random.default_rng(1).integers(0, 256, xyz.shape, np.uint8))


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("size", [{}, {"ratio": 1}, {"num_points": 7}], ids=str)
def test_no_points_are_an_error(kind, size):
    with pytest.raises(PointCloudError, match="at least one original point"):
        kind(cloud_of(np.empty((0, 3))), **size)


@needs_neighbors
@pytest.mark.parametrize("copies", [1, 30])
def test_one_place_is_an_error(kind, copies):
    with pytest.raises(PointCloudError, match="distinct finite points for"):
        kind(cloud_of(np.tile([1.0, 2.0, 3.0], (copies, 1))))


@every_kind
@pytest.mark.parametrize("num", [4, 5, 6, 9])
def test_fewer_points_than_neighbors_will_do(kind, num, rng):
    seeds = kind(cloud_of(rng.normal(size=(num, 3))), ratio=40)
    assert len(seeds) == 40 * num
    assert seeds.finite.all()


@on_flat_sets
@pytest.mark.parametrize("num", [4, 60])
@pytest.mark.parametrize("dimension", [1, 2], ids=["line", "plane"])
def test_points_of_a_flat_set_stay_on_it(kind, num, dimension, rng):
    flat = rng.uniform(-1.0, 1.0, (num, 3)) * (np.arange(3) < dimension)
    new = TURN.inv().apply(kind.new(cloud_of(TURN.apply(flat) + SHIFT), 400).xyz - SHIFT)
    assert np.abs(new[:, dimension:]).max() < 1e-5
    assert np.abs(new).max() < 3.0


@every_kind
@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_a_lattice_gives_finite_points_near_it(kind, dimension):
    axes = [np.arange(5.0 if d < dimension else 1.0) for d in range(3)]
    lattice = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    seeds = kind(cloud_of(lattice), ratio=20)
    assert np.isfinite(seeds.xyz).all()
    if kind.profile == "default":
        assert -4.0 < seeds.xyz.min() < seeds.xyz.max() < 8.0


@every_kind
@pytest.mark.parametrize(
    ("scale", "gap", "ratio"), [(1e-30, None, 4), (1e14, None, 4), (1, 1e-7, 20), (1, 1e-30, 20)]
)
def test_extreme_units_and_points_that_nearly_coincide_do_no_harm(kind, scale, gap, ratio, wavy):
    xyz = wavy.xyz.astype(np.float64) * scale  # beyond 1e15, coordinates are no places
    if gap is not None:
        xyz[:2] = np.outer([0.0, gap], [1.0, 0.0, 0.0])
    assert kind(wavy.replace(xyz=xyz.astype(np.float32)), ratio=ratio).finite.all()
