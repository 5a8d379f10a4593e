"""Principal axes against an eigensolver, and what the methods are worth on known surfaces.

Lengths are in units of h, the mean distance to the 6 nearest originals. Error: new points to the
surface. Coverage: the surface to its nearest point, original or new (smaller is better).
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import splatseed as ss
from splatseed.methods.patches import local_frames
from splatseed.seeding.geometry_score import far_share, mean_spacing
from splatseed.synthetic import SHAPES
from splatseed.synthetic.surfaces import parallel_plates, plane

from . import references as slow

NUM = 1500
NOISE = 0.1
CURVED = ["plane", "sphere", "cylinder", "sine sheet"]


def far(cloud, **options):
    return far_share(cloud.xyz, ss.upsample(cloud, ratio=8, **options).xyz[len(cloud) :])


@functools.cache
def scanned(shape, noise=NOISE):
    """Noisy samples of a surface, and their mean spacing."""
    rng = np.random.default_rng(3)
    xyz = SHAPES[shape]().sample(NUM, rng)
    h = mean_spacing(xyz)
    xyz += noise * h * rng.normal(size=xyz.shape)
    return ss.PointCloud(xyz.astype(np.float32), np.full((NUM, 3), 128, np.uint8)), h


@functools.cache
def measured(shape, method):
    """Error and coverage of a method, eight times as many points."""
    cloud, h = scanned(shape)
    surface = SHAPES[shape]()
    seeds = ss.upsample(cloud, method, ratio=8).xyz
    dense = surface.sample(20_000, np.random.default_rng(4))
    return surface.distance(seeds[NUM:]).mean() / h, cKDTree(seeds).query(dense)[0].mean() / h


@pytest.mark.parametrize("method", ["mls", "spline"])
@pytest.mark.parametrize("shape", CURVED)
def test_surface_fits_cover_far_better_than_chords(shape, method):
    error, coverage = measured(shape, method)
    for simple in ("linear", "triangle"):
        simple_error, simple_coverage = measured(shape, simple)
        assert coverage < 0.65 * simple_coverage
        assert error + coverage < 0.8 * (simple_error + simple_coverage)


@pytest.mark.parametrize(
    ("method", "order"), [("linear", 2), ("triangle", 2), ("mls", 3), ("spline", 2)]
)
def test_errors_shrink_with_the_spacing_to_the_order_of_the_fit(method, order):
    error = {}
    for num in (500, 4000):  # of exact samples of a sphere, eight times as many: spaced by sqrt(8)
        xyz = SHAPES["sphere"]().sample(num, np.random.default_rng(1)).astype(np.float32)
        new = ss.upsample(ss.PointCloud(xyz, np.zeros(xyz.shape, np.uint8)), method, ratio=8).xyz
        error[num] = np.abs(np.linalg.norm(new[num:].astype(np.float64), axis=1) - 1.0).mean()
    assert error[500] / error[4000] > 0.9 * 8 ** (order / 2)


@pytest.mark.parametrize("tilt", [0, 45, 90])
def test_walls_are_as_good_as_floors_but_for_the_papers_spline(tilt):
    rng = np.random.default_rng(5)
    xyz = plane(tilt).sample(NUM, rng) + 0.005 * rng.normal(size=(NUM, 3))
    wall = ss.PointCloud(xyz.astype(np.float32), np.full((NUM, 3), 128, np.uint8))
    assert far(wall, method="mls") < 0.01
    assert far(wall, method="spline") < 0.01
    assert (far(wall, method="spline", profile="paper") > 0.05) == (tilt == 90)


def test_no_spline_of_a_lattice_leaves_it():
    """Most of its patches do not determine a bicubic surface."""
    lattice = np.indices((12, 12, 3)).reshape(3, -1).T.astype(np.float32)
    cloud = ss.PointCloud(lattice, np.zeros(lattice.shape, np.uint8))
    for profile in ("default", "paper"):
        assert np.abs(ss.upsample(cloud, "spline", ratio=8, profile=profile).xyz).max() < 100


def test_clamped_cells_stay_near_and_boxed_ones_do_not():
    cloud, _ = scanned("sphere")
    assert far(cloud, method="voronoi") < 0.01
    assert far(cloud, method="voronoi", profile="paper") > 0.3


@pytest.mark.parametrize("method", ["linear", "triangle", "mls", "spline"])
@pytest.mark.parametrize(("gap", "bridging"), [(0.5, 0.0), (0.3, 0.03)], ids=["7 h", "4 h"])
def test_few_bridges_between_plates(method, gap, bridging):
    xyz = parallel_plates(gap).sample(NUM, np.random.default_rng(6))
    cloud = ss.PointCloud(xyz.astype(np.float32), np.zeros((NUM, 3), np.uint8))
    new = ss.upsample(cloud, method, ratio=8).xyz[NUM:]
    height = new @ plane().frame[2]  # 0 on one plate, the gap on the other
    assert np.mean(np.minimum(np.abs(height), np.abs(height - gap)) > 0.1 * gap) <= bridging


STRETCHES = [
    (1.0, 0.7, 0.4), (1.0, 0.8, 0.01), (1.0, 0.8, 0.0), (1.0, 0.01, 0.005), (1.0, 1e-3, 1e-6),
    (1.0, 0.0, 0.0), (1.0, 1.0, 1.0),
]  # fmt: skip


@pytest.mark.parametrize("stretch", STRETCHES)
@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_principal_axes_in_every_shape_of_a_neighbourhood(stretch, scale, rng):
    turns = Rotation.random(50, random_state=1)
    clouds = [scale * turn.apply(rng.normal(size=(17, 3)) * stretch) for turn in turns]
    others = np.arange(1, 17)
    idx = np.zeros((850, 16), np.int32)
    idx[::17] = others + 17 * np.arange(50)[:, None]
    frames, flat = local_frames(np.ascontiguousarray(np.concatenate(clouds)), idx)
    for points, frame, collinear in zip(clouds, frames[::17], flat[::17], strict=True):
        np.testing.assert_allclose(frame @ frame.T, np.eye(3), rtol=0, atol=1e-9)
        assert np.linalg.det(frame) > 0
        assert collinear == (stretch[1] == 0)
        if collinear:
            along = (points[1] - points[0]) / np.linalg.norm(points[1] - points[0])
            assert abs(frame[0] @ along) == pytest.approx(1.0)
        elif stretch[1] < 1:
            expected = slow.frame_at(points, 0, others)
            np.testing.assert_allclose(frame, expected, rtol=0, atol=1e-6)
