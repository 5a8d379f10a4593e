"""What gsplat's MCMC strategy has in CUDA only, and who gets it when."""

from __future__ import annotations

import math
import threading
from types import SimpleNamespace

import gsplat
import pytest
import torch
from gsplat.strategy import ops

from splatseed.render import mcmc_on_cpu
from splatseed.render.relocation import compute_relocation, covariances


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


def test_opacities_may_have_an_axis_more():
    opacities, scales, shares = torch.rand(9), torch.rand(9, 3), torch.arange(9)
    plain = compute_relocation(opacities, scales, shares, torch.zeros(51, 51))
    new, resized = compute_relocation(opacities[:, None], scales, shares, torch.zeros(51, 51))
    assert torch.equal(new, plain[0][:, None])
    assert torch.equal(resized, plain[1])


def functions():
    return ops.compute_relocation, ops.quat_scale_to_covar_preci


def test_gsplat_gets_its_own_functions_back():
    before = functions()
    with mcmc_on_cpu():
        assert functions() == (compute_relocation, covariances)
    with pytest.raises(KeyboardInterrupt), mcmc_on_cpu():
        raise KeyboardInterrupt
    assert functions() == before


def test_a_block_within_a_block_ends_alone():
    before = functions()
    with mcmc_on_cpu():
        with mcmc_on_cpu():
            pass
        assert functions() == (compute_relocation, covariances)
    assert functions() == before


def test_blocks_of_two_threads_may_overlap():
    before, entered, leave = functions(), threading.Event(), threading.Event()

    def other():
        with mcmc_on_cpu():
            entered.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with mcmc_on_cpu():
        thread.start()
        assert entered.wait(10)
    assert functions() == (compute_relocation, covariances)
    leave.set()
    thread.join()
    assert functions() == before


def test_cuda_tensors_go_to_gsplats_functions(monkeypatch):
    monkeypatch.setattr("gsplat.relocation.compute_relocation", lambda *given: ("moved", *given))
    monkeypatch.setattr(gsplat, "quat_scale_to_covar_preci", lambda *given: ("turned", *given))
    on_cuda = SimpleNamespace(is_cuda=True)
    assert compute_relocation(on_cuda, 1, 2, 3) == ("moved", on_cuda, 1, 2, 3)
    matrices = covariances(on_cuda, 1, compute_covar=True, compute_preci=False, triu=True)
    assert matrices == ("turned", on_cuda, 1, True, False, True)
