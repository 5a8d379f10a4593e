"""Schedules, and the running sums that are kept in another way than gsplat's."""

from __future__ import annotations

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from splatseed.errors import ParameterError
from splatseed.render import rasterization
from splatseed.train.settings import Schedule, TrainSettings
from splatseed.train.strategies import make_strategy


def test_a_full_run_has_3dgs_schedule():
    full = Schedule(30_000)
    assert (full.refine_start, full.reset_every) == (500, 3000)
    assert full.refine_every("default") == full.refine_every("mcmc") == 100
    assert (full.refine_stop("default"), full.refine_stop("mcmc")) == (15_000, 25_000)
    assert [full.sh_degree(step, 3) for step in (0, 999, 1000, 2500, 29_999)] == [0, 0, 1, 2, 3]
    assert full.means_lr(0) == 1.0
    assert full.means_lr(30_000) == pytest.approx(0.01)


@pytest.mark.parametrize("steps", [1, 7, 300, 7000])
def test_schedules_shrink_with_the_run(steps):
    short = Schedule(steps)
    assert abs(short.refine_stop("default") - steps / 2) <= 0.5
    assert short.means_lr(steps) == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("steps", "default", "mcmc"), [(7, 10, 10), (300, 25, 10), (7000, 100, 23), (90_000, 300, 300)]
)
def test_default_sees_enough_photographs_between_densifications(steps, default, mcmc):
    short = Schedule(steps)
    assert short.refine_every("default") == default
    assert short.refine_every("mcmc") == mcmc


@pytest.mark.parametrize(
    "bad", [{"max_steps": 0}, {"data_factor": 0}, {"sh_degree": 4}, {"cap_max": 1}, {"seed": -1}]
)
def test_bad_settings_are_named(bad):
    with pytest.raises(ParameterError, match=f"--{next(iter(bad)).replace('_', '-')}"):
        TrainSettings(**bad)


@pytest.mark.parametrize("cameras", [1, 2])
def test_running_sums_are_gsplats_own(cameras):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn((500, 3), generator=generator).requires_grad_()
    views = torch.eye(4).repeat(cameras, 1, 1)
    views[:, 2, 3] = torch.linspace(0.5, 1.5, cameras)
    ours = make_strategy(TrainSettings())
    theirs, expected = DefaultStrategy(), DefaultStrategy().initialize_state(scene_scale=1.0)
    for step in range(3):
        image, _, info = rasterization(
            means, torch.randn((500, 4), generator=generator), torch.full((500, 3), 0.05),
            torch.full((500,), 0.5), torch.rand((500, 3), generator=generator), views,
            torch.tensor([[40.0, 0, 25], [0, 40.0, 20], [0, 0, 1]]).repeat(cameras, 1, 1), 50, 40,
            packed=False,
        )  # fmt: skip
        ours.before({"means": means}, {}, step, info)
        image.square().sum().backward()
        ours.after({"means": means}, {}, step, info, means_lr=0.0)
        theirs.step_post_backward({"means": means}, {}, expected, step, info)
    assert 0 < int((expected["count"] > 0).sum()) < 500
    for name in ("grad2d", "count"):
        assert expected[name].max() > 0
        assert torch.equal(ours.state[name], expected[name])
