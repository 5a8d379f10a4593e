"""Strategy grow called as gsplat's strategies are, in loops of other trainers."""

from __future__ import annotations

import ast
import inspect
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="it is one of gsplat's strategies")

import torch
from gsplat.strategy import Strategy
from hypothesis import given, settings, strategies as st
from scipy.spatial.transform import Rotation

from splatseed.camera import Camera
from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.integrations.gsplat import GrowStrategy
from splatseed.io.depth_maps import depth_folder
from splatseed.photos.loading import load_views
from splatseed.photos.view import View
from splatseed.rendering import rasterization
from splatseed.similarity import Similarity
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.photographs import photograph_tensor
from splatseed.training.parameters import MIN_VIEW_DEPTH, as_parameters
from splatseed.training.settings import TrainSettings
from splatseed.training.state import make_strategy

SIDE = 32
POSE, K = torch.eye(4), torch.tensor([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1]])
GREY = torch.full((SIDE, SIDE, 3), 0.5)
TRUTH = GREY.clone()
TRUTH[:, : SIDE // 4] = 1.0
STEPS = {"refine_start_iter": 20, "refine_stop_iter": 150, "refine_every": 20}  # of 300


def planted(count, **more):
    """Grey balls side by side at depth 2, in the shapes of gsplat's trainer."""
    means = torch.zeros((count, 3))
    means[:, 0], means[:, 2] = torch.linspace(-0.8, 0.8, count), 2.0
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1)
    known = {"means": means, "scales": torch.full((count, 3), -2.8), "quats": quats}
    colors = {"sh0": torch.zeros((count, 1, 3)), "shN": torch.ones((count, 3, 3))}
    return ready({**known, "opacities": torch.full((count,), 2.0), **colors, **more})


def ready(tensors):
    params = as_parameters(tensors)
    trained = {name: value for name, value in params.items() if value.requires_grad}
    return params, {name: torch.optim.Adam([value]) for name, value in trained.items()}


def maps_of(folder, kind="z", **maps):
    with depth_folder(folder, kind) as writer:
        for name, depth in maps.items():
            writer.write(name, np.float32(depth))
    return folder


def grow(strategy, params, optimizers, names=None, steps=21):
    """A loop in which nothing is learnt; the first round is the last of 21 steps."""
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state()
    # As gsplat's trainer and as nerfstudio 1.1.5 call it.
    more = {"packed": strategy.absgrad} if "features_dc" in params else {"lr": 1e-3}
    torch.manual_seed(0)
    for step in range(steps):
        strategy.step_pre_backward(params, optimizers, state, step, {})
        views = (POSE[None], K[None], GREY[None], TRUTH[None])
        strategy.observe(params, state, step, *views, names)
        strategy.step_post_backward(params, optimizers, state, step, {}, **more)
    return state


def test_it_grows_what_splatseeds_trainer_grows(tmp_path):
    """The same Gaussians to the bit, new ones at the map's depth in training units."""
    ours, optimizers = planted(12, **{MIN_VIEW_DEPTH: torch.ones(12)})
    asked = TrainSettings(strategy="grow", max_steps=300, cap_max=100)
    inner = make_strategy(asked, depths={"a": np.full((8, 8), 3.0, np.float32)})
    pixels = np.zeros((SIDE, SIDE, 3), np.uint8)
    view = View("a", pixels, Camera(K.numpy(), SIDE, SIDE, POSE.numpy()))
    torch.manual_seed(0)
    for step in range(21):
        inner.observe(ours, view, GREY, TRUTH, step)
        inner.after_step(ours, optimizers, step, {})
    theirs, optimizers = planted(12)
    folder = maps_of(tmp_path / "maps", a=np.full((8, 8), 6.0))
    grow(GrowStrategy(100, **STEPS, depths=folder, depth_scale=0.5), theirs, optimizers, ["a"])
    assert len(theirs["means"]) > 12
    assert all(torch.equal(value, ours[name]) for name, value in theirs.items())
    placed = (theirs["means"].detach()[:, 2] - 3.0).abs() < 1e-4
    assert placed.any()
    assert not theirs["shN"][placed].any()


@settings(deadline=None, max_examples=20)
@given(count=st.integers(2, 12), cap=st.integers(2, 40), nerfstudio=st.booleans())
def test_the_budget_is_kept_and_all_tensors_agree(tmp_path_factory, count, cap, nerfstudio):
    params, optimizers = planted(count)
    if nerfstudio:
        opacities, sh0, shN = (params.pop(name).detach() for name in ("opacities", "sh0", "shN"))
        more = {"opacities": opacities[:, None], "features_dc": sh0[:, 0], "features_rest": shN}
        params, optimizers = ready({**params, **more})
    shapes = {name: value.shape[1:] for name, value in params.items()}
    for name, optimizer in optimizers.items():  # makes the moments
        params[name].grad = torch.zeros_like(params[name])
        optimizer.step()
    folder = maps_of(tmp_path_factory.mktemp("maps") / "maps", a=np.full((4, 4), 3.0))
    strategy = GrowStrategy(cap, **STEPS, depths=folder, depth_scale=1.0)
    state = grow(strategy, params, optimizers, ["a"], 67)
    number = len(params["means"])
    assert number <= max(count, cap)
    assert {name: value.shape[1:] for name, value in params.items()} == shapes
    for name, optimizer in optimizers.items():
        assert optimizer.param_groups[0]["params"][0] is params[name]
        assert optimizer.state[params[name]]["exp_avg"].shape == params[name].shape
    sums = [value for value in state.values() if isinstance(value, torch.Tensor)]
    assert {each.shape for each in sums} == {(number,)}


