"""Seeds to Gaussians, their .ply, and the training frame."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.camera import rotation_from_quat
from splatseed.errors import PointCloudError, SceneFormatError
from splatseed.io.ply import read_ply, write_ply
from splatseed.pointcloud import PointCloud
from splatseed.splat.formats import read_model, write_model
from splatseed.splat.gaussians import (
    SH_C0,
    Gaussians,
    initial_gaussians,
    neighbor_distances,
    stray_views,
    training_frame,
)
from splatseed.views.view import load_split


def _random(rng, count, degree=3):
    shapes = {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "opacities": (),
        "sh0": (1, 3),
        "shN": ((degree + 1) ** 2 - 1, 3),
    }
    return Gaussians(
        **{k: rng.normal(size=(count, *s)).astype(np.float32) for k, s in shapes.items()}
    )


def _assert_equal(a, b):
    for name, array in a.arrays().items():
        assert array.shape == b.arrays()[name].shape
        assert array.tobytes() == np.ascontiguousarray(b.arrays()[name]).tobytes(), name


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_ply_round_trip_is_exact(tmp_path, rng, degree):
    gaussians = _random(rng, 17, degree)
    write_model(tmp_path / "g.ply", gaussians)
    _assert_equal(gaussians, read_model(tmp_path / "g.ply"))


def test_ply_has_the_layout_of_3dgs(tmp_path, rng):
    gaussians = _random(rng, 2)
    write_model(tmp_path / "g.ply", gaussians)
    header, body = (tmp_path / "g.ply").read_bytes().split(b"end_header\n")
    names = [line.split()[-1].decode() for line in header.splitlines() if b"property" in line]
    assert names == (
        ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
        + [f"f_rest_{i}" for i in range(45)]
        + ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    )
    row = np.frombuffer(body, "<f4").reshape(2, 62)[1]
    assert np.array_equal(row[9:24], gaussians.shN[1, :, 0])  # all of red first
    assert np.array_equal(row[58:], gaussians.quats[1])


def test_ply_that_holds_no_gaussians_is_refused(tmp_path, rng):
    path = tmp_path / "g.ply"
    write_ply(path, PointCloud(rng.random((4, 3)), np.zeros((4, 3), np.uint8)))
    with pytest.raises(SceneFormatError, match="trained Gaussians"):
        read_model(path)
    write_model(path, _random(rng, 9))
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(SceneFormatError):
        read_model(path)
    broken = _random(rng, 9)
    broken.means[3, 1] = np.nan
    write_model(path, broken)
    with pytest.raises(SceneFormatError, match="Gaussian 3"):
        read_model(path)


def test_a_written_cloud_shows_the_seeds_colours(tmp_path, rng):
    seeds = PointCloud(rng.random((50, 3)), rng.integers(0, 256, (50, 3), np.uint8))
    write_model(tmp_path / "g.ply", initial_gaussians(seeds))
    assert np.array_equal(read_ply(tmp_path / "g.ply").rgb, seeds.rgb)


def test_initial_scale_is_the_distance_to_three_neighbours(rng):
    xyz = rng.random((200, 3))
    apart = np.linalg.norm(xyz[:, None] - xyz[None], axis=2)
    nearest = np.sort(apart, axis=1)[:, 1:4]
    expected = np.sqrt((nearest**2).mean(axis=1))
    assert np.allclose(neighbor_distances(xyz), expected, rtol=1e-5)
    gaussians = initial_gaussians(PointCloud(xyz, np.zeros((200, 3), np.uint8)), opacity=0.3)
    assert np.allclose(np.exp(gaussians.scales), expected[:, None], rtol=1e-5)
    assert np.allclose(1 / (1 + np.exp(-gaussians.opacities)), 0.3)
    assert np.allclose(gaussians.sh0 * SH_C0 + 0.5, 0.0, atol=1e-6)


def test_first_gaussians_are_no_larger_than_they_may_be(rng):
    cloud = PointCloud(rng.normal(size=(200, 3)), np.zeros((200, 3), np.uint8))
    free, largest = initial_gaussians(cloud), rng.uniform(0.01, 1.0, 200)
    held = initial_gaussians(cloud, largest=largest)
    expected = np.minimum(np.exp(free.scales), largest[:, None])
    assert np.allclose(np.exp(held.scales), expected, rtol=1e-5)
    assert 0 < (held.scales < free.scales).all(axis=1).sum() < 200


def test_first_gaussians_have_the_sizes_that_are_known(rng):
    xyz, sizes = rng.normal(size=(200, 3)), rng.uniform(1e-3, 10.0, 200)
    sizes[::3] = np.nan
    cloud = PointCloud(xyz, np.zeros((200, 3), np.uint8))
    largest = np.full(200, 5.0)
    free = initial_gaussians(cloud, scale_factor=0.5)
    told = initial_gaussians(cloud.replace(sizes=sizes), scale_factor=0.5, largest=largest)
    expected = np.where(np.isnan(sizes), np.exp(free.scales[:, 0]), np.minimum(0.5 * sizes, 5.0))
    assert np.allclose(np.exp(told.scales), expected[:, None], rtol=1e-5)


def test_first_gaussians_lie_flat_where_normals_are_known(rng):
    normals = rng.normal(size=(200, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[6::3] = np.nan
    cloud = PointCloud(rng.normal(size=(200, 3)), np.zeros((200, 3), np.uint8))
    balls, discs = initial_gaussians(cloud), initial_gaussians(cloud.replace(normals=normals))
    known = ~np.isnan(normals[:, 0])
    for i in np.flatnonzero(known):
        thin = rotation_from_quat(discs.quats[i])[:, 2]
        assert abs(thin @ normals[i]) == pytest.approx(1.0, abs=1e-6)
    assert np.allclose(np.linalg.norm(discs.quats, axis=1), 1.0, atol=1e-6)
    shrunk = np.exp(discs.scales - balls.scales)
    assert np.allclose(shrunk[known], [1.0, 1.0, 0.1])
    assert np.array_equal(discs.scales[~known], balls.scales[~known])
    assert np.array_equal(discs.quats[~known], balls.quats[~known])


@settings(deadline=None, max_examples=40)
@given(
    count=st.integers(1, 40),
    copies=st.integers(0, 30),
    far=st.sampled_from([0.0, 1e3, 1e6]),
    seed=st.integers(0, 99),
)
def test_initial_scales_are_finite_and_near_the_median(count, copies, far, seed):
    rng = np.random.default_rng(seed)
    xyz = np.concatenate([rng.normal(size=(count, 3)), np.zeros((copies, 3)), [[far, 0, 0]]])
    distinct = len(np.unique(xyz.astype(np.float32), axis=0))
    cloud = PointCloud(xyz, np.zeros((len(xyz), 3), np.uint8))
    if distinct < 2:
        with pytest.raises(PointCloudError, match="distinct"):
            initial_gaussians(cloud)
        return
    scales = initial_gaussians(cloud).scales
    assert np.isfinite(scales).all()
    assert np.ptp(scales) <= np.log(1000) + 1e-3


def test_the_frame_depends_on_cameras_alone_and_undoes_itself(room, rng):
    train, _ = load_split(room)
    frame = training_frame(train)
    centers = np.array([np.linalg.inv(frame.view(v).cam_from_world)[:3, 3] for v in train])
    assert np.allclose(centers.mean(axis=0), 0, atol=1e-9)
    assert np.linalg.norm(centers, axis=1).max() == pytest.approx(1.0)
    xyz = rng.normal(size=(20, 3))
    assert np.allclose(frame.points_to_world(frame.points_from_world(xyz)), xyz, atol=1e-5)
    gaussians = dataclasses.replace(_random(rng, 20), means=frame.points_from_world(xyz))
    world = frame.gaussians_to_world(gaussians)
    assert np.allclose(world.means, xyz, atol=1e-5)
    assert np.allclose(np.exp(world.scales) * frame.scale, np.exp(gaussians.scales), rtol=1e-5)


def test_sizes_shrink_with_the_frame(room):
    frame, count = training_frame(load_split(room)[0]), len(room.points)
    sizes = np.full(count, 0.3)
    sizes[1], sizes[2] = np.nan, 1e-38
    cloud = frame.cloud_from_world(room.points.replace(sizes=sizes))
    assert np.array_equal(cloud.xyz, frame.points_from_world(room.points.xyz))
    assert np.allclose(cloud.sizes[3:], 0.3 * frame.scale)
    assert np.isnan(cloud.sizes[1])
    assert cloud.sizes[2] > 0
    assert frame.cloud_from_world(room.points).sizes is None


def test_a_moved_camera_sees_moved_points_alike(room):
    (view, *_), _ = load_split(room)
    frame = training_frame(load_split(room)[0])
    moved = frame.view(view)
    for xyz in room.points.xyz[:10]:
        a = view.cam_from_world @ [*xyz, 1.0]
        b = moved.cam_from_world @ [*frame.points_from_world(xyz[None])[0], 1.0]
        assert np.allclose(b[:3] / b[2], a[:3] / a[2], atol=1e-5)


def test_cameras_in_one_place_keep_the_worlds_scale(room):
    (view, *_), _ = load_split(room)
    assert training_frame([view, view]).scale == 1.0


def _moved(view, center):
    """The view from another place, in the same direction."""
    cam_from_world = view.cam_from_world.copy()
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ center
    return dataclasses.replace(view, cam_from_world=cam_from_world)


@pytest.mark.parametrize("distance", [1e3, 1e6])
@pytest.mark.parametrize("stray", [0, 4])
def test_a_stray_camera_has_no_say_in_the_frame(room, stray, distance):
    train, _ = load_split(room)
    others = [view for i, view in enumerate(train) if i != stray]
    moved = list(train)
    moved[stray] = _moved(train[stray], np.array([0.0, distance, 0.0]))
    assert stray_views(train) == ()
    assert stray_views(moved) == (train[stray].name,)
    assert training_frame(moved).scale == training_frame(others).scale
    assert np.array_equal(training_frame(moved).origin, training_frame(others).origin)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_among_few_cameras_none_is_a_stray(room, count):
    """A stereo pair and one wide view, say."""
    train, _ = load_split(room)
    far = _moved(train[0], np.array([0.0, 1e6, 0.0]))
    assert stray_views([*train[1:count], far]) == ()


def test_two_camps_of_cameras_are_not_strays(room):
    """A close-up and a distant flight, say."""
    train, _ = load_split(room)
    far = [_moved(view, np.array([0.0, 1e3 + i, 0.0])) for i, view in enumerate(train[:3])]
    assert stray_views([*train, *far]) == ()
