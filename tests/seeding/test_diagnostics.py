"""The numbers of ``splatseed info`` against brute force on small clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatseed.camera import Intrinsics
from splatseed.depthmap import DepthMap
from splatseed.findings import Finding
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Masks, Scene
from splatseed.seeding import diagnostics as module
from splatseed.tracks import Tracks

SHARES = [5, 25, 50, 75, 95]


def _scene(xyz, **parts):
    xyz = np.asarray(xyz, np.float32).reshape(-1, 3)
    return Scene(PointCloud(xyz, np.zeros(xyz.shape, np.uint8)), **parts)


def _brute_spacing(xyz):
    """Mean distance of every distinct point to its 6 nearest, by all pairs."""
    distinct = np.unique(np.asarray(xyz, np.float64), axis=0)
    distances = np.linalg.norm(distinct[:, None] - distinct, axis=2)
    return np.sort(distances, axis=1)[:, 1:7].mean(axis=1)


def test_counts_spacing_and_bounds(rng):
    xyz = rng.normal(size=(200, 3)).astype(np.float32)
    xyz[10:15] = xyz[0]
    scene = _scene(np.concatenate([xyz, [[np.nan, 0, 0], [0, np.inf, 0]]]))
    found = module.cloud_statistics(scene)
    assert (found.num_points, found.non_finite, found.duplicates) == (202, 2, 5)
    expected = np.percentile(_brute_spacing(xyz), SHARES)
    np.testing.assert_allclose(found.spacing, expected, rtol=1e-6)
    np.testing.assert_array_equal(found.low, xyz.min(axis=0))
    np.testing.assert_array_equal(found.high, xyz.max(axis=0))
    greatest = np.abs(xyz).max()
    assert found.resolution == np.nextafter(greatest, np.float32(np.inf)) - greatest


def test_a_point_far_from_a_cluster_is_isolated(rng):
    grid = np.stack(np.meshgrid(*[np.arange(10.0)] * 2, [0.0]), axis=-1).reshape(-1, 3)
    grid += 0.01 * rng.normal(size=grid.shape)
    assert module.cloud_statistics(_scene(grid)).isolated == 0
    strays = [[40, 40, 40], [-60, 0, 50]]
    assert module.cloud_statistics(_scene(np.concatenate([grid, strays]))).isolated == 2


@pytest.mark.parametrize("xyz", [np.zeros((0, 3)), np.full((3, 3), np.nan)])
def test_empty_clouds_have_no_measures(xyz):
    found = module.cloud_statistics(_scene(xyz))
    assert (found.num_points, found.non_finite) == (len(xyz), len(xyz))
    assert np.isnan([*found.spacing, *found.low, *found.high]).all()


def test_tracks(rng):
    lengths, errors = rng.integers(2, 9, 40), rng.random(40)
    errors[::5] = -1  # unknown
    offsets = np.concatenate([[0], np.cumsum(lengths)])
    seen = np.zeros(offsets[-1], np.uint32)
    xyz, known = rng.random((40, 3)), errors[errors >= 0]
    tracks = Tracks(np.arange(40), xyz, errors, offsets, seen, seen)
    found = module.track_statistics(_scene(xyz, tracks=tracks))
    assert found.mean_length == pytest.approx(lengths.mean())
    assert found.mean_error == pytest.approx(known.mean())
    np.testing.assert_allclose(found.length, np.percentile(lengths, SHARES))
    np.testing.assert_allclose(found.error, np.percentile(known, SHARES))
    assert module.track_statistics(_scene(xyz)) is None


def _brute_empty(xyz, size, cell):
    """Share of square cells that no point falls in, one point at a time."""
    hit = set()
    for x, y, z in np.asarray(xyz, float):
        u, v = 100 * x / z + size[0] / 2, 100 * y / z + size[1] / 2
        if z > 0 and 0 <= u < size[0] and 0 <= v < size[1]:
            hit.add((int(u // cell), int(v // cell)))
    return 1 - len(hit) / (-(-size[0] // cell) * -(-size[1] // cell))


@pytest.mark.parametrize("size", [(320, 200), (200, 320)])
def test_empty_regions(size, rng):
    xyz = rng.normal(size=(300, 3)).astype(np.float32)  # half of them behind the camera
    lens = Intrinsics(1, "PINHOLE", *size, (100.0, 100.0, size[0] / 2, size[1] / 2))
    images = tuple(
        Image(name, 1, lens, np.array(quat), np.zeros(3))
        for name, quat in (("a.png", [1.0, 0, 0, 0]), ("b.png", [0.0, 1, 0, 0]))
    )
    regions = module.empty_regions(_scene(xyz, images=images))
    shares = [_brute_empty(xyz, size, 10), _brute_empty(xyz * [1, -1, -1], size, 10)]
    assert regions.mean == pytest.approx(np.mean(shares))
    assert regions.worst == pytest.approx(max(shares))
    assert regions.worst_name == ["a.png", "b.png"][int(np.argmax(shares))]


def test_masked_area_does_not_count(rng):
    """Cells count if half of their pixels do; all cells of an image without a mask file count."""
    lens = Intrinsics(1, "PINHOLE", 320, 200, (100.0, 100.0, 160.0, 100.0))
    names = ("a.png", "b.png", "c.png")
    images = tuple(Image(n, 1, lens, np.array([1.0, 0, 0, 0]), np.zeros(3)) for n in names)
    uv = np.indices((20, 32)).reshape(2, -1).T[:, ::-1] * 10 + 5.0
    left = uv[uv[:, 0] < 160]
    scene = _scene(images[0].camera.unproject(left, np.full(len(left), 2.0)), images=images)
    assert module.empty_regions(scene).mean == pytest.approx(0.5)
    counts = np.zeros((200, 320), bool)
    counts[:, :246] = True  # 86 columns on the right; the cell across the edge counts
    cells = module._cell_shares(images[0], counts)
    assert cells.shape == (20, 32)
    np.testing.assert_allclose(cells[0, [0, 23, 24, 25]], [1, 1, 0.6, 0])
    scene = scene.replace(masks=Masks({"a.png": Path("a"), "b.png": Path("b")}))
    sample = module.MaskSample({"a.png": cells, "b.png": np.zeros((20, 32))}, (0.2, 1.0), "")
    regions = module.empty_regions(scene, sample=sample)
    assert regions.mean == pytest.approx((9 / 25 + 0.5) / 2)  # b.png has nothing that counts
    assert regions.worst_name == "c.png"
    assert module.mask_statistics(scene, sample) == module.MaskStatistics(2, 0.6, "")


def _statistics(num_points, isolated, duplicates=0):
    three, five = (0.0,) * 3, (1.0,) * 5
    return module.CloudStatistics(num_points, 0, duplicates, isolated, five, three, three, 0.0)


def test_problems_list_those_of_the_reader_first(rng):
    own = Finding("of-the-reader", "The reader's.")
    scene = _scene(rng.random((5, 3)), findings=(own,))
    sound = module.find_problems(scene, _statistics(1000, 1), module.EmptyRegions(0.1, 0.9, "a"))
    assert sound == (own,)
    first, *others = module.find_problems(
        scene, _statistics(1000, 100), module.EmptyRegions(0.8, 0.9, "a")
    )
    assert first == own
    assert [each.kind for each in others] == ["isolated-points", "empty-regions"]
    assert [each.text.split()[0] for each in others] == ["100", "80%"]
    (repeats,) = module.find_problems(_scene(rng.random((5, 3))), _statistics(1000, 100, 200), None)
    assert repeats.text.startswith("100 points (12.5%)")  # of those that are left
    assert module.find_problems(_scene([]), _statistics(0, 0), None)[0].kind == "no-points"


def test_depth_maps_are_described_by_a_sample(room):
    assert module.depth_map_statistics(room) is None
    values = np.ones((12, 16), np.float32)
    values[:3] = np.nan
    levels = np.repeat(np.array([0, 1, 2, 2], np.uint8), 3)[:, None] * np.ones(16, np.uint8)
    maps = {image.name: DepthMap(values, confidence=levels) for image in room.images}
    found = module.depth_map_statistics(room.with_depths(maps))
    assert found == module.DepthMapStatistics(
        len(room.images), 16, 12, 0.75, (0.25, 0.25, 0.5), in_scene_units=False
    )
