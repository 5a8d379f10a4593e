"""What other views say of a point, which of them are asked, and how their maps are made to
agree."""

from __future__ import annotations

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.depth.alignment import Alignment, PlanarDepth
from splatseed.depth.comparison import choose_neighbors, find_support, synchronize_scales
from splatseed.depth.settings import Settings
from splatseed.depth.views import DepthView, Reduced
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
    pixel = np.flatnonzero(z > 0)
    return DepthView(
        Alignment(1.0, 0.0, 100, 0.05),
        camera,
        pixel,
        z.ravel()[pixel],
        rgb.reshape(-1, 3)[pixel],
        np.zeros(len(pixel), bool),
        exhausted=False,
        reduced=reduced(camera, z, rgb),
    )


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
def test_a_view_confirms_hides_or_looks_through(unit):
    camera = camera_at(0.05 * unit)
    other = reduced(camera, wall(camera, 2.0 * unit))
    support = find_support(POINTS * np.float32(unit), other, [other], Settings())
    np.testing.assert_array_equal(support.agreeing, CONFIRMED)
    np.testing.assert_array_equal(support.seen_through, THROUGH)


def test_a_view_of_another_color_confirms_nothing():
    camera = camera_at(0.0)
    own = reduced(camera, wall(camera))
    for change, agrees in ((30, 1), (60, 0)):
        other = reduced(camera, wall(camera), GRAY + np.uint8(change))
        support = find_support(POINTS[:1], own, [other], Settings())
        assert (support.agreeing[0], support.seen_through[0]) == (agrees, False)
        assert find_support(POINTS[:1], own, [other], Settings(color_tolerance=None)).agreeing[0]


def test_what_a_view_does_not_know_says_nothing():
    camera = camera_at(0.0)
    nothing = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    support = find_support(POINTS, reduced(camera, nothing), [reduced(camera, nothing)], Settings())
    assert not support.agreeing.any()
    assert not support.seen_through.any()
    half = wall(camera)
    half[:, ::2] = np.nan  # beside the unknown, known pixels may confirm but not look through
    support = find_support(POINTS, reduced(camera, half), [reduced(camera, half)], Settings())
    np.testing.assert_array_equal(support.agreeing, CONFIRMED)
    assert not support.seen_through.any()


def test_neighbors_see_the_same_from_another_side():
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


def test_maps_are_scaled_to_agree():
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


def test_planar_depth_knows_every_kind():
    camera = camera_at(0.0)
    z = wall(camera, 3.0) + np.linspace(0, 1, WIDTH, dtype=np.float32)
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    length = np.sqrt(((column - 32) / FOCAL) ** 2 + ((row - 24) / FOCAL) ** 2 + 1)
    kinds = {"z": (z / 2, 0.0), "ray": (z * length / 2, 0.0), "inverse": ((1 / z - 0.1) / 2, 0.1)}
    for kind, (values, shift) in kinds.items():
        depth = DepthMap(values.astype(np.float32), kind)
        planar = PlanarDepth.of(depth, camera, 2.0, shift, unit_ray=False)
        np.testing.assert_allclose(planar.whole(), z, rtol=2e-6)
        np.testing.assert_allclose(planar.every(1, 3) * planar.scale, z[1::3, 1::3], rtol=2e-6)
        np.testing.assert_allclose(planar.at(np.array([0, 70])), [z[0, 0], z[1, 6]], rtol=2e-6)
    behind = DepthMap(np.full((HEIGHT, WIDTH), -1.0, np.float32), "inverse")
    assert np.isnan(PlanarDepth.of(behind, camera, 1.0, 0.5, unit_ray=False).whole()).all()
