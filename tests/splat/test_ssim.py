"""The loss kernel against torchmetrics, PyTorch's autograd and central differences."""

from __future__ import annotations

import numba
import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

import torch
from torchmetrics.functional.image import structural_similarity_index_measure

from splatseed.splat.metrics import l1_and_ssim_by_convolution, psnr
from splatseed.splat.ssim import l1_and_ssim
from splatseed.train.trainer import photometric_loss


def _pair(rng, height, width):
    x = rng.random((height, width, 3), np.float32)
    y = np.clip(x + rng.normal(0, 0.1, x.shape), 0, 1).astype(np.float32)
    return x, y


@pytest.mark.parametrize(("height", "width"), [(11, 11), (12, 40), (37, 23), (64, 50)])
def test_ssim_is_torchmetrics_where_the_window_fits(rng, height, width):
    x, y = _pair(rng, height, width)
    pair = torch.from_numpy(x), torch.from_numpy(y)
    expected = float(_torchmetrics_ssim(*pair))
    assert l1_and_ssim(x, y, 0.8, 0.2)[1] == pytest.approx(expected, abs=2e-6)
    l1, ours, _ = l1_and_ssim_by_convolution(*pair, 0.8, 0.2)
    assert float(ours) == pytest.approx(expected, abs=2e-6)
    assert float(l1) == pytest.approx(np.abs(x - y).mean(), rel=1e-6)


def _torchmetrics_ssim(x, y):
    """Mean SSIM where the window fits entirely, differentiable."""
    images = (image.permute(2, 0, 1)[None] for image in (x, y))
    _, full = structural_similarity_index_measure(*images, data_range=1.0, return_full_image=True)
    return full[..., 5:-5, 5:-5].mean()


def _by_convolution(render, photograph):
    """The loss as on a GPU, its gradient from ``l1_and_ssim_by_convolution``."""
    l1, ssim, gradient = l1_and_ssim_by_convolution(render, photograph, 0.8, 0.2)
    value = 0.8 * l1 + 0.2 * (1 - ssim)
    return value + ((render - render.detach()) * gradient).sum()


@pytest.mark.parametrize("compute", [photometric_loss, _by_convolution])
def test_gradient_is_autograds(rng, compute):
    x, y = (torch.from_numpy(image) for image in _pair(rng, 40, 29))
    ours, theirs = x.clone().requires_grad_(), x.double().requires_grad_()
    loss = compute(ours, y)
    expected = 0.8 * (theirs - y).abs().mean() + 0.2 * (1 - _torchmetrics_ssim(theirs, y.double()))
    (3 * loss).backward()
    (3 * expected).backward()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    torch.testing.assert_close(ours.grad.double(), theirs.grad, rtol=1e-3, atol=1e-8)


def test_gradient_is_the_slope_along_random_directions(rng):
    x, y = _pair(rng, 24, 31)
    # Away from x = y, where L1 has no slope; float32 sums allow no finer step.
    x = np.where(np.abs(x - y) < 0.02, y + 0.03, x).astype(np.float32)
    _, _, gradient = l1_and_ssim(x, y, 0.8, 0.2)
    for _ in range(5):
        direction = rng.normal(size=x.shape).astype(np.float32)
        step = np.float32(4e-3)
        sides = [l1_and_ssim(x + sign * step * direction, y, 0.8, 0.2) for sign in (1, -1)]
        high, low = (0.8 * l1 + 0.2 * (1 - s) for l1, s, _ in sides)
        slope = (high - low) / (2 * float(step))
        assert slope == pytest.approx(float((gradient * direction).sum()), rel=0.05, abs=2e-3)


def test_equal_images_are_the_best_there_is(rng):
    x, _ = _pair(rng, 20, 20)
    l1, similarity, gradient = l1_and_ssim(x, x.copy(), 0.8, 0.2)
    assert l1 == 0
    assert similarity == pytest.approx(1.0, abs=1e-6)
    assert np.abs(gradient).max() < 1e-6


def test_bytes_do_not_depend_on_threads(rng):
    x, y = _pair(rng, 50, 61)
    before = numba.get_num_threads()
    results = []
    try:
        for threads in (1, before):
            numba.set_num_threads(threads)
            results.append(l1_and_ssim(x, y, 0.8, 0.2))
    finally:
        numba.set_num_threads(before)
    assert results[0][:2] == results[1][:2]
    assert results[0][2].tobytes() == results[1][2].tobytes()


def test_psnr_is_of_the_clamped_render():
    truth = torch.zeros(11, 11, 3)
    assert psnr(truth - 5.0, truth) == float("inf")
    assert psnr(truth + 0.1, truth) == pytest.approx(20.0, abs=1e-4)
