"""Which points a run starts from, and their near depths: against a literal loop."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings as hypothesis_settings, strategies as st

torch = pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene, write_scene
from splatseed.io.staging import MANIFEST
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.splat.gaussians import initial_gaussians
from splatseed.train.parameters import make_optimizers, make_parameters, optimize
from splatseed.train.schedule import make_schedule
from splatseed.train.seeds import (
    MARGIN,
    NEAREST,
    near_depths,
    seeded,
    seeds_digest,
    usable_seeds,
)
from splatseed.train.settings import TrainSettings
from splatseed.views.view import View, load_split

ORIGINALS, NEW = 40, 60


@pytest.fixture
def points(rng) -> PointCloud:
    xyz = rng.normal(size=(ORIGINALS + NEW, 3))
    source = np.repeat([0, 4], [ORIGINALS, NEW]).astype(np.uint8)
    return PointCloud(xyz, np.zeros((ORIGINALS + NEW, 3), np.uint8), source)


def thinned(
    points: PointCloud, cap: int, seed: int = 0, **settings
) -> tuple[PointCloud, list[str]]:
    notes: list[str] = []
    asked = TrainSettings(cap_max=cap, seed=seed, **settings)
    return usable_seeds(points, asked, notes.append), notes


def test_more_than_the_cap_are_thinned_and_told_of(points):
    for strategy, most in (("default", 49), ("none", 70)):  # default adds the rest
        seeds, notes = thinned(points, 70, strategy=strategy)
        assert len(seeds) == most
        assert np.isin(seeds.xyz, points.xyz).all()
        assert f"100 seeds were thinned to {most}, {seeds.num_original} of them" in notes[0]
        assert np.array_equal(thinned(points, 70, seed=1, strategy=strategy)[0].xyz, seeds.xyz)


def test_what_crowds_goes_first(points):
    """Of pairs a hair apart one stays each, the original."""
    xyz = np.concatenate([points.xyz[:ORIGINALS], points.xyz[:ORIGINALS] + np.float32(1e-4)])
    source = np.repeat([0, 4], ORIGINALS).astype(np.uint8)
    pairs = PointCloud(xyz, np.zeros((2 * ORIGINALS, 3), np.uint8), source)
    seeds, _ = thinned(pairs, ORIGINALS, strategy="none")
    assert np.array_equal(seeds.xyz, points.xyz[:ORIGINALS])


def test_originals_are_asked_first_wherever_they_stand(points):
    mixed = points.select(np.random.default_rng(0).permutation(len(points)))
    one, other = (thinned(each, 50)[0] for each in (points, mixed))
    assert one.num_original == other.num_original


def test_points_that_are_not_finite_are_left_out_and_told_of(points):
    xyz = points.xyz.copy()
    xyz[3] = np.nan
    seeds, notes = thinned(points.replace(xyz=xyz), 1000)
    assert len(seeds) == ORIGINALS + NEW - 1
    assert len(notes) == 1


@pytest.fixture
def known(points) -> PointCloud:
    """The points with a size that follows from the position, normals of some, and confidence."""
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    normals[::3] = np.nan
    sizes = np.abs(points.xyz[:, 0])
    return points.replace(normals=normals, sizes=sizes, confidence=np.ones(len(points)))


def test_of_what_is_known_only_what_is_asked_for_has_a_part(known, points):
    begun = {
        names: usable_seeds(known, TrainSettings(**dict.fromkeys(names, True)), print)
        for names in ((), ("seed_sizes",), ("seed_normals",), ("seed_sizes", "seed_normals"))
    }
    assert [sorted(seeds.attributes) for seeds in begun.values()] == [
        *([], ["sizes"], ["normals"], ["normals", "sizes"])
    ]
    digests = [seeds_digest(seeds) for seeds in begun.values()]
    assert len(set(digests)) == 4
    assert digests[0] == seeds_digest(points)
    few = usable_seeds(known, TrainSettings(cap_max=55, seed_sizes=True), lambda _: None)
    np.testing.assert_array_equal(few.sizes, np.abs(few.xyz[:, 0]))


def test_asking_for_what_is_not_known_is_told(points):
    notes: list[str] = []
    unknown = points.replace(sizes=np.full(len(points), np.nan))
    usable_seeds(unknown, TrainSettings(seed_sizes=True, seed_normals=True), notes.append)
    assert [note.split()[0] for note in notes] == ["seed_sizes", "seed_normals"]


def test_a_plain_scene_is_seeded_on_request_and_the_user_told(room):
    notes: list[str] = []
    asked = TrainSettings(seeding="auto")
    scene, stereo = seeded(room, asked, "cpu", notes.append, silent)
    assert len(scene.points) > len(room.points)
    assert np.array_equal(scene.points.originals.xyz, room.points.xyz)
    assert [view.name for view in stereo.views] == [image.name for image in room.split(8)[0]]
    assert "--seeds scene" in notes[-1]
    bounded = TrainSettings(seeding="auto", strategy="none", cap_max=len(room.points) + 10)
    few = seeded(room, bounded, "cpu", notes.append, silent)[0].points
    assert len(few) == len(room.points) + 10
    empty = room.replace(points=room.points.select(slice(0)), tracks=None)
    assert len(seeded(empty, asked, "cpu", notes.append, silent)[0].points)
    assert "--seeds scene" not in notes[-1]  # there are none to begin with


def test_what_upsample_only_thinned_is_left_alone(room, tmp_path):
    write_scene(room.replace(points=room.points.select(slice(100))), tmp_path / "thin")
    thin, asked = load_scene(tmp_path / "thin"), TrainSettings(seeding="auto")
    (tmp_path / "thin" / MANIFEST).write_text('{"command": "upsample"}')
    assert seeded(thin, asked, "cpu", print, silent) == (thin, None)
    (tmp_path / "thin" / MANIFEST).write_text('{"command": "sfm"}')
    assert len(seeded(thin, asked, "cpu", lambda _: None, silent)[0].points) > len(thin.points)


@pytest.mark.parametrize(
    "settings", [{}, {"seeding": "auto", "strategy": "default-3dgs"}, {"seeding": "auto"}]
)
def test_other_points_are_left_alone(settings, room):
    """Those that are to stay, of 3DGS's conventions, and those that splatseed has added to."""
    touched = room.replace(
        points=room.points.replace(source=np.full(len(room.points), 4, np.uint8))
    )
    scene = touched if settings == {"seeding": "auto"} else room
    notes: list[str] = []
    assert seeded(scene, TrainSettings(**settings), "cpu", notes.append, silent) == (scene, None)
    assert not notes


