"""What the methods are worth on surfaces that are known.

Lengths are in units of h, the mean distance to the 6 nearest originals. Error: new points to the
surface. Coverage: the surface to its nearest point, original or new (smaller is better).
"""

from __future__ import annotations

import functools

import numpy as np
import pytest
from scipy.spatial import cKDTree

import splatseed as ss
from splatseed.synthetic import SHAPES
from splatseed.synthetic.surfaces import parallel_plates, plane
from splatseed.upsample.neighbors import prepare, sound_bases

NUM = 1500
NOISE = 0.1
CURVED = ["plane", "sphere", "cylinder", "sine sheet"]


def spacings(xyz):
    return cKDTree(xyz).query(xyz, 7)[0][:, 1:].mean(axis=1)


@functools.cache
def scanned(shape, noise=NOISE):
    """Noisy samples of a surface, and their mean spacing."""
    rng = np.random.default_rng(3)
    xyz = SHAPES[shape]().sample(NUM, rng)
    h = spacings(xyz).mean()
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


def far_share(cloud, **options):
    """Share of new points more than 3 h from every original."""
    new = ss.upsample(cloud, ratio=8, **options).xyz[len(cloud) :]
    distance, nearest = cKDTree(cloud.xyz).query(new)
    return np.mean(distance > 3.0 * spacings(cloud.xyz)[nearest])


@pytest.mark.parametrize("method", ["mls", "spline"])
@pytest.mark.parametrize("shape", CURVED)
def test_surface_fits_cover_far_better_than_chords(shape, method):
    error, coverage = measured(shape, method)
    for simple in ("linear", "triangle"):
        simple_error, simple_coverage = measured(shape, simple)
        assert coverage < 0.65 * simple_coverage
        assert error + coverage < 0.8 * (simple_error + simple_coverage)


def sphere_error(method, num):
    """Distance to the unit sphere, from exact samples of it."""
    xyz = SHAPES["sphere"]().sample(num, np.random.default_rng(1)).astype(np.float32)
    new, _ = ss.upsample_points(xyz, np.zeros(xyz.shape, np.uint8), method, ratio=8)
    return np.abs(np.linalg.norm(new[num:].astype(np.float64), axis=1) - 1.0).mean()


@pytest.mark.parametrize(
    ("method", "order"), [("linear", 2), ("triangle", 2), ("mls", 3), ("spline", 2)]
)
def test_errors_shrink_with_the_spacing_to_the_order_of_the_fit(method, order):
    # Eight times as many points on a surface are spaced sqrt(8) times as closely.
    assert sphere_error(method, 500) / sphere_error(method, 4000) > 0.9 * 8 ** (order / 2)


def wall(tilt):
    """A noisy plane turned by ``tilt`` degrees; at 90 it is upright."""
    rng = np.random.default_rng(5)
    xyz = plane(tilt).sample(NUM, rng) + 0.005 * rng.normal(size=(NUM, 3))
    return ss.PointCloud(xyz.astype(np.float32), np.full((NUM, 3), 128, np.uint8))


@pytest.mark.parametrize("method", ["mls", "spline"])
@pytest.mark.parametrize("tilt", [0, 45, 90])
def test_walls_are_as_good_as_floors(method, tilt):
    assert far_share(wall(tilt), method=method) < 0.01


def test_the_papers_spline_flies_off_walls():
    assert far_share(wall(90), method="spline", profile="paper") > 0.05
    assert far_share(wall(90), method="spline", profile="paper") > 3 * far_share(
        wall(0), method="spline", profile="paper"
    )


def test_clamped_cells_stay_near_and_boxed_ones_do_not():
    cloud, _ = scanned("sphere")
    assert far_share(cloud, method="voronoi") < 0.01
    assert far_share(cloud, method="voronoi", profile="paper") > 0.3


@pytest.mark.parametrize("method", ["linear", "triangle", "mls", "spline"])
@pytest.mark.parametrize(("gap", "bridging"), [(0.5, 0.0), (0.3, 0.03)], ids=["7 h", "4 h"])
def test_few_bridges_between_plates(method, gap, bridging):
    xyz = parallel_plates(gap).sample(NUM, np.random.default_rng(6))
    cloud = ss.PointCloud(xyz.astype(np.float32), np.zeros((NUM, 3), np.uint8))
    new = ss.upsample(cloud, method, ratio=8).xyz[NUM:]
    height = new @ plane().frame[2]  # 0 on one plate, the gap on the other
    assert np.mean(np.minimum(np.abs(height), np.abs(height - gap)) > 0.1 * gap) <= bridging


def with_outliers(num_outliers):
    """A noisy sphere and, last, points strewn around it."""
    cloud, _ = scanned("sphere")
    strewn = np.random.default_rng(7).uniform(-1.5, 1.5, (num_outliers, 3)).astype(np.float32)
    xyz = np.concatenate([cloud.xyz, strewn])
    return ss.PointCloud(xyz, np.zeros(xyz.shape, np.uint8))


def test_the_isolated_rule_finds_outliers_and_spares_the_rest():
    cloud = prepare(with_outliers(60))
    lonely = np.empty(len(cloud), bool)
    lonely[cloud.rank] = sound_bases(cloud, cloud.neighbors(16)) == 0
    assert lonely[NUM:].mean() > 0.5
    assert lonely[:NUM].mean() < 0.01
