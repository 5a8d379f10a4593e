"""Which points a run starts from, and their near depths: against a literal loop."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene, write_scene
from splatseed.io.regions import parse_region
from splatseed.io.staging import MANIFEST
from splatseed.photos.loading import load_split
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import silent
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.training.initialization import MARGIN, min_view_depths
from splatseed.training.parameters import make_optimizers, make_parameters, optimize
from splatseed.training.schedule import make_schedule
from splatseed.training.seeds import seeded, seeds_digest, usable_seeds
from splatseed.training.settings import TrainSettings
from splatseed.training.traits import STRATEGIES

ORIGINALS, NEW = 40, 60


@pytest.fixture
def points(rng) -> PointCloud:
    xyz = rng.normal(size=(ORIGINALS + NEW, 3))
    source = np.repeat([0, 4], [ORIGINALS, NEW]).astype(np.uint8)
    return PointCloud(xyz, np.zeros((ORIGINALS + NEW, 3), np.uint8), source)


def thinned(points: PointCloud, cap: int, **settings) -> tuple[PointCloud, list[str]]:
    findings = []
    return usable_seeds(points, TrainSettings(cap_max=cap, **settings), findings.append), findings


def test_more_than_the_cap_are_thinned_and_told_of(points):
    mixed = points.select(np.random.default_rng(0).permutation(len(points)))
    for strategy, most in (("default", 49), ("none", 70)):  # default adds the rest
        seeds, findings = thinned(points, 70, strategy=strategy)
        assert len(seeds) == most
        assert np.isin(seeds.xyz, points.xyz).all()
        assert f"100 seeds were thinned to {most}, {seeds.num_original} of them" in findings[0].text
        assert np.array_equal(thinned(points, 70, seed=1, strategy=strategy)[0].xyz, seeds.xyz)
        # Originals are asked first wherever they stand.
        assert thinned(mixed, 70, strategy=strategy)[0].num_original == seeds.num_original


def test_points_that_are_not_finite_and_wishes_without_effect_are_told_of(points):
    xyz = points.xyz.copy()
    xyz[3] = np.nan
    broken = points.replace(xyz=xyz, sizes=np.full(len(points), np.nan))
    seeds, findings = thinned(broken, 1000, seed_sizes=True, seed_normals=True)
    assert len(seeds) == ORIGINALS + NEW - 1
    assert [each.kind for each in findings] == ["non-finite-points", *["unused-setting"] * 2]


def test_of_what_is_known_only_what_is_asked_for_has_a_part(points):
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    normals[::3] = np.nan
    sizes, confidence = np.abs(points.xyz[:, 0]), np.ones(len(points))
    known = points.replace(normals=normals, sizes=sizes, confidence=confidence)
    digests = []
    for names in ((), ("sizes",), ("normals",), ("normals", "sizes")):
        asked = TrainSettings(**{f"seed_{name}": True for name in names})
        seeds = usable_seeds(known, asked, print)
        assert tuple(sorted(seeds.attributes)) == names
        digests.append(seeds_digest(seeds))
    assert len(set(digests)) == 4
    assert digests[0] == seeds_digest(points)
    few = thinned(known, 55, seed_sizes=True)[0]
    np.testing.assert_array_equal(few.sizes, np.abs(few.xyz[:, 0]))


def test_a_plain_scene_is_seeded_on_request_and_the_user_told(room):
    findings = []
    asked = TrainSettings(seeding="auto")
    scene, stereo = seeded(room, asked, "cpu", findings.append, silent)
    assert len(scene.points) > len(room.points)
    assert np.array_equal(scene.points.originals.xyz, room.points.xyz)
    assert [view.name for view in stereo.views] == [image.name for image in room.split(8)[0]]
    assert findings[-1].fix
    bounded = TrainSettings(seeding="auto", strategy="none", cap_max=100)
    empty = room.replace(points=room.points.select(slice(0)), tracks=None)
    assert len(seeded(empty, bounded, "cpu", findings.append, silent)[0].points) == 100
    assert not findings[-1].fix  # there are none to begin with


def test_a_region_gets_new_points_also_where_none_are_advised(room):
    scene = room.replace(points=_covering(room), tracks=None)
    low, high = np.percentile(room.points.xyz, (20, 80), axis=0)
    text = ",".join(f"{value:.6g}" for value in [*low, *high])
    asked = TrainSettings(seeding="advised", strategy="grow", cap_max=20_000)
    assert seeded(scene, asked, "cpu", print, silent)[0] is scene
    everywhere = TrainSettings(seeding="auto", strategy="grow", cap_max=20_000)
    clouds = [
        seeded(scene, each, "cpu", print, silent)[0].points
        for each in (dataclasses.replace(asked, region=text), everywhere)
    ]
    part, whole = (cloud.select(cloud.source != ORIGINAL) for cloud in clouds)
    assert parse_region(text)(part.xyz).all()
    assert 0 < len(part) < len(whole)
    assert np.array_equal(clouds[0].originals.xyz, scene.points.xyz)


def _covering(scene):
    """Points in all parts of the pictures."""
    uv = np.stack(np.meshgrid(np.arange(1.5, 96, 3), np.arange(1.5, 72, 3)), axis=-1).reshape(-1, 2)
    xyz = [image.camera.unproject(uv, np.full(len(uv), 3.0)) for image in scene.images]
    positions = np.concatenate(xyz).astype(np.float32)
    return PointCloud(positions, np.full(positions.shape, 128, np.uint8))


@pytest.mark.parametrize(("strategy", "points", "says"), [
    ("grow", "covering", "Seeds: leave the points as they are. No point falls in 0% of"),
    ("grow", "few", "Seeds by method auto: 210 points of the scene and"),
    ("grow", "none", "Seeds by method auto:"),
    ("default", "covering", "Seeds by method auto:"),
])  # fmt: skip
def test_seeds_are_added_where_that_is_advised(strategy, points, says, room):
    clouds = {"few": room.points, "none": PointCloud.empty(), "covering": _covering(room)}
    scene = room.replace(points=clouds[points], tracks=None)
    asked = TrainSettings(seeding="advised", strategy=strategy, cap_max=20_000)
    findings = []
    made, _ = seeded(scene, asked, "cpu", findings.append, silent)
    assert findings[-1].text.startswith(says)
    assert (len(made.points) > len(scene.points)) == ("auto" in says)
    assert ("No point falls in 80% of" in findings[-1].text) == (points == "few")


@pytest.mark.parametrize("why", ["as it is", "3dgs", "added to", "thinned"])
def test_other_points_are_left_alone(why, room, tmp_path):
    """Those that are to stay, of 3DGS's conventions, and those that splatseed made."""
    asked = TrainSettings(
        seeding="scene" if why == "as it is" else "auto",
        strategy="default-3dgs" if why == "3dgs" else "default",
    )
    scene = room
    if why == "added to":
        source = np.full(len(room.points), 4, np.uint8)
        scene = room.replace(points=room.points.replace(source=source))
    if why == "thinned":
        write_scene(room.replace(points=room.points.select(slice(100))), tmp_path / "thin")
        scene = load_scene(tmp_path / "thin")
        (tmp_path / "thin" / MANIFEST).write_text('{"command": "upsample"}')
    findings = []
    assert seeded(scene, asked, "cpu", findings.append, silent) == (scene, None)
    assert not findings


