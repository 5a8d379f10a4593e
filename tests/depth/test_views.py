"""Which pixels are drawn of a map; what other views say of a point, and how maps come to agree."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from splatseed.camera import Camera
from splatseed.depth.alignment import Alignment
from splatseed.depth.comparison import choose_neighbors, find_support, synchronize_scales
from splatseed.depth.settings import DepthSettings
from splatseed.depth.views import DepthView, Reduced, pixels_within, sample_pixels
from splatseed.depthmap import DepthMap
from splatseed.progress import silent

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
GRAY = np.full((HEIGHT, WIDTH, 3), 120, np.uint8)


def camera_at(x, y=0.0, z=0.0, *, turn=0.0):
    """A camera at a place, looking along z, turned about y."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1.0]])
    pose = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    pose[:3, :3] = [[c, 0, -s], [0, 1, 0], [s, 0, c]]
    pose[:3, 3] = -pose[:3, :3] @ (x, y, z)
    return Camera(K, WIDTH, HEIGHT, pose)


def wall(camera, distance=2.0):
    """Planar depth of the plane z = distance, float32 [H, W]."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.cam_from_world[:3, :3]
    t = (distance - camera.center[2]) / rays[..., 2]
    return np.where(t > 0, t, np.nan).astype(np.float32)


def reduced(camera, z, rgb=GRAY):
    """A copy that is not reduced at all."""
    grid = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    matrix = grid @ camera.K @ camera.cam_from_world[:3]
    return Reduced(z, 1.0, matrix, rgb, np.array([[1, 0.5], [1, 0.5]]))


def view(camera, z, rgb=GRAY, factor=1.0):
    """A view with every known pixel as a candidate, its map wrong by a factor."""
    z = (z * factor).astype(np.float32)
    pixel, copy = np.flatnonzero(z > 0), reduced(camera, z, rgb)
    drawn = (pixel, z.ravel()[pixel], rgb.reshape(-1, 3)[pixel], np.zeros(len(pixel), bool))
    return DepthView(Alignment(1.0, 0.0, 100, 0.05), camera, *drawn, exhausted=False, reduced=copy)


def test_a_map_pixel_is_valid_only_if_the_mask_covers_all_of_it():
    mask, shown = np.ones((50, 80), bool), np.ones((7, 10), bool)
    mask[31, 47], shown[31 * 7 // 50, 47 * 10 // 80] = False, False
    kinds = (DepthMap(np.ones((7, 10), np.float32)), DepthMap(np.ones((100, 160), np.float32)))
    np.testing.assert_array_equal(pixels_within(mask, kinds[0]), shown)
    assert np.argwhere(~pixels_within(mask, kinds[1])).tolist() == [
        [row, column] for row in (62, 63) for column in (94, 95)
    ]


POINTS = np.array(
    [
        [0.0, 0.0, 2.0],  # on the wall
        [0.1, 0.2, 2.03],  # within 2%
        [0.1, 0.2, 2.3],  # behind
        [0.1, 0.2, 1.7],  # in front: the wall is seen through it
        [9.0, 0.0, 2.0],  # beside the frame
        [0.0, 0.0, -2.0],  # behind the camera
    ],
    np.float32,
)
CONFIRMED = [1, 1, 0, 0, 0, 0]
THROUGH = [0, 0, 0, 1, 0, 0]


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_a_view_confirms_occludes_or_sees_through(unit):
    camera = camera_at(0.05 * unit)
    other = reduced(camera, wall(camera, 2.0 * unit))
    agreeing, seen_through = find_support(
        POINTS * np.float32(unit), other, [other], DepthSettings()
    )
    np.testing.assert_array_equal(agreeing, CONFIRMED)
    np.testing.assert_array_equal(seen_through, THROUGH)


def test_a_view_of_another_color_confirms_nothing():
    camera = camera_at(0.0)
    own = reduced(camera, wall(camera))
    for change, agrees in ((30, 1), (60, 0)):
        other = reduced(camera, wall(camera), GRAY + np.uint8(change))
        (agreeing,), (seen_through,) = find_support(POINTS[:1], own, [other], DepthSettings())
        assert (agreeing, seen_through) == (agrees, False)
        assert find_support(POINTS[:1], own, [other], DepthSettings(color_tolerance=None))[0][0]


def test_unknown_depth_decides_nothing():
    camera = camera_at(0.0)
    nothing = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    own = reduced(camera, nothing)
    assert not np.any(find_support(POINTS, own, [own], DepthSettings()))
    half = wall(camera)
    half[:, ::2] = np.nan  # beside the unknown, known pixels may confirm but not look through
    own = reduced(camera, half)
    agreeing, seen_through = find_support(POINTS, own, [own], DepthSettings())
    np.testing.assert_array_equal(agreeing, CONFIRMED)
    assert not seen_through.any()


def test_neighbors_see_the_same_surface_from_another_angle():
    cameras = [
        camera_at(0.0),
        camera_at(0.001),  # coincides: confirms little
        camera_at(0.6),  # 17 degrees aside
        camera_at(0.3, 0.2),
        camera_at(0.0, 0.0, 4.0, turn=np.pi),  # looks at the other side of the wall
        camera_at(50.0),  # sees nothing of it
    ]
    views = [view(camera, wall(camera)) for camera in cameras]
    neighbors = choose_neighbors(views, 4, silent)
    assert neighbors.shape == (6, 4)
    assert neighbors[0].tolist()[:2] == [2, 3]
    assert neighbors[0].tolist()[2] == 1
    assert neighbors[0].tolist()[3] == -1  # neither 4 nor 5, nor itself
    assert (neighbors[5] == -1).all()
    assert (choose_neighbors(views[:1], 3, silent) == -1).all()


def test_scales_are_synchronised():
    """Ten cameras before a wall and a nearer one beside it, each map wrong by a factor of its
    own."""
    rng = np.random.default_rng(0)
    cameras = [camera_at(*xy) for xy in rng.uniform(-0.4, 0.4, (10, 2))]
    factors = np.exp(rng.normal(scale=0.05, size=10))
    factors /= np.exp(np.log(factors).mean())
    views = [
        view(camera, np.where(np.arange(WIDTH) < 20, 0.7, 1.0) * wall(camera), factor=factor)
        for camera, factor in zip(cameras, factors, strict=True)
    ]
    corrections = synchronize_scales(views, choose_neighbors(views, 6, silent), silent)
    left = np.log(corrections * factors)
    assert np.abs(left - left.mean()).max() < 0.01 < np.abs(np.log(factors)).max()
    assert abs(left.mean()) < 0.02


# Pixels ------------------------------------------------------------------------------------------

SHAPE = (60, 80)
NOWHERE = np.empty((0, 2))
PLAIN = DepthSettings(placement="uniform", edge_tolerance=None)


def slanted(rng, holes=0.2):
    """A slanted plane, 1 / depth linear in the image, with holes."""
    row, column = np.indices(SHAPE)
    values = (1.0 / (0.5 + 0.004 * column - 0.003 * row)).astype(np.float32)
    values[rng.random(SHAPE) < holes] = np.nan
    return values


@pytest.mark.parametrize("placement", ["uniform", "empty"])
@pytest.mark.parametrize("num", [1, 100, 3000, 10_000])
def test_pixels_are_known_and_distinct(placement, num, rng):
    values = slanted(rng)
    points = rng.uniform(0, SHAPE[::-1], (40, 2))
    settings = DepthSettings(placement=placement)
    pixel, edge = sample_pixels(values, num, points, settings, rng)
    known = int((values > 0).sum())
    assert min(num, known) <= len(pixel) <= max(1.2 * num + 2, known)
    assert len(np.unique(pixel)) == len(pixel) == len(edge)
    assert (values.ravel()[pixel] > 0).all()


def test_pixels_are_drawn_far_from_points(rng):
    values = slanted(rng, holes=0.0)
    points = np.stack([rng.uniform(0, 40, 500), rng.uniform(0, 60, 500)], axis=1)  # the left half
    mean = {}
    for placement in ("uniform", "empty"):
        settings = DepthSettings(placement=placement, edge_tolerance=None)
        pixel = sample_pixels(values, 400, points, settings, rng)[0]
        row, column = np.divmod(pixel, SHAPE[1])
        mean[placement] = cKDTree(points).query(np.stack([column, row], axis=1))[0].mean()
        if placement == "empty":
            assert 0 < (column < 40).mean() < 0.35
    assert mean["empty"] > 1.25 * mean["uniform"]


@pytest.mark.parametrize("radius", [1, 3])
def test_pixels_avoid_depth_discontinuities(radius, rng):
    values = slanted(rng, holes=0.0)
    values[:, 40:] *= 1.1
    values[30:, :20] *= 0.9
    settings = DepthSettings(placement="uniform", edge_radius=radius)
    pixel, edge = sample_pixels(values, 1500, NOWHERE, settings, rng)
    row, column = np.divmod(pixel, SHAPE[1])
    assert not edge.any()
    assert not ((column >= 40 - radius) & (column < 40 + radius)).any()
    assert not ((row >= 30 + radius) & (column >= 20 - radius) & (column < 20 + radius)).any()
    assert not ((column < 20 - radius) & (row >= 30 - radius) & (row < 30 + radius)).any()
    plain = np.divmod(sample_pixels(values, 1500, NOWHERE, PLAIN, rng)[0], SHAPE[1])[1]
    assert ((plain >= 40 - radius) & (plain < 40 + radius)).any()


def test_pixels_with_mostly_unknown_surroundings_come_last(rng):
    values = slanted(rng, holes=0.0)
    values[:, 40:] = np.nan
    values[::6, 43:79:6] = 2.0  # sparse, as a lidar's
    settings = DepthSettings(placement="uniform")
    known = int((values > 0).sum())
    some, _ = sample_pixels(values, known // 2, NOWHERE, settings, rng)
    assert (some % 80 < 40).all()
    every, edge = sample_pixels(values, known, NOWHERE, settings, rng)
    assert len(every) == known
    assert edge[every % 80 > 40].all()
