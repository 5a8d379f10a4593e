"""Schedules: 3DGS's numbers in a full run, and how they shrink with a short one."""

from __future__ import annotations

import math
import sys

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from splatseed.rendering import rasterization
from splatseed.training.parameters import as_parameters, make_optimizers
from splatseed.training.schedule import LEARNING_RATES, make_schedule
from splatseed.training.settings import TrainSettings
from splatseed.training.state import make_strategy
from splatseed.training.traits import STRATEGIES


@pytest.mark.parametrize("as_3dgs", [True, False])
def test_a_full_run_has_3dgs_schedule(as_3dgs):
    full, mcmc = (
        make_schedule(STRATEGIES[name], 30_000, as_3dgs=as_3dgs) for name in ("default", "mcmc")
    )
    assert (full.refine_start, full.reset_every) == (500, 3000)
    assert full.prune_size == (0.1 if as_3dgs else math.inf)
    assert full.refine_every == mcmc.refine_every == 100
    assert full.growth == mcmc.growth == 1.05
    assert (full.refine_stop, mcmc.refine_stop) == (15_000, 25_000)
    assert [full.sh_degree(step, 3) for step in (0, 999, 1000, 2500, 29_999)] == [0, 0, 1, 2, 3]
    assert full.rates(0) == dict(LEARNING_RATES)
    assert full.rates(30_000) == pytest.approx({**LEARNING_RATES, "means": 1.6e-6})


@pytest.mark.parametrize("steps", [1, 7, 300, 1500, 7000])
def test_3dgs_schedule_shrinks_as_by_the_steps_scaler_of_gsplats_trainer(steps):
    short = make_schedule(STRATEGIES["default"], steps, as_3dgs=True)
    assert (short.depth_units, short.learning_rates) == (False, LEARNING_RATES)
    assert abs(short.refine_stop - steps / 2) <= 0.5
    assert short.decay("means", steps) == pytest.approx(0.01)
    assert short.refine_every == max(1, round(steps / 300))


@pytest.mark.parametrize(
    ("strategy", "steps", "every"),
    [
        *(("default", 300, 25), ("default", 90_000, 300), ("mcmc", 300, 10)),
        *(("grow", 10, 20), ("grow", 1500, 100), ("grow", 30_000, 2000)),
    ],
)
def test_enough_photographs_are_seen_between_densifications(strategy, steps, every):
    """Rounds of two steps lost ``grow`` ten decibels in a run of forty."""
    schedule = make_schedule(STRATEGIES[strategy], steps, as_3dgs=False)
    assert schedule.refine_every == every
    assert strategy != "grow" or schedule.refine_start == every


@pytest.mark.parametrize("steps", [1500, 30_000])
def test_auto_is_grow_in_short_runs_and_in_long_ones(steps):
    auto, grow = (TrainSettings(strategy=name, max_steps=steps) for name in ("auto", "grow"))
    assert (auto.traits, auto.schedule, auto.cap) == (grow.traits, grow.schedule, grow.cap)


@pytest.mark.parametrize(
    ("steps", "faster", "beta2"),
    [(90_000, (1, 1), 0.999), (15_000, (2, 2), 0.998), (1500, (20, 4), 0.99), (10, (20, 4), 0.99)],
)
def test_short_runs_learn_and_forget_faster_up_to_a_bound(steps, faster, beta2):
    schedule = make_schedule(STRATEGIES["none"], steps, as_3dgs=False)
    for name, factor in zip(("means", "sh0", "opacities"), (*faster, 1), strict=True):
        assert schedule.learning_rates[name] == pytest.approx(factor * LEARNING_RATES[name])
    optimizers = make_optimizers(as_parameters({"means": torch.zeros((1, 3))}), schedule)
    assert optimizers["means"].defaults["betas"] == (0.9, pytest.approx(beta2))


def test_no_optimiser_imports_torch_compile(monkeypatch):
    """A second and a half of the four that it takes to start."""
    monkeypatch.setitem(sys.modules, "torch._dynamo", None)  # an import of it fails
    params = as_parameters({"means": torch.zeros((1, 3))})
    optimizer = make_optimizers(params, make_schedule(STRATEGIES["none"], 100, as_3dgs=False))[
        "means"
    ]
    params["means"].sum().backward()
    optimizer.step()
    optimizer.zero_grad()
    optimizer.load_state_dict(optimizer.state_dict())
    assert params["means"].detach().abs().min() > 0


@pytest.mark.parametrize("cameras", [1, 2])
def test_running_sums_are_gsplats_own(cameras):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn((500, 3), generator=generator).requires_grad_()
    views = torch.eye(4).repeat(cameras, 1, 1)
    views[:, 2, 3] = torch.linspace(0.5, 1.5, cameras)
    K = torch.tensor([[40.0, 0, 25], [0, 40.0, 20], [0, 0, 1]]).repeat(cameras, 1, 1)
    ours = make_strategy(TrainSettings())
    theirs, expected = DefaultStrategy(), DefaultStrategy().initialize_state(scene_scale=1.0)
    for step in range(3):
        quats, colors = (torch.rand((500, size), generator=generator) for size in (4, 3))
        sizes, opacities = torch.full((500, 3), 0.05), torch.full((500,), 0.5)
        image, _, info = rasterization(
            means, quats, sizes, opacities, colors, views, K, 50, 40, packed=False
        )
        ours.before_backward({"means": means}, {}, step, info)
        image.square().sum().backward()
        ours.after_step({"means": means}, {}, step, info)
        theirs.step_post_backward({"means": means}, {}, expected, step, info)
    assert 0 < int((expected["count"] > 0).sum()) < 500
    for name in ("grad2d", "count"):
        assert expected[name].max() > 0
        torch.testing.assert_close(ours.state[name], expected[name], rtol=1e-6, atol=0.0)
