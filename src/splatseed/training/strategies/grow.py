"""Strategy ``grow``: a fixed budget of Gaussians, spent where renders are still wrong.

Notation: w_ip is the weight of Gaussian i in pixel p (its alpha times the transmittance in front of
it), so that pixel p is sum_i w_ip c_i; e is the absolute error of a pixel. For each Gaussian, over
the views measured in a round: *pixels* c = sum w, *error* E = sum w e, and *max pixels*, the
largest c of one view.

A quarter of the added Gaussians come from splitting those with a large error; the others are new,
on wrong pixels of known depth (``candidates``), where splitting, which adds beside existing
Gaussians, does not reach: a leaf, a rod, a piece of wall without a seed. Promise: the number of
Gaussians never exceeds the budget; growth depends only on the views and PyTorch's generator.
Source: S. Rota Bulo et al., "Revising Densification in Gaussian Splatting" (2024) grows by the
error that a Gaussian contributes to; pruning, its timing, and the normalisation of the error were
chosen on held-out training views (benchmarks/tried.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Self

import torch
from gsplat.strategy.ops import remove, split
from jaxtyping import Bool, Float
from torch import Tensor

from splatseed.photos.view import View
from splatseed.splat.photographs import fill_masked, mask_tensor
from splatseed.splat.rendering import opacity_from_logits, render_features
from splatseed.training.device import Capacity, on_one_thread
from splatseed.training.parameters import MAX_LOGIT, Optimizers, Parameters
from splatseed.training.schedule import Schedule
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.base import Strategy
from splatseed.training.strategies.candidates import (
    add_candidates,
    draw_candidates,
    join_candidates,
)
from splatseed.training.traits import FULL_AT

NO_DEPTHS: Mapping[str, Tensor] = MappingProxyType({})
SUMS = ("errors", "pixels", "max_pixels", "views")
"""Per Gaussian, in the state, since the last round."""


@dataclass(frozen=True)
class Growth:
    """The constants of ``grow``."""

    accumulate_every: int = 6  # steps between measurements, each of which costs half a step
    max_rate: float = 0.5  # most Gaussians added in a round, as a fraction of the existing ones
    placed: float = 0.75  # fraction of the added Gaussians that are candidates
    min_opacity: float = 0.005  # below it a Gaussian is pruned, as in 3DGS
    min_pixels: float = 0.5
    """A Gaussian is pruned if it contributes less than this many pixels to every view, and less
    than ``min_fraction`` of the average: above one Gaussian per pixel all contribute little."""
    min_fraction: float = 0.1
    min_views: int = 2  # measured views before a Gaussian is pruned for its contribution
    recycled: float = 0.1
    """Where seeds fill the budget, each round replaces this fraction of the Gaussians, those with
    the fewest pixels. Where growth filled it, replacing more cost 0.48 dB in a bare room."""
    full: float = 0.95  # fraction of the budget from which on it counts as full


GROWTH = Growth()


class ErrorDensification(Strategy):
    """Prune Gaussians that contribute little, and add where pixels are wrong, within a budget.

    Args:
        schedule: The timing of rounds.
        capacity: The budget.
        depths: Planar depth of training views by name, in training units, 0 where unknown. Without
            depths the strategy only splits.
        share: The fraction of the training views that have depths.
    """

    def __init__(
        self,
        schedule: Schedule,
        capacity: Capacity,
        depths: Mapping[str, Float[Tensor, "h w"]] = NO_DEPTHS,
        share: float = 1.0,
    ) -> None:
        super().__init__(capacity)
        self.schedule = schedule
        self.depths, self.share = depths, share

    @classmethod
    def of(
        cls,
        settings: TrainSettings,
        capacity: Capacity,
        depths: Mapping[str, Float[Tensor, "h w"]],
        share: float,
    ) -> Self:
        """Make the strategy of a run; without depths it only splits."""
        return cls(settings.schedule, capacity, depths, share)

    def should_accumulate(self, step: int) -> bool:
        """Whether contributions are measured at this step."""
        return step % GROWTH.accumulate_every == 0 and step <= self.schedule.refine_stop

    def should_densify(self, step: int) -> bool:
        """Whether a round ends after this step."""
        schedule = self.schedule
        refines = schedule.refine_start <= step <= schedule.refine_stop
        return refines and step % schedule.refine_every == 0

    def observe(
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Add each Gaussian's measurements in this view to the sums, and draw candidates."""
        if not self.should_accumulate(step):
            return
        render = fill_masked(render.detach(), photograph, mask_tensor(view, photograph.device))
        error = (render - photograph).abs().mean(dim=-1)
        pixels, errors = contributions(params, view, error)
        sums = self._sums(params)
        sums["errors"] += errors
        sums["pixels"] += pixels
        # A view counts for the Gaussians that it shows.
        sums["views"] += pixels > 0
        torch.maximum(sums["max_pixels"], pixels, out=sums["max_pixels"])
        if view.name in self.depths:
            count = self._num_draws(len(pixels), step)
            drawn = draw_candidates(view, self.depths[view.name], error, photograph, count)
            self.state.setdefault("candidates", []).append(dict(drawn))

    def after_step(
        self,
        params: Parameters,
        optimizers: Optimizers,
        step: int,
        info: Any,  # noqa: ARG002  (gsplat's own strategies need it)
    ) -> None:
        """At the end of a round, prune and add Gaussians, and start the next round."""
        if not self.should_densify(step):
            return
        pruned = self._prune_mask(params)
        if bool(pruned.all()):
            return  # pruning everything would leave nothing to render
        # Candidates are no Gaussians yet: gsplat's operations must not see them in the state.
        draws = self.state.pop("candidates", None)
        remove(params, optimizers, self.state, pruned)
        count = len(params["means"])
        target = self._target(count, step)
        added = min(self.capacity.limit(count, target) - count, round(GROWTH.max_rate * count))
        candidates = join_candidates(draws) if draws else None
        placed = min(round(GROWTH.placed * added), len(candidates["depths"])) if candidates else 0
        self._split(params, optimizers, added - placed)
        if candidates:
            add_candidates(params, optimizers, candidates, placed)
        for name in SUMS:
            del self.state[name]

    def _sums(self, params: Parameters) -> dict[str, Any]:
        """Return the state with the sums of this round, [N] each."""
        self.state.setdefault("num_initial", len(params["means"]))
        if "errors" not in self.state:
            for name in SUMS:
                self.state[name] = torch.zeros_like(params["opacities"].detach().flatten())
        return self.state

    def _prune_mask(self, params: Parameters) -> Bool[Tensor, " N"]:
        """Select transparent Gaussians, and those that contribute least."""
        sums, count = self._sums(params), len(params["means"])
        measured = sums["views"] >= GROWTH.min_views
        # Nearly transparent, ...
        pruned = opacity_from_logits(params["opacities"].detach().flatten()) < GROWTH.min_opacity
        # ... or less than half a pixel in every measured view, ...
        pruned |= measured & (sums["max_pixels"] < _min_pixels(sums["max_pixels"][measured]))
        more = self._num_recycled(count) - int(pruned.sum())
        if more > 0:  # ... or among the fewest pixels, where seeds fill the budget.
            usable = measured & ~pruned
            pixels = torch.where(usable, sums["max_pixels"], torch.inf)
            fewest = torch.topk(pixels, min(more, int(usable.sum())), largest=False).indices
            pruned[fewest] = True
        return pruned

    def _num_recycled(self, count: int) -> int:
        """Return how many Gaussians a round replaces where seeds fill the budget.

        None in a run that continues from trained Gaussians, which have earned their places.
        """
        if not self.schedule.recycles:
            return 0
        filled = GROWTH.full * self.capacity.cap if self.capacity.cap else math.inf
        full = min(self.state["num_initial"], count) >= filled
        return round(GROWTH.recycled * count) if full else 0

    def _split(self, params: Parameters, optimizers: Optimizers, limit: int) -> None:
        """Split where E / sqrt(c) is largest: E favours large Gaussians, E / c small ones."""
        sums = self._sums(params)
        # The geometric mean of E and E / c; a Gaussian without pixels scores 0.
        scores = sums["errors"] / sums["pixels"].clamp_min(1e-6).sqrt()
        number = min(limit, int((scores > 0).sum()))
        if number > 0:
            chosen = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
            chosen[torch.topk(scores, number).indices] = True
            params["opacities"].data.clamp_(max=MAX_LOGIT)
            with on_one_thread(scores.device):
                # Both halves together are as opaque as the Gaussian.
                split(params, optimizers, {}, chosen, revised_opacity=True)

    def _num_draws(self, count: int, step: int) -> int:
        """Return the draws per view: what a round may add, divided among its views with depths."""
        every = self.schedule.refine_every
        # The step at which this round ends.
        end = max(self.schedule.refine_start, math.ceil(step / every) * every)
        growth = min(self._target(count, end) - count, round(GROWTH.max_rate * count))
        added = growth + self._num_recycled(count)
        views = max(1.0, self.share * (every // GROWTH.accumulate_every))
        # Negative if an external trainer starts above the budget.
        return max(0, math.ceil(GROWTH.placed * added / views))

    def _target(self, count: int, step: int) -> int:
        """Return the number of Gaussians after this round; the budget at ``FULL_AT`` of the run."""
        schedule, budget = self.schedule, self.capacity.cap or count
        rounds = max(
            1,
            round((FULL_AT * schedule.max_steps - schedule.refine_start) / schedule.refine_every)
            + 1,
        )
        done = (step - schedule.refine_start) // schedule.refine_every + 1
        initial: int = self.state["num_initial"]
        # Linear from the seeds to the budget.
        return round(initial + (budget - initial) * min(1.0, done / rounds))


def _min_pixels(max_pixels: Float[Tensor, " M"]) -> float:
    """Return the fewest pixels that keep a Gaussian, given those of the measured Gaussians."""
    if not len(max_pixels):
        return 0.0
    # NumPy's: the last digits of PyTorch's mean depend on the number of threads.
    mean = float(max_pixels.cpu().numpy().mean())
    return min(GROWTH.min_pixels, GROWTH.min_fraction * mean)


def contributions(
    params: Parameters, view: View, error: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Measure each Gaussian's pixels, sum_p w_ip, and error, sum_p w_ip e_p, in a view.

    The gradient of sum_p f_p sum_i w_ip c_i with respect to c_i is sum_p f_p w_ip, so any
    rasteriser computes it. Masked pixels do not count; parameters and their gradients are
    unchanged.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: The view.
        error: The error e of each pixel.

    Returns:
        Pixels and errors; 0 for Gaussians that the view does not show.
    """
    means = params["means"]
    with torch.enable_grad():
        # Two channels of ones: their gradients are sum_p w_ip, plain and weighted by e_p.
        colors = means.new_ones((len(means), 2)).requires_grad_()
        frozen = {name: value.detach() for name, value in params.items()}
        frozen["opacities"] = frozen["opacities"].flatten()  # nerfstudio's are [N, 1]
        plain, weighted = render_features(frozen, view, colors).unbind(-1)
        if (mask := mask_tensor(view, means.device)) is not None:
            plain, weighted = plain * mask, weighted * mask
        (plain.sum() + (weighted * error).sum()).backward()
    assert colors.grad is not None  # noqa: S101  (backward made it)
    pixels, errors = colors.grad.unbind(-1)
    return pixels, errors
