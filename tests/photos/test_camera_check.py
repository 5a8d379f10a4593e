"""What cameras see: the near depth and stray cameras, on made-up captures."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from splatseed.camera import Camera
from splatseed.photos.camera_check import check_cameras, stray_findings, stray_views
from splatseed.photos.view import NO_PIXELS, View
from splatseed.photos.viewpoint import look_at
from splatseed.splat.training_frame import NEAR_SHARE, training_frame

K = np.array([[140.0, 0, 80], [0, 140.0, 60], [0, 0, 1]])
UP = np.array([0.0, 0.0, 1.0])
NO_POINTS = np.empty((0, 3))


def _view(name, eye, target):
    pose = look_at(np.asarray(eye, float), np.asarray(target, float), UP)
    return View(name, NO_PIXELS, Camera(K, 160, 120, pose))


def _station(rng, at=(0.0, 0.0, 0.0), count=12, depth=3.0, points=300):
    """Cameras on a short path before a rough wall, and its points; lengths go with ``depth``."""
    at, ahead = np.asarray(at, float), np.array([0, depth, 0])
    names = [f"{at[0]:g} {at[2]:g} {i:02}" for i in range(count)]
    eyes = at + depth / 3 * np.stack([np.linspace(-1, 1, count), *np.zeros((2, count))], axis=1)
    views = [_view(n, eye, at + ahead) for n, eye in zip(names, eyes, strict=True)]
    wall = rng.uniform(-1, 1, (points, 3)) * [2, 0.5, 1.5] * depth / 3
    return views, at + ahead + wall


def _far(kind, count, rng):
    """Cameras of wrong poses, about a thousand times as far as the others stand apart."""
    where = np.array([900.0, -700.0, 300.0])
    eyes = {
        "in one place": np.tile(where, (count, 1)),
        "close to each other": where + rng.normal(0, 0.1, (count, 3)),
        "everywhere": 1000 * rng.normal(size=(count, 3)),
    }.get(kind, 1000 * rng.normal(size=(count, 3)))
    aims = np.zeros(3) if kind == "facing the scene" else 5000 * rng.normal(size=(count, 3))
    targets = np.broadcast_to(aims, eyes.shape)
    return [_view(f"far {i}", *at) for i, at in enumerate(zip(eyes, targets, strict=True))]


@pytest.mark.parametrize("count", [1, 2, 5, 11])
@pytest.mark.parametrize(
    "kind", ["in one place", "close to each other", "everywhere", "facing the scene"]
)
def test_strays_are_named_and_change_neither_scale_nor_near_plane(kind, count, rng):
    """Two of twelve once made all others' pictures black; eleven of 23 are fewer than half."""
    views, xyz = _station(rng)
    far = _far(kind, count, rng)
    expected, frame = training_frame(views, xyz), training_frame([*far, *views], xyz)
    assert frame.strays == tuple(view.name for view in far)
    assert (frame.near, frame.scale) == (expected.near, expected.scale)
    np.testing.assert_array_equal(frame.origin, expected.origin)


@pytest.mark.parametrize("place", [(1e6, 0, 0), (0, 1e6, 0), (0, -1e6, 1e5)])
def test_a_few_distant_points_change_nothing(place, rng):
    """Also where cameras, or a stray one, look at them."""
    views, xyz = _station(rng)
    stray = _view("stray", np.array(place) * 0.9, place)
    more = np.concatenate([xyz, np.tile(place, (2, 1)) * [[1.0], [1.01]]])
    for seen in (views, [*views, stray]):
        before, after = check_cameras(seen, xyz), check_cameras(seen, more)
        assert after.strays.tolist() == before.strays.tolist()
        assert after.near_depth == pytest.approx(before.near_depth, rel=0.02)


def test_valid_captures_have_no_strays(rng):
    room, other = _station(rng), _station(rng, (80, 0, 0), count=5, points=60)
    drone = [_view(f"d{i}", (20 * i, -300, 500), (20 * i, 0, 0)) for i in range(5)]
    ground = rng.uniform(-300, 300, (2000, 3)) * [1, 1, 0]
    sky = _view("sky", (0.1, 0, 0.0), (0.1, 0.1, 50))
    close = _view("close", (0, 2.4, 0), (0, 3, 0))
    walk = [_station(rng, (800.0 * i, 0, 0), count=6) for i in range(4)]
    captures = {
        "two rooms": ([*room[0], *other[0]], [room[1], other[1]]),
        "drone and ground": ([*room[0], *drone], [room[1], ground]),
        "one that looks at the sky, a close-up": ([*room[0], sky, close], [room[1]]),
        "long walk": ([view for views, _ in walk for view in views], [xyz for _, xyz in walk]),
        "few cameras": (room[0][:2], [room[1]]),
        "nothing known but one place": ([room[0][0]] * 6, [np.zeros((0, 3))]),
    }
    for name, (views, clouds) in captures.items():
        assert stray_views(views, np.concatenate(clouds)) == (), name