def _literal(xyz, views):
    """Point by point and view by view."""
    depths = np.full(len(xyz), np.nan)
    for i, point in enumerate(xyz):
        for view in views:
            x, y, z = (view.cam_from_world @ [*point, 1.0])[:3]
            if z <= NEAREST:
                continue
            u, v, _ = view.K @ [x / z, y / z, 1.0]
            across = -MARGIN * view.width <= u <= (1 + MARGIN) * view.width
            if across and -MARGIN * view.height <= v <= (1 + MARGIN) * view.height:
                depths[i] = np.fmin(depths[i], z)
    return np.where(np.isnan(depths), np.nanmedian(depths), depths)


def _view(center, width=64, height=48):
    cam_from_world = np.eye(4)
    cam_from_world[:3, 3] = -np.asarray(center, float)
    K = np.array([[60.0, 0, width / 2], [0, 50.0, height / 2], [0, 0, 1]])
    return View("", np.empty((0, 0, 3), np.uint8), K, width, height, cam_from_world)


def test_they_are_what_a_literal_loop_finds(room, rng):
    train, _ = load_split(room)
    xyz = np.concatenate([room.points.xyz[::20], rng.normal(scale=5.0, size=(50, 3))])
    assert np.allclose(near_depths(xyz, train), _literal(xyz, train), rtol=1e-5)


