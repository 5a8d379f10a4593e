"""Schedules, and what gsplat's MCMC needs on the CPU."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from splatseed.errors import ParameterError
from splatseed.render import rasterization
from splatseed.train.relocation import compute_relocation, covariances, mcmc_on_cpu
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


def _relocation_by_the_paper(opacity, share):
    """3DGS as MCMC, eq. 9: the double sum as printed."""
    new = 1 - (1 - opacity) ** (1 / share)
    total = sum(
        math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, share + 1)
        for k in range(i)
    )
    return new, opacity / total


def test_relocation_is_the_papers_double_sum():
    opacities = torch.tensor([0.01, 0.3, 0.9, 0.995], dtype=torch.float64).repeat(5)
    shares = torch.tensor([1, 2, 3, 10, 51]).repeat_interleave(4)
    scales = torch.rand(20, 3, dtype=torch.float64)
    new, resized = compute_relocation(opacities, scales, shares, torch.zeros(51, 51))
    for i, (opacity, share) in enumerate(zip(opacities.tolist(), shares.tolist(), strict=True)):
        expected, factor = _relocation_by_the_paper(opacity, share)
        assert float(new[i]) == pytest.approx(expected, rel=1e-9)
        assert torch.allclose(resized[i], scales[i] * factor, rtol=1e-6)


def test_gaussians_that_share_a_place_are_as_opaque_together():
    opacities, shares = torch.tensor([0.2, 0.7, 0.99]), torch.tensor([2, 5, 60])
    new, _ = compute_relocation(opacities, torch.ones(3, 3), shares, torch.zeros(51, 51))
    together = 1 - (1 - new) ** shares.clamp(max=51)
    assert torch.allclose(together, opacities, atol=1e-5)


def test_covariances_are_rotated_squares():
    half_turn = torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]]) * 3.0
    matrices, _ = covariances(half_turn, torch.tensor([[1.0, 2.0, 3.0]]))
    assert torch.allclose(matrices[0], torch.diag(torch.tensor([4.0, 1.0, 9.0])), atol=1e-5)


def test_gsplat_gets_its_own_functions_back():
    from gsplat.strategy import ops  # noqa: PLC0415

    before = ops.compute_relocation, ops.quat_scale_to_covar_preci
    with mcmc_on_cpu():
        assert ops.compute_relocation is compute_relocation
    with pytest.raises(KeyboardInterrupt), mcmc_on_cpu():
        raise KeyboardInterrupt
    assert (ops.compute_relocation, ops.quat_scale_to_covar_preci) == before
