"""The training loop: render a view, compare it with its photograph, optimise, densify.

Notation: a step renders one training view; images are [H, W, 3], values about 0..1. Promise: on the
CPU equal settings and seeds give equal bytes, whatever the number of threads and interruptions: the
order of the photographs is drawn from (seed, epoch), and PyTorch's generator, which the strategies
use, is seeded from (seed, step) before each step. On a GPU a step synchronises only where gsplat
does.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.photos.view import View
from splatseed.runtime.interruption import interruption
from splatseed.runtime.workarounds import keep_freed_memory
from splatseed.splat.metrics import mirrored_ssim, psnr
from splatseed.splat.photographs import (
    PhotographCache,
    fill_masked,
    mask_tensor,
    over_background,
    photograph_tensor,
)
from splatseed.splat.rendering import render_view
from splatseed.splat.ssim import l1_and_ssim, l1_and_ssim_by_convolution
from splatseed.training.folder import Record
from splatseed.training.parameters import (
    add_to_mean,
    decay_opacities,
    optimize,
    take_mean,
    with_dropout,
)
from splatseed.training.settings import TrainSettings
from splatseed.training.state import TrainState

NUM_RECORDS, NUM_TESTS = 200, 20
"""Records in the curve of a run, and how many of them have the scores of the test views."""
SSIM_WEIGHT = 0.2


class Trainer:
    """Trains a state, which is changed in place, on views in the training frame."""

    def __init__(
        self,
        state: TrainState,
        settings: TrainSettings,
        train_views: Sequence[View],
        test_views: Sequence[View],
        on_record: Callable[[Record], None] = lambda _: None,
    ) -> None:
        self.state = state
        self.settings = settings
        self.train_views = train_views
        self.test_views = test_views
        self.on_record = on_record
        self.is_consistent = True  # no step is half done: the state may be saved
        self._photographs = PhotographCache(train_views, self.device)

    def run(self, on_step: Callable[[int], None] = lambda _: None) -> bool:
        """Train to the last step, or until the user interrupts; return whether it was reached.

        ``on_step`` is called after each step with the number of steps done.
        """
        keep_freed_memory()
        state = self.state
        gpus = [self.device] if self.device.type == "cuda" else []
        with interruption() as stop, torch.random.fork_rng(gpus):
            state.watch.start()
            while state.step < self.settings.max_steps and not stop.requested:
                shown = self._advance(state.step)
                state.step += 1
                on_step(state.step)
                if self._is_due(NUM_RECORDS) or self._is_due(NUM_TESTS):
                    self._record(*shown)
            state.watch.stop()
        return state.step >= self.settings.max_steps

    def warm_up(self) -> None:
        """Render and compare once, to compile kernels before the clock runs."""
        view = self.train_views[0]
        render, _ = render_view(self.state.params, view, self.settings.sh_degree)
        photometric_loss(render, self._photographs.get(view)).backward()
        self.clear_gradients()

    def clear_gradients(self) -> None:
        """Clear the gradients of an unfinished step."""
        for value in self.state.params.values():
            value.grad = None

    @torch.no_grad()
    def render(self, view: View) -> Float[Tensor, "H W 3"]:
        """Render a view with the current Gaussians."""
        degree = self.settings.schedule.sh_degree(self.state.step, self.settings.sh_degree)
        return render_view(self.state.params, view, degree)[0]

    def _advance(self, step: int) -> tuple[View, Float[Tensor, "H W 3"], Float[Tensor, "H W 3"]]:
        """Take one step; return the view, its render at its exposure, and its photograph."""
        state, schedule = self.state, self.settings.schedule
        params, optimizers, strategy = state.params, state.optimizers, state.strategy
        drawn = np.random.SeedSequence([self.settings.seed, step]).generate_state(1, np.uint64)
        random = int(drawn[0] >> 1)  # 63 bits: PyTorch's seeds are signed
        # torch.manual_seed would also note a stack trace for each kind of device that is not here.
        torch.default_generator.manual_seed(random)
        if self.device.type == "cuda":
            torch.cuda.manual_seed(random)
        epoch, position = divmod(step, len(self.train_views))
        order = _epoch_order(self.settings.seed, epoch, len(self.train_views))
        index = int(order[position])
        view = self.train_views[index]
        photograph, background = self._photographs.get(view), None
        cut_out = view.opacity is not None and state.exposures is None
        if cut_out or (schedule.random_background and view.empty is None):
            # On one background its colour could pass for an object, and the object for nothing.
            background = torch.rand(3, device=self.device)
            photograph = over_background(photograph, view, background)
        # The recorded loss and PSNR are with dropout.
        shown = with_dropout(params, schedule.dropout_at(step, len(self.train_views)))
        degree = schedule.sh_degree(step, self.settings.sh_degree)
        plain, info = render_view(shown, view, degree, background)
        render, mask = plain, mask_tensor(view, self.device)
        if state.exposures is not None:
            state.exposures.fit(index, plain, photograph, mask)
            render = state.exposures.apply(index, plain)
        # gsplat's strategies ask PyTorch to retain the gradient of the 2D means here.
        strategy.before_backward(params, optimizers, step, info)
        loss = photometric_loss(fill_masked(render, photograph, mask), photograph)
        state.losses.append(loss.detach())
        penalty = strategy.regularization(params)
        # The recorded loss is without the penalty, so that strategies can be compared.
        (loss if penalty is None else loss + penalty).backward()
        self.is_consistent = False
        optimize(params, optimizers, schedule.rates(step))
        decay_opacities(params, schedule.opacity_decay(len(self.train_views)))
        if state.exposures is None:
            strategy.observe(params, view, render, photograph, step)
        else:
            # The strategy adds Gaussians in colours of the mean exposure, so it compares at that.
            at_mean = state.exposures.to_mean(index, photograph)
            strategy.observe(params, view, plain, at_mean, step)
        strategy.after_step(params, optimizers, step, info)
        if schedule.mean_from is not None and step >= schedule.mean_from:
            add_to_mean(state.mean, params)
            if step + 1 == self.settings.max_steps:
                take_mean(params, state.mean)
        self.is_consistent = True
        return view, render.detach(), photograph

    def _record(
        self, view: View, render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
    ) -> None:
        """Add a record to the curve, with the clock stopped."""
        state = self.state
        loss = float(torch.stack(state.losses).mean(dtype=torch.float64))
        state.watch.stop()
        state.losses.clear()
        due = self._is_due(NUM_TESTS) and self.test_views
        test_psnr, test_ssim = self.test_scores() if due else (None, None)
        seconds = round(state.watch.seconds, 3)
        shown = round(psnr(render, photograph, mask_tensor(view, self.device)), 4)
        count = len(state.params["means"])
        record = Record(state.step, seconds, loss, shown, test_psnr, count, test_ssim)
        state.records.append(record)
        self.on_record(record)
        state.watch.start()

    def test_scores(self) -> tuple[float, float]:
        """Return the mean PSNR, dB, and mean SSIM of the test views."""
        scores = []
        for view in self.test_views:
            photograph, mask = photograph_tensor(view, self.device), mask_tensor(view, self.device)
            render = fill_masked(self.render(view), photograph, mask)
            scores.append((psnr(render, photograph, mask), mirrored_ssim(render, photograph, mask)))
        psnrs, ssims = zip(*scores, strict=True)
        return round(sum(psnrs) / len(psnrs), 4), round(sum(ssims) / len(ssims), 5)

    def _is_due(self, times: int) -> bool:
        """Whether an event that happens ``times`` times in a run is due after this step."""
        step, last = self.state.step, self.settings.max_steps
        # Evenly spread over the run, and always at its last step.
        return step * times // last > (step - 1) * times // last

    @property
    def device(self) -> torch.device:
        """Where the Gaussians are."""
        means: Tensor = self.state.params["means"]
        return means.device


@lru_cache(maxsize=2)
def _epoch_order(seed: int, epoch: int, count: int) -> Int[np.ndarray, " V"]:
    return np.random.default_rng([seed, epoch]).permutation(count)


def photometric_loss(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
) -> Float[Tensor, ""]:
    """0.8 L1 + 0.2 (1 - SSIM), differentiable in ``render`` (Kerbl et al. 2023, eq. 7).

    On a GPU the fused kernel of the package ``fused-ssim`` is used where installed. Images are
    float32, of at least 11 pixels a side.
    """
    fused = _fused_ssim() if render.is_cuda else None
    if fused is None:
        loss: Tensor = _Loss.apply(render, photograph)
        return loss
    l1 = (render - photograph).abs().mean()
    x, y = (image.permute(2, 0, 1)[None].contiguous() for image in (render, photograph))
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - fused(x, y, padding="valid"))


@lru_cache
def _fused_ssim() -> Callable[..., Tensor] | None:
    """Return the function of the package fused-ssim; None without it."""
    try:
        from fused_ssim import fused_ssim  # noqa: PLC0415  (optional)
    except ImportError:
        return None
    return fused_ssim  # type: ignore[no-any-return]  # it has no types


class _Loss(torch.autograd.Function):
    """The loss and its analytic gradient: a Numba pass; on a GPU convolutions without TF32."""

    @staticmethod
    def forward(ctx: Any, render: Tensor, photograph: Tensor) -> Tensor:
        weights = 1 - SSIM_WEIGHT, SSIM_WEIGHT
        if render.device.type == "cpu":
            arrays = render.detach().contiguous().numpy(), photograph.contiguous().numpy()
            l1, similarity, slopes = l1_and_ssim(*arrays, *weights)
            ctx.save_for_backward(torch.from_numpy(slopes))
            return torch.tensor(weights[0] * l1 + weights[1] * (1 - similarity))
        of_l1, of_ssim, gradient = l1_and_ssim_by_convolution(render, photograph, *weights)
        ctx.save_for_backward(gradient)
        return weights[0] * of_l1 + weights[1] * (1 - of_ssim)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        # backward mostly starts at the loss, and multiplying by one takes a whole pass; on a GPU
        # reading the number would synchronise.
        at_loss = gradient.device.type == "cpu" and float(upstream[0]) == 1.0
        return gradient if at_loss else gradient * upstream[0], None
