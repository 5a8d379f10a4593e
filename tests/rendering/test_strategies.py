"""gsplat's strategies and sparse optimisers in the loops of their users, on the CPU."""

from __future__ import annotations

import inspect
import math
from contextlib import nullcontext, suppress

import gsplat
import numpy as np
import pytest
import torch
from gsplat.strategy import ops

from splatseed.rendering import MCMCStrategy, mcmc_on_cpu, rasterization
from splatseed.rendering.mcmc import compute_relocation, covariances

from .scenes import gradients, random_scene

SPARSE = ("means", "quats", "scales")


def train(strategy, start, steps, post, *, packed=True):
    """Fit a target as gsplat's example does: losses and counts by step, parameters, state."""
    torch.manual_seed(0)
    views = random_scene(np.random.default_rng(0), 60, cameras=2)
    target = rasterization(**{**views, "backgrounds": None})[0]
    values = {
        "means": start["means"], "quats": start["quats"], "scales": start["scales"].log(),
        "opacities": start["opacities"].logit(), "colors": start["colors"],
    }  # fmt: skip
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v.clone()) for k, v in values.items()})
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": 0.01, "name": name}])
        for name in params
    }
    strategy.check_sanity(params, optimizers)
    state, losses, counts = strategy.initialize_state(), [], []
    for step in range(steps):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(),
            params["opacities"].sigmoid(), params["colors"], views["viewmats"], views["Ks"],
            views["width"], views["height"], packed=packed,
            absgrad=getattr(strategy, "absgrad", False),
        )  # fmt: skip
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (image - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
        strategy.step_post_backward(params, optimizers, state, step, info, **post)
        for optimizer in optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
        counts.append(len(params["means"]))
    return losses, counts, params, state


def few():
    return random_scene(np.random.default_rng(1), 25, cameras=2)


@pytest.mark.parametrize(("packed", "absgrad"), [(True, True), (False, False)])
def test_default_strategy_densifies(packed, absgrad):
    strategy = gsplat.DefaultStrategy(
        refine_start_iter=5, refine_every=10, grow_grad2d=1e-4, absgrad=absgrad, reset_every=1000
    )
    losses, counts, params, state = train(strategy, few(), 30, {"packed": packed}, packed=packed)
    assert losses[-1] < 0.9 * losses[0]
    assert counts[-1] > counts[0]
    assert all(len(each) == counts[-1] == len(state["grad2d"]) for each in params.values())
    assert all(each.isfinite().all() for each in params.values())


SCHEDULE = {"refine_start_iter": 2, "refine_every": 5, "cap_max": 54}


def test_mcmc_relocates_adds_and_learns(capsys):
    """Of ours, and of gsplat's own class within the block, to the same bytes."""
    results = []
    for make, block in ((MCMCStrategy, nullcontext), (gsplat.MCMCStrategy, mcmc_on_cpu)):
        start = random_scene(np.random.default_rng(1), 50)
        start["opacities"][::5] = 1e-3
        with block():
            losses, _, params, _ = train(make(**SCHEDULE, verbose=True), start, 11, {"lr": 1e-4})
        said = capsys.readouterr().out
        assert "Step 5: Relocated 10 GSs." in said
        assert "Step 5: Added 2 GSs. Now having 52 GSs." in said
        assert {len(each) for each in params.values()} == {54}
        assert all(each.isfinite().all() for each in params.values())
        assert params["opacities"].sigmoid().min() >= 0.004
        assert losses[-1] < losses[0]
        results.append(params)
    assert all(torch.equal(results[0][name], results[1][name]) for name in results[0])


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
    again, same = compute_relocation(opacities[:, None], scales, shares, torch.zeros(51, 51))
    assert torch.equal(again, new[:, None])
    assert torch.equal(same, resized)


def test_covariances_are_rotated_squares():
    half_turn = torch.tensor([[math.cos(math.pi / 4), 0, 0, math.sin(math.pi / 4)]]) * 3.0
    matrices, _ = covariances(half_turn, torch.tensor([[1.0, 2.0, 3.0]]))
    assert torch.allclose(matrices[0], torch.diag(torch.tensor([4.0, 1.0, 9.0])), atol=1e-5)


def test_overlapping_blocks_restore_gsplats_functions():
    def functions():
        return ops.compute_relocation, ops.quat_scale_to_covar_preci

    before, first = functions(), mcmc_on_cpu()
    first.__enter__()
    with suppress(KeyboardInterrupt), mcmc_on_cpu():
        first.__exit__(None, None, None)  # of another thread
        assert functions() == (compute_relocation, covariances)
        raise KeyboardInterrupt
    assert functions() == before


def test_gsplat_still_has_both_functions_in_cuda_only_and_reads_them_from_its_module():
    """Else ``rendering/mcmc.py`` must follow, or can go."""
    readers = {
        ops.relocate: "compute_relocation",
        ops.sample_add: "compute_relocation",
        ops.inject_noise_to_position: "quat_scale_to_covar_preci",
    }
    for reader, name in readers.items():
        function = inspect.unwrap(reader)
        assert name in function.__code__.co_names
        assert function.__globals__ is vars(ops)
    # Both end in a CUDA kernel, whatever the device.
    assert "_make_lazy_cuda_func" in inspect.getsource(ops.compute_relocation)
    assert "_QuatScaleToCovarPreci.apply" in inspect.getsource(ops.quat_scale_to_covar_preci)


def partly_seen(cameras, **more):
    """Some Gaussians lie behind a camera or beside its image."""
    scene = random_scene(np.random.default_rng(0), 80, cameras=cameras, **more)
    scene["viewmats"][:, 2, 3] = 0.6
    return scene


@pytest.mark.parametrize("cameras", [1, 3])
@pytest.mark.parametrize(
    "options", [{}, {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"}]
)
def test_sparse_gradients_equal_the_dense_gradients_of_visible_gaussians(cameras, options):
    scene = partly_seen(cameras)
    *picture, dense = gradients(scene, **options)
    *same, grads = gradients(scene, sparse_grad=True, **options)
    assert all(torch.equal(a, b) for a, b in zip(picture, same, strict=True))
    rows = rasterization(**scene, **options)[2]["gaussian_ids"].unique()
    assert 10 < len(rows) < 70
    for name, grad in grads.items():
        if name in SPARSE:
            assert (grad.layout, grad.shape) == (torch.sparse_coo, dense[name].shape)
            assert torch.equal(grad.coalesce().indices(), rows[None])
        assert torch.equal(grad.to_dense(), dense[name])
