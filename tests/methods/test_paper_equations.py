"""Profile ``paper`` makes what the paper's equations say, tested from outside.

A new point does not carry its base, so the tests search for it: for some base, the equation must
give this very point. Bases and places must be distributed as the text has it. Seeds are fixed;
p-values below 1e-3 fail.
"""

from __future__ import annotations

import numpy as np
import pytest
import scipy
from PIL import Image as PilImage
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import splatseed as ss
from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.depthmap import DepthMap
from splatseed.scene import Image, Scene, SceneSource

from ..depth.conftest import MemoryMaps
from . import paper_equations as paper

NUM_NEW = 640
CLOSE = 1e-5  # float32, in a cloud 2 wide


def new_points(whole, method, num_new=NUM_NEW):
    """xyz and rgb of the new points of profile ``paper``, float64."""
    num = len(whole.points if isinstance(whole, Scene) else whole)
    seeds = ss.upsample(whole, method, profile="paper", num_points=num + num_new, seed=3)
    return seeds.xyz[num:].astype(np.float64), seeds.rgb[num:].astype(np.float64)


def assert_uniform(values):
    assert scipy.stats.kstest(values, "uniform").pvalue > 1e-3


def assert_equally_likely(draws, num):
    """Rows of originals, each as likely as any other; counted in groups of at least 16 draws."""
    group = int(np.ceil(16 * num / len(draws)))
    sizes = np.bincount(np.arange(num) // group)
    counts = np.bincount(draws // group, minlength=len(sizes))
    assert scipy.stats.chisquare(counts, sizes / num * len(draws)).pvalue > 1e-3


@pytest.mark.parametrize(("method", "k"), [("linear", 1), ("triangle", 2)])
def test_equations_1_and_2(method, k, wavy, wavy_exact):
    xyz, rgb = wavy_exact.xyz, wavy_exact.rgb
    new, colors = new_points(wavy, method)
    simplices = {}  # two bases may span the same one
    for i in range(len(xyz)):
        simplices.setdefault(frozenset([i, *paper.nearest(xyz, i, k).tolist()]), []).append(i)
    bases = [members[0] for members in simplices.values()]
    weights, gaps = [], []
    for i in bases:
        corners = xyz[[i, *paper.nearest(xyz, i, k)]]
        edges = (corners[1:] - corners[0]).T
        rest = np.linalg.lstsq(edges, (new - corners[0]).T, rcond=None)[0].T
        weights.append(np.clip(np.column_stack([1.0 - rest.sum(axis=1), rest]), 0.0, 1.0))
        gaps.append(np.linalg.norm(weights[-1] @ corners - new, axis=1))
    found = np.argmin(gaps, axis=0)
    chosen = np.array([weights[row][j] for j, row in enumerate(found)])
    for point, color, row, w in zip(new, colors, found, chosen, strict=True):
        i = bases[row]
        for values, value, close in ((xyz, point, CLOSE), (rgb, color, 0.51)):
            if method == "linear":
                expected = paper.linear(values, i, xyz, w[0])
            else:
                expected = paper.triangle(values, i, xyz, w)
            np.testing.assert_allclose(expected, value, atol=close)
    # alpha ~ U[0, 1]; and uniform in a triangle, where P(1 - w1 < t) = t^2.
    assert_uniform((1.0 - chosen[:, 0]) ** k)
    if method == "triangle":
        assert_uniform(chosen[:, 1] / (chosen[:, 1] + chosen[:, 2]))
    expected = np.array([len(members) for members in simplices.values()]) / len(xyz) * NUM_NEW
    observed = np.bincount(found, minlength=len(bases))
    assert scipy.stats.chisquare(observed, expected).pvalue > 1e-3


@pytest.mark.filterwarnings("ignore:(?s).*storage space exceeds:UserWarning")  # s is inert
@pytest.mark.parametrize(("method", "k"), [("spline", 25), ("mls", 10)])
def test_equations_3_to_5(method, k, wavy, wavy_exact):
    xyz, rgb = wavy_exact.xyz, wavy_exact.rgb
    new, colors = new_points(wavy, method)
    surfaces = [getattr(paper, method)(xyz, i) for i in range(len(xyz))]
    flat = [paper.neighborhood(xyz, i, k)[:, :2] for i in range(len(xyz))]
    low, high = np.array([(xy.min(axis=0), xy.max(axis=0)) for xy in flat]).swapaxes(0, 1)
    found, places = [], []
    for (x, y, z), color in zip(new, colors, strict=True):
        share = ([x, y] - low) / (high - low)
        inside = np.flatnonzero(((share > -CLOSE) & (share < 1 + CLOSE)).all(axis=1))
        gaps = [abs(surfaces[i](x, y) - z) for i in inside]
        assert min(gaps) < CLOSE * (1 + abs(z))
        i = inside[np.argmin(gaps)]
        found.append(i)
        places.append(share[i])
        rows = [i, *paper.nearest(xyz, i, k)]
        np.testing.assert_allclose(paper.mixed(rgb, xyz, rows, (x, y, z)), color, atol=0.51)
    assert_equally_likely(np.array(found), len(xyz))
    for axis in np.transpose(places):
        assert_uniform(axis)


@pytest.mark.filterwarnings("ignore:(?s).*storage space exceeds:UserWarning")
@pytest.mark.parametrize("tilt", [0, 60, 90])
def test_fitpacks_smoothing_is_inert_at_the_papers_size(tilt, rng):
    # With 26 points there is room for no knot: whatever s, it is the least-squares bicubic.
    flat = rng.uniform(-1.0, 1.0, (26, 3)) * [1.0, 1.0, 0.1]
    xyz = Rotation.from_euler("x", tilt, degrees=True).apply(flat)
    places = rng.uniform(xyz.min(axis=0)[:2], xyz.max(axis=0)[:2], (50, 2))
    surfaces = [paper.spline(xyz, 0, s=s) for s in (1e-9, None, 1e9)]
    heights = np.array([[surface(x, y) for x, y in places] for surface in surfaces])
    np.testing.assert_allclose(heights[:2], heights[[2, 2]], rtol=1e-9)


def test_equation_6(wavy, wavy_exact, rng):
    xyz, rgb = wavy_exact.xyz, wavy_exact.rgb
    new, colors = new_points(wavy, "voronoi", 4000)
    for point, color in zip(new[:200], colors[:200], strict=True):
        rows = np.argsort(np.linalg.norm(xyz - point, axis=1))[:5]
        np.testing.assert_allclose(paper.mixed(rgb, xyz, rows, point), color, atol=0.51)
    expected = paper.voronoi_points(xyz, 20_000, rng)
    centers, radii, _ = paper.voronoi(xyz)
    assert all((np.linalg.norm(point - centers, axis=1) <= 0.5001 * radii).any() for point in new)
    # The same share of points about every centre, at the same distances.
    (gaps, near), (expected_gaps, expected_near) = map(cKDTree(centers).query, (new, expected))
    table = np.array([np.bincount(each, minlength=len(xyz)) for each in (near, expected_near)])
    order = np.argsort(table.sum(axis=0))[::-1]
    group = np.minimum(np.cumsum(table.sum(axis=0)[order]) // 120, 150)
    table = np.array([np.bincount(group, row[order]) for row in table])
    assert scipy.stats.chi2_contingency(table[:, table.sum(axis=0) > 0]).pvalue > 1e-3
    assert scipy.stats.ks_2samp(gaps, expected_gaps).pvalue > 1e-3


WIDTH, HEIGHT, FOCAL, TRUE_SCALE = 48, 36, 24.0, 2.0


@pytest.fixture
def slanted(tmp_path, rng):
    """Two wide cameras, back to back, before a slanted wall each, whose points are noisy.

    Maps hold planar depth, as sensors' do, at half its scale.
    """
    lens = Intrinsics(1, "PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    column, row = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    depth = (1.5 + column / 40 + row / 90).astype(np.float32)
    photograph = np.stack([5 * column, 7 * row, column + row], axis=-1).astype(np.uint8)
    images, maps, xyz = [], MemoryMaps(), []
    for i, rotation in enumerate([np.eye(3), np.diag([-1.0, 1.0, -1.0])]):
        name, center = f"{i}.png", np.array([0.3, -0.2, 0.0])
        image = Image(name, i + 1, lens, quat_from_rotation(rotation), -rotation @ center)
        PilImage.fromarray(photograph).save(tmp_path / name)
        uv = np.stack([column[2::5, 2::5].ravel(), row[2::5, 2::5].ravel()], axis=1) + 0.5
        z = TRUE_SCALE * depth[2::5, 2::5].ravel() * rng.uniform(0.9, 1.1, len(uv))
        images.append(image)
        maps[name] = DepthMap(depth)
        xyz.append(image.camera.unproject(uv, z))
    xyz = np.concatenate(xyz).astype(np.float32)
    cloud = ss.PointCloud(xyz, np.zeros(xyz.shape, np.uint8))
    source = SceneSource("colmap", tmp_path, tmp_path, image_dir=tmp_path)
    return Scene(cloud, tuple(images), (lens,), source=source, depths=maps), depth, photograph


def test_equations_7_to_9(slanted):
    scene, depth, photograph = slanted
    new, colors = new_points(scene, "depth", 200)
    xyz = scene.points.xyz.astype(np.float64)
    for image, sign in zip(scene.images, (1, -1), strict=True):
        camera = image.camera
        scale = paper.depth_scale(depth, camera, xyz[sign * xyz[:, 2] > 0])
        mine = sign * new[:, 2] > 0
        assert mine.sum() == 100  # as many from every image
        pixels = []
        for point, color in zip(new[mine], colors[mine], strict=True):
            x, y, z = camera.K @ (camera.cam_from_world[:3] @ [*point, 1.0])
            column, row = int(x / z), int(y / z)
            expected = paper.lifted(depth, camera, scale, column, row)
            np.testing.assert_allclose(point, expected, atol=CLOSE)
            np.testing.assert_array_equal(photograph[row, column], color)
            pixels.append((column, row))
        column, row = np.transpose(pixels)
        for places, size in ((column, WIDTH), (row, HEIGHT)):
            assert size / 4 <= places.min() <= places.max() < 3 * size / 4
        blocks = np.bincount((column - 12) // 6 + 4 * ((row - 9) // 6), minlength=12)
        assert scipy.stats.chisquare(blocks).pvalue > 1e-3


def test_random_points(wavy, wavy_exact):
    xyz, rgb = wavy_exact.xyz, wavy_exact.rgb
    new, colors = new_points(wavy, "random", 1600)
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    for axis in ((new - low) / (high - low)).T:
        assert_uniform(axis)
    found = [np.flatnonzero((rgb == color).all(axis=1))[0] for color in colors]
    assert_equally_likely(np.array(found), len(xyz))