def test_what_is_missing_is_said(tmp_path):
    params, optimizers = planted(8)
    del params["quats"], params["sh0"]
    with pytest.raises(ParameterError, match="found no quats, no sh0 or features_dc"):
        GrowStrategy().check_sanity(params, optimizers)
    with pytest.raises(ParameterError, match="depth_scale with depths"):
        GrowStrategy(depths=tmp_path).initialize_state()
    with pytest.raises(SceneNotFoundError, match="no file"):
        GrowStrategy(depths=tmp_path, depth_scale=1.0).initialize_state()
    inverse = maps_of(tmp_path / "inverse", "inverse", a=np.ones((2, 2)))
    with pytest.raises(SceneFormatError, match="found inverse"):
        GrowStrategy(depths=inverse, depth_scale=1.0).initialize_state()
    tall = maps_of(tmp_path / "tall", a=np.ones((9, 4)))
    strategy, run = GrowStrategy(20, **STEPS, depths=tall, depth_scale=1.0), planted(8)
    with pytest.raises(ParameterError, match="a call of observe"):
        strategy.step_post_backward(*run, strategy.initialize_state(), 20, {})
    with pytest.raises(ParameterError, match=r"found images/a\.jpg.*: a\."):
        grow(strategy, *run, ["images/a.jpg"])
    with pytest.raises(SceneFormatError, match="aspect ratio"):
        grow(strategy, *run, ["a"])


def test_a_loop_loses_less_with_growth(sixteen_views, tmp_path):
    """In a world that the trainer turned and scaled, with the room's depth in its own units."""
    capture, scene = sixteen_views
    views = load_views(scene, scene.images)
    maps = {view.name: depth for view, depth in zip(views, capture.depths, strict=True)}
    folder = maps_of(tmp_path / "maps", **maps)
    world = Similarity(0.3, Rotation.from_euler("xyz", [1, 2, 3]).as_matrix(), np.ones(3))
    xyz = world.points(scene.points.xyz).astype(np.float32)
    first = initial_gaussians(scene.points.replace(xyz=xyz), sh_degree=1).arrays()
    losses = []
    for strategy in (Strategy(), GrowStrategy(3000, 12, 96, 12, depths=folder, depth_scale=0.3)):
        params, optimizers = ready({name: torch.tensor(value) for name, value in first.items()})
        for name, rate in {"means": 3e-4, "scales": 0.02, "opacities": 0.05, "sh0": 0.01}.items():
            optimizers[name].param_groups[0]["lr"] = rate
        losses.append(np.mean(train(params, optimizers, strategy, views, world)[-16:]))
    assert losses[1] < 0.8 * losses[0]


def train(params, optimizers, strategy, views, world):
    """The losses of a run as trainers that use gsplat have it."""
    growth, losses = isinstance(strategy, GrowStrategy), []
    state = strategy.initialize_state() if growth else {}
    for step in range(110):
        view = views[step * 7 % 16]
        truth = photograph_tensor(view, torch.device("cpu"))[None]
        camera = world.camera(view.cam_from_world), view.K
        pose, K = (torch.tensor(each[None], dtype=torch.float32) for each in camera)
        render, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
            params["sh0"], pose, K, view.width, view.height, sh_degree=0, packed=False,
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (render - truth).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad()
        if growth:
            strategy.observe(params, state, step, pose, K, render, truth, [view.name])
        strategy.step_post_backward(params, optimizers, state, step, info)
        losses.append(float(loss.detach()))
    return losses


def test_the_patch_of_gsplats_trainer_only_adds_a_call_that_fits():
    patch = Path(__file__).parents[2] / "examples" / "gsplat_grow.patch"
    lines = patch.read_text("utf-8").splitlines()[3:]
    assert all(line.startswith(("@@", "+")) for line in lines)
    added = "\n".join(line[1:] for line in lines)
    call = (
        ast.parse(re.search(r"strategy\.(observe\(.*?\n\s*\))", added, re.DOTALL)[1]).body[0].value
    )
    keywords = {each.arg: each for each in call.keywords}
    inspect.signature(GrowStrategy.observe).bind(None, *call.args, **keywords)