def _literal(xyz, views):
    """Point by point and view by view."""
    depths = np.full(len(xyz), np.nan)
    for i, point in enumerate(xyz):
        for view in views:
            x, y, z = (view.cam_from_world @ [*point, 1.0])[:3]
            if z <= view.near:
                continue
            u, v, _ = view.K @ [x / z, y / z, 1.0]
            across = -MARGIN * view.width <= u <= (1 + MARGIN) * view.width
            if across and -MARGIN * view.height <= v <= (1 + MARGIN) * view.height:
                depths[i] = np.fmin(depths[i], z)
    return np.where(np.isnan(depths), np.nanmedian(depths), depths)


def test_they_are_what_a_literal_loop_finds(room, rng):
    train, _ = load_split(room)
    xyz = np.concatenate([room.points.xyz[::20], rng.normal(scale=5.0, size=(50, 3))])
    assert np.allclose(min_view_depths(xyz, train), _literal(xyz, train), rtol=1e-5)


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_whatever_adds_or_moves_gaussians_hands_them_on(begin, strategy):
    run = begin(strategy=strategy, max_steps=60, cap_max=3000)
    first = set(run.state.params["min_view_depth"].tolist())
    count = len(run.state.params["means"])
    run.train()
    lengths = run.state.params["min_view_depth"]
    assert len(lengths) == len(run.state.params["means"]) > count
    assert set(lengths.tolist()) <= first
    assert not lengths.requires_grad


def _stepped(room, means, lengths, rate, steps):
    """How far Adam moves positions and scales of Gaussians whose gradients are all 1."""
    gaussians = dataclasses.replace(initial_gaussians(room.points), means=means)
    params = make_parameters(gaussians, torch.device("cpu"), lengths.astype(np.float32))
    optimizers = make_optimizers(params, make_schedule(STRATEGIES["none"], 100, as_3dgs=False))
    for _ in range(steps):
        for value in params.values():
            value.grad = torch.ones_like(value) if value.requires_grad else None
        optimize(params, optimizers, dict.fromkeys(optimizers, rate))
    after = (params[name].detach().numpy().astype(np.float64) for name in ("means", "scales"))
    return tuple(old - new for old, new in zip((means, gaussians.scales), after, strict=True))


def test_steps_of_positions_are_in_near_depths(room):
    """Adam's first step is the learning rate, whatever the gradient."""
    lengths = np.linspace(0.1, 9.0, len(room.points))
    moved, grown = _stepped(room, room.points.xyz, lengths, 1e-2, 1)
    assert np.allclose(moved, 1e-2 * lengths[:, None], rtol=1e-3, atol=1e-6)
    assert np.allclose(grown, 1e-2, rtol=1e-3)


def test_small_steps_of_far_positions_are_not_lost(room):
    """At the end of a full run a step is far below the last digit of a far position's own."""
    rate, far = 1.6e-6, np.full(len(room.points), 100.0, np.float32)
    moved, _ = _stepped(room, np.repeat(far[:, None], 3, axis=1), far, rate, 50)
    assert moved.mean() == pytest.approx(50 * rate * 100.0, rel=0.05)