def test_the_nearest_view_that_sees_a_point_counts():
    views = [_view([0, 0, 0]), _view([0, 0, 2.0]), _view([30.0, 0, 3.9])]
    xyz = np.array([[0, 0, 4.0], [0, 0, 1.0], [0, 0, -5.0]])
    # The third point is behind all cameras: the median of the others.
    assert near_depths(xyz, views).tolist() == [2.0, 1.0, 1.5]
    assert near_depths(xyz[2:], views).tolist() == [1.0]


def test_many_views_are_sampled_evenly(monkeypatch):
    views = [_view([0, 0, -0.01 * i]) for i in range(1000)]
    one = np.array([[0, 0, 1.0]])
    assert near_depths(one, views[::-1])[0] == pytest.approx(1.0)
    monkeypatch.setattr("splatseed.train.seeds.MOST_PROJECTIONS", 1)
    assert near_depths(one, views)[0] == pytest.approx(1.0)  # the first is among those asked
    assert near_depths(one, views[1:] + views[:1])[0] == pytest.approx(1.0)  # and the last


@hypothesis_settings(deadline=None, max_examples=30)
@given(
    shift=st.floats(-100, 100), scale=st.floats(0.1, 10), seed=st.integers(0, 99)
)  # fmt: skip
def test_they_scale_with_the_scene_and_do_not_move_with_it(shift, scale, seed):
    rng = np.random.default_rng(seed)
    xyz, center = rng.uniform([-1, -1, 3], [1, 1, 5], (20, 3)), rng.normal(size=3)
    here = near_depths(xyz, [_view([0, 0, 0]), _view(center)])
    there = near_depths(
        scale * xyz + shift, [_view([shift] * 3), _view(scale * center + shift)]
    )  # fmt: skip
    assert np.allclose(there, scale * here, rtol=1e-3)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_whatever_adds_or_moves_gaussians_hands_them_on(begin, strategy):
    run = begin(strategy=strategy, max_steps=60, cap_max=3000)
    first = set(run.state.params["near_depths"].tolist())
    count = len(run.state.params["means"])
    run.train()
    lengths = run.state.params["near_depths"]
    assert len(lengths) == len(run.state.params["means"]) > count
    assert set(lengths.tolist()) <= first
    assert not lengths.requires_grad


def test_steps_of_positions_are_in_near_depths(room):
    """Adam's first step is the learning rate, whatever the gradient."""
    gaussians = initial_gaussians(room.points)
    lengths = np.linspace(0.1, 9.0, len(gaussians)).astype(np.float32)
    params = make_parameters(gaussians, torch.device("cpu"), lengths)
    optimizers = make_optimizers(params, make_schedule("none", 100, as_3dgs=False))
    for value in params.values():
        value.grad = torch.ones_like(value) if value.requires_grad else None
    optimize(params, optimizers, dict.fromkeys(optimizers, 1e-2))
    moved = gaussians.means - params["means"].detach().numpy()
    assert np.allclose(moved, 1e-2 * lengths[:, None], rtol=1e-3, atol=1e-6)
    changed = gaussians.scales - params["scales"].detach().numpy()
    assert np.allclose(changed, 1e-2, rtol=1e-3)


def test_small_steps_of_far_positions_are_not_lost(room):
    """At the end of a full run a step is far below the last digit of a far position's own."""
    rate, far = 1.6e-6, 100.0
    gaussians = initial_gaussians(room.points)
    away = dataclasses.replace(gaussians, means=np.full_like(gaussians.means, far))
    params = make_parameters(away, torch.device("cpu"), np.full(len(away), far, np.float32))
    optimizers = make_optimizers(params, make_schedule("none", 100, as_3dgs=False))
    for _ in range(50):
        for value in params.values():
            value.grad = torch.ones_like(value) if value.requires_grad else None
        optimize(params, optimizers, dict.fromkeys(optimizers, rate))
    moved = far - params["means"].detach().double()
    assert float(moved.mean()) == pytest.approx(50 * rate * far, rel=0.05)