@pytest.mark.parametrize("step", [1.0, 200.0, 800.0, 1e5])
def test_the_near_plane_follows_visible_depths_not_camera_distances(step, rng):
    views, xyz = _station(rng)
    moved = np.array([step, 0, 0])
    other = []
    for view in views:
        pose = view.cam_from_world.copy()
        pose[:3, 3] -= pose[:3, :3] @ moved
        other.append(dataclasses.replace(view.posed(pose), name=f"{view.name}'"))
    frame = training_frame([*views, *other], np.concatenate([xyz, xyz + moved]))
    here = training_frame(views, xyz)
    assert frame.near / frame.scale <= here.near / here.scale * (1 + 1e-9)
    assert frame.near / frame.scale > 0.8 * here.near / here.scale


def test_the_near_plane_lies_between_the_lens_and_the_nearest_surface(rng):
    """A macro path beside a far wall, and a drone over ground photographs."""
    small = [_station(rng, (0.05 * i, 0, 0), count=2, depth=1e-3) for i in range(20)]
    wall = _station(rng, depth=3.0)
    frame = training_frame(
        [*wall[0], *(view for views, _ in small for view in views)],
        np.concatenate([wall[1], *(xyz for _, xyz in small)]),
    )
    assert not frame.strays
    assert 1e-6 < frame.near / frame.scale < 1e-4
    # A tenth of the points is ten times nearer than the others, and a few are in the lens.
    views, xyz = _station(rng, points=1000)
    some = np.arange(1000) % 10 < 1
    xyz[some] *= 0.1
    xyz[::50] *= 1e-3 / 3
    near = training_frame(views, xyz).near / training_frame(views, xyz).scale
    assert 1e-3 < near < 0.1
    far = _station(rng, depth=500.0)
    flat = training_frame([v for v in far[0] if int(v.name[-2:]) in {5, 6}], far[1])
    assert NEAR_SHARE * 300 < flat.near / flat.scale < NEAR_SHARE * 500


def test_near_depth_and_strays_follow_similarities(rng):
    views, xyz = _station(rng)
    views = [*views, *_far("everywhere", 3, rng)]
    turn, shift = np.linalg.qr(rng.normal(size=(3, 3)))[0], rng.normal(size=3)
    turn *= np.linalg.det(turn)
    for scale in (1e-3, 7.0, 1e4):
        moved = []
        for view in views:
            pose = view.cam_from_world.copy()
            # x' = scale R x + shift: the same picture from cam_from_world' = [A R' | s t - A R' b]
            pose[:3, :3] = view.cam_from_world[:3, :3] @ turn.T
            pose[:3, 3] = scale * view.cam_from_world[:3, 3] - pose[:3, :3] @ shift
            moved.append(view.posed(pose))
        before, after = (
            check_cameras(views, xyz),
            check_cameras(moved, scale * xyz @ turn.T + shift),
        )
        assert after.strays.tolist() == before.strays.tolist()
        assert after.near_depth == pytest.approx(scale * before.near_depth, rel=1e-6)


def test_without_points_one_camera_in_ten_can_be_a_stray(rng):
    """A stereo pair and one wide view, say, or a close-up and a distant flight, have none."""
    views, _ = _station(rng)
    far = _far("close to each other", 3, rng)
    assert stray_views(views, NO_POINTS) == ()
    for count in range(4):
        assert stray_views([*views[:count], far[0]], NO_POINTS) == ()
    assert stray_views([*views[:10], far[0]], NO_POINTS) == ("far 0",)
    assert stray_views([*views, *far], NO_POINTS) == ()
    assert check_cameras(views, NO_POINTS).near_depth is None


def test_one_note_names_all_strays():
    assert stray_findings(()) == ()
    assert "The camera of a is far" in stray_findings("a")[0].text
    (note,) = stray_findings("abcdefgh")
    assert note.text.endswith("leave them out (a, b, c, d, e and 3 more).")
