"""Strategy ``grow``: a fixed budget, spent where renders are still wrong.

Notation: for each Gaussian, over the views looked at since the last round: *pixels* c = sum w,
*error* E = sum w e with e the absolute error of a pixel (see ``contributions``), and *most pixels*,
c in the one view where it is largest. A quarter of the added Gaussians come from splitting those
that contribute to wrong pixels; the others are new, on wrong pixels whose depth is known (see
``placing``). Promise: the number of Gaussians never exceeds the budget; which ones grow depends
only on the views and the seed. Growing by the error that a Gaussian contributes to follows S. Rota
Bulo et al., "Revising Densification in Gaussian Splatting" (2024); what is removed, when, and the
normalisation of the error were chosen on held-out training views (benchmarks/training/README.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import torch
from gsplat.strategy.ops import remove, split
from jaxtyping import Bool, Float
from torch import Tensor

from splatseed.train.device import Capacity
from splatseed.train.parameters import Optimizers, Parameters, yardsticks
from splatseed.train.settings import TrainSettings
from splatseed.train.strategies.base import Strategy
from splatseed.train.strategies.contributions import contributions
from splatseed.train.strategies.placing import add_candidates, draw_candidates, join_candidates
from splatseed.views.view import View

LOOK_EVERY = 2
"""Steps between looks at contributions: a look costs half a step."""
FAINT = 0.005
"""Opacity below which a Gaussian is removed, as in 3DGS."""
LEAST_PIXELS, LEAST_PART = 0.5, 0.1
"""A Gaussian is removed if, in every view that shows it, it contributes less than this much of a
pixel, and less than this fraction of the average contribution: where there are more Gaussians than
pixels, all contribute little."""
RECYCLED = 0.1
"""Fraction of a full budget that each round takes from the Gaussians with the fewest pixels, and
spends again."""
FULL = 0.95
"""Fraction of the budget from which on it counts as full."""
FULL_AT = 0.35
"""Fraction of the run by which the budget is spent."""
FASTEST = 0.5
"""Most Gaussians added in a round, as a fraction of the existing ones."""
PLACED = 0.75
"""Fraction of the added Gaussians that goes to wrong pixels of known depth."""
NOWHERE: Mapping[str, Tensor] = MappingProxyType({})
"""No view's depth is known."""
LEAST_VIEWS = 2
"""Looks that must have shown a Gaussian before it is removed for its contribution."""


class Growing(Strategy):
    """Remove Gaussians that contribute little, split those with wrong pixels, within a budget.

    Args:
        settings: How to train.
        capacity: The budget.
        depths: Of each training view, by its name, planar depth in training units, 0 where it is
            unknown; see ``placing``. Without them growth only splits.
    """

    capacity: Capacity

    def __init__(
        self,
        settings: TrainSettings,
        capacity: Capacity,
        depths: Mapping[str, Float[Tensor, "h w"]] = NOWHERE,
    ) -> None:
        super().__init__(capacity)
        self.schedule = settings.schedule
        self.depths = depths

    def observe(
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Add this view's measurements of each Gaussian to the sums."""
        if step % LOOK_EVERY or step > self.schedule.refine_stop:
            return
        error = (render.detach() - photograph).abs().mean(dim=-1)
        pixels, errors = contributions(params, view, error)
        sums = self._sums(params)
        sums["errors"] += errors
        sums["pixels"] += pixels
        # A look counts for the Gaussians that the view shows.
        sums["views"] += pixels > 0
        torch.maximum(sums["most_pixels"], pixels, out=sums["most_pixels"])
        if view.name in self.depths:
            drawn = draw_candidates(
                view, self.depths[view.name], error, photograph, self._drawn_each(len(pixels), step)
            )
            self.state.setdefault("candidates", []).append(dict(drawn))

    def after(
        self,
        params: Parameters,
        optimizers: Optimizers,
        step: int,
        info: Any,  # noqa: ARG002  (gsplat's own strategies need it)
    ) -> None:
        """At the end of a round, change the Gaussians and begin the next round."""
        schedule = self.schedule
        if (
            not schedule.refine_start <= step <= schedule.refine_stop
            or step % schedule.refine_every
        ):
            return
        needless = self._needless(params)
        if bool(needless.all()):
            return  # the run is lost either way, and an empty scene cannot be rendered
        # Candidates have no Gaussians yet: gsplat's operations must not see them in the state.
        draws = self.state.pop("candidates", None)
        remove(params, optimizers, self.state, needless)
        count = len(params["means"])
        target = self._target(count, step)
        wanted = min(self.capacity.limit(count, target) - count, round(FASTEST * count))
        candidates = join_candidates(draws) if draws else None
        placed = min(round(PLACED * wanted), len(candidates["depths"])) if candidates else 0
        self._split(params, optimizers, wanted - placed)
        if candidates:
            add_candidates(params, optimizers, candidates, placed)
        self.state = {"first": self.state["first"]}

    def _sums(self, params: Parameters) -> dict[str, Any]:
        """The sums of this round, [N] each, in the state."""
        self.state.setdefault("first", len(params["means"]))
        if "errors" not in self.state:
            for name in ("errors", "pixels", "most_pixels", "views"):
                self.state[name] = torch.zeros_like(params["opacities"].detach())
        return self.state

    def _needless(self, params: Parameters) -> Bool[Tensor, " N"]:
        """Which Gaussians are removed: faint, too large, or with the least contribution."""
        sums, count = self._sums(params), len(params["means"])
        sizes = torch.exp(params["scales"].detach()).amax(dim=-1) / yardsticks(params)
        shown = sums["views"] >= LEAST_VIEWS
        # Nearly transparent, ...
        needless = torch.sigmoid(params["opacities"].detach()) < FAINT
        # ... or larger than 0.1 of its near depth, ...
        needless |= sizes > self.schedule.prune_size
        # ... or worth less than half a pixel in every view that showed it.
        needless |= shown & (sums["most_pixels"] < _least(sums["most_pixels"][shown]))
        more = round(RECYCLED * count) - int(needless.sum())
        # A full budget moves on only if the least useful tenth makes room.
        if more > 0 and self.capacity.cap and count >= FULL * self.capacity.cap:
            usable = shown & ~needless
            pixels = torch.where(usable, sums["most_pixels"], torch.inf)
            least = torch.topk(pixels, min(more, int(usable.sum())), largest=False).indices
            needless[least] = True
        return needless

    def _split(self, params: Parameters, optimizers: Optimizers, wanted: int) -> None:
        """Split where E / sqrt(c) is largest: E favours large ones, E / c those of few pixels."""
        sums = self._sums(params)
        # The geometric mean of E and E / c; a Gaussian without pixels scores 0.
        scores = sums["errors"] / sums["pixels"].clamp_min(1e-6).sqrt()
        number = min(wanted, int((scores > 0).sum()))
        if number > 0:
            chosen = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
            chosen[torch.topk(scores, number).indices] = True
            # Both halves together are as opaque as the whole.
            split(params, optimizers, {}, chosen, revised_opacity=True)

    def _drawn_each(self, count: int, step: int) -> int:
        """Candidates to draw in a look: what the next round may ask for, shared by its looks."""
        every = self.schedule.refine_every
        # The step at which this round ends.
        end = max(self.schedule.refine_start, math.ceil(step / every) * every)
        growth = min(self._target(count, end) - count, round(FASTEST * count))
        wanted = growth + round(RECYCLED * count)
        return math.ceil(PLACED * wanted / max(1, every // LOOK_EVERY))

    def _target(self, count: int, step: int) -> int:
        """How many there should be after this round: the budget at ``FULL_AT`` of the run."""
        schedule, budget = self.schedule, self.capacity.cap or count
        rounds = max(
            1,
            round((FULL_AT * schedule.max_steps - schedule.refine_start) / schedule.refine_every)
            + 1,
        )
        done = (step - schedule.refine_start) // schedule.refine_every + 1
        first: int = self.state["first"]
        # Linear from the seeds to the budget.
        return round(first + (budget - first) * min(1.0, done / rounds))


def _least(most_pixels: Float[Tensor, " M"]) -> float:
    """The fewest pixels that are worth a Gaussian, given those of the Gaussians shown."""
    return min(LEAST_PIXELS, LEAST_PART * float(most_pixels.mean())) if len(most_pixels) else 0.0
