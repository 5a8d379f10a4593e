"""Strategy ``grow``: a fixed budget, spent where renders are still wrong.

Notation: w_ip is the weight of Gaussian i in pixel p, its alpha times the transmittance in front of
it, so that pixel p is sum_i w_ip c_i; e is the absolute error of a pixel, d its planar depth in
training units. For each Gaussian, over the views looked at since the last round: *pixels*
c = sum w, *error* E = sum w e, and *most pixels*, c in the one view where it is largest. A
*candidate* is a pixel drawn as a place for a Gaussian.

A quarter of the added Gaussians come from splitting those that contribute to wrong pixels; the
others are new, on wrong pixels whose depth is known, where splitting, which adds beside existing
Gaussians, does not reach: a leaf, a rod, a piece of wall without a seed. Promise: the number of
Gaussians never exceeds the budget; which ones grow depends only on the views and PyTorch's
generator; candidates lie on pixels with known depth and nonzero error. Growing by the error that a
Gaussian contributes to follows S. Rota Bulo et al., "Revising Densification in Gaussian Splatting"
(2024); what is removed, when, and the normalisation of the error were chosen on held-out training
views (benchmarks/training/README.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import torch
from gsplat.strategy.ops import duplicate, remove, split
from jaxtyping import Bool, Float, Int
from torch import Tensor

from splatseed.photos.view import View
from splatseed.splat.gaussians import SH_C0
from splatseed.splat.rendering import camera_of, fill_masked, mask_of, opacities_of, render_features
from splatseed.training.device import Capacity, on_one_thread
from splatseed.training.parameters import NEAR_DEPTHS, Optimizers, Parameters
from splatseed.training.schedule import FULL_AT, Schedule
from splatseed.training.strategies import Strategy

LOOK_EVERY = 6
"""Steps between looks at contributions: a look costs half a step."""
FAINT = 0.005
"""Opacity below which a Gaussian is removed, as in 3DGS."""
LEAST_PIXELS, LEAST_PART = 0.5, 0.1
"""A Gaussian is removed if, in every view that shows it, it contributes less than this much of a
pixel, and less than this fraction of the average contribution: where there are more Gaussians than
pixels, all contribute little."""
RECYCLED = 0.1
"""Fraction of a budget that seeds filled which each round takes from the Gaussians with the fewest
pixels, and spends again. Where growth filled it, wrong pixels have had their share, and taking more
cost 0.48 dB in a bare room."""
FULL = 0.95
"""Fraction of the budget from which on it counts as full."""
FASTEST = 0.5
"""Most Gaussians added in a round, as a fraction of the existing ones."""
PLACED = 0.75
"""Fraction of the added Gaussians that goes to wrong pixels of known depth."""
NOWHERE: Mapping[str, Tensor] = MappingProxyType({})
"""No view's depth is known."""
SUMS = ("errors", "pixels", "most_pixels", "views")
"""What the state holds of each Gaussian, since the last round."""
LEAST_VIEWS = 2
"""Minimum observations before a Gaussian is removed for its contribution."""

Candidates = Mapping[str, Tensor]
"""``means`` [M, 3], ``colors`` [M, 3] from the photograph, 0 to 1, ``depths`` [M], and ``sizes``
[M], standard deviations: training units; while they are collected also ``valid`` [M], bool."""
OPACITY = 0.6
"""Opacity of a new Gaussian. It stands on a surface; a fainter one takes the rest of the run to
show."""
OPAQUE = 15.0
"""Largest logit of an opacity that is split: from 17 on its sigmoid is 1 in float32, and the
logits of the halves infinite."""
SIZE = 1.0
"""Standard deviation of a new Gaussian, in pixels of its view."""
BASES, HARMONICS = ("sh0", "features_dc"), ("shN", "features_rest")
"""What gsplat and nerfstudio call the harmonics of degree 0, and those of the others."""


class Growing(Strategy):
    """Remove Gaussians that contribute little, split those with wrong pixels, within a budget.

    Args:
        schedule: When.
        capacity: The budget.
        depths: Of training views, by their names, planar depth in training units, 0 where it is
            unknown. Without them growth only splits.
        share: The fraction of the training views that have depths.
    """

    capacity: Capacity

    def __init__(
        self,
        schedule: Schedule,
        capacity: Capacity,
        depths: Mapping[str, Float[Tensor, "h w"]] = NOWHERE,
        share: float = 1.0,
    ) -> None:
        super().__init__(capacity)
        self.schedule = schedule
        self.depths, self.share = depths, share

    def looks(self, step: int) -> bool:
        """Whether contributions are measured at this step."""
        return step % LOOK_EVERY == 0 and step <= self.schedule.refine_stop

    def ends_round(self, step: int) -> bool:
        """Whether Gaussians are changed after this step."""
        schedule = self.schedule
        in_time = schedule.refine_start <= step <= schedule.refine_stop
        return in_time and step % schedule.refine_every == 0

    def observe(
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Add this view's measurements of each Gaussian to the sums."""
        if not self.looks(step):
            return
        render = fill_masked(render.detach(), photograph, mask_of(view, photograph.device))
        error = (render - photograph).abs().mean(dim=-1)
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
        if not self.ends_round(step):
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
        for name in SUMS:
            del self.state[name]

    def _sums(self, params: Parameters) -> dict[str, Any]:
        """The sums of this round, [N] each, in the state."""
        self.state.setdefault("first", len(params["means"]))
        if "errors" not in self.state:
            for name in SUMS:
                self.state[name] = torch.zeros_like(params["opacities"].detach().flatten())
        return self.state

    def _needless(self, params: Parameters) -> Bool[Tensor, " N"]:
        """Which Gaussians are removed: faint, or with the least contribution."""
        sums, count = self._sums(params), len(params["means"])
        shown = sums["views"] >= LEAST_VIEWS
        # Nearly transparent, ...
        needless = opacities_of(params["opacities"].detach().flatten()) < FAINT
        # ... or worth less than half a pixel in every view that showed it.
        needless |= shown & (sums["most_pixels"] < _least(sums["most_pixels"][shown]))
        more = self._recycled(count) - int(needless.sum())
        if more > 0:
            usable = shown & ~needless
            pixels = torch.where(usable, sums["most_pixels"], torch.inf)
            least = torch.topk(pixels, min(more, int(usable.sum())), largest=False).indices
            needless[least] = True
        return needless

    def _recycled(self, count: int) -> int:
        """How many make room in a round: a budget that seeds fill moves on only so.

        Trained Gaussians that a run goes on from have earned their places.
        """
        if not self.schedule.recycles:
            return 0
        filled = FULL * self.capacity.cap if self.capacity.cap else math.inf
        return round(RECYCLED * count) if min(self.state["first"], count) >= filled else 0

    def _split(self, params: Parameters, optimizers: Optimizers, wanted: int) -> None:
        """Split where E / sqrt(c) is largest: E favours large ones, E / c those of few pixels."""
        sums = self._sums(params)
        # The geometric mean of E and E / c; a Gaussian without pixels scores 0.
        scores = sums["errors"] / sums["pixels"].clamp_min(1e-6).sqrt()
        number = min(wanted, int((scores > 0).sum()))
        if number > 0:
            chosen = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
            chosen[torch.topk(scores, number).indices] = True
            params["opacities"].data.clamp_(max=OPAQUE)
            with on_one_thread(scores.device):
                # Both halves together are as opaque as the whole.
                split(params, optimizers, {}, chosen, revised_opacity=True)

    def _drawn_each(self, count: int, step: int) -> int:
        """Candidates to draw: what the next round may ask for, shared by its looks with depths."""
        every = self.schedule.refine_every
        # The step at which this round ends.
        end = max(self.schedule.refine_start, math.ceil(step / every) * every)
        growth = min(self._target(count, end) - count, round(FASTEST * count))
        wanted = growth + self._recycled(count)
        # Less than none where another trainer begins with more than the budget.
        return max(0, math.ceil(PLACED * wanted / max(1.0, self.share * (every // LOOK_EVERY))))

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
    if not len(most_pixels):
        return 0.0
    # NumPy's: the last digits of PyTorch's mean depend on the number of threads.
    return min(LEAST_PIXELS, LEAST_PART * float(most_pixels.cpu().numpy().mean()))


def contributions(
    params: Parameters, view: View, error: Float[Tensor, "H W"]
) -> tuple[Float[Tensor, " N"], Float[Tensor, " N"]]:
    """Each Gaussian's pixels, sum_p w_ip, and the error in them, sum_p w_ip e_p, where they count.

    Any rasteriser gives sums of weights as a gradient: of sum_p f_p sum_i w_ip c_i with respect to
    c_i. The Gaussians and their gradients are left unchanged.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: The view whose camera is used.
        error: The error e of each pixel.

    Returns:
        Pixels and errors; 0 where the view does not see a Gaussian.
    """
    means = params["means"]
    with torch.enable_grad():
        # Two channels of ones: their gradients are sum_p w_ip, plain or weighted by e_p.
        colors = means.new_ones((len(means), 2)).requires_grad_()
        frozen = {name: value.detach() for name, value in params.items()}
        frozen["opacities"] = frozen["opacities"].flatten()  # nerfstudio's are [N, 1]
        plain, weighted = render_features(frozen, view, colors).unbind(-1)
        if (mask := mask_of(view, means.device)) is not None:
            plain, weighted = plain * mask, weighted * mask
        (plain.sum() + (weighted * error).sum()).backward()
    assert colors.grad is not None  # noqa: S101  (backward made it)
    pixels, errors = colors.grad.unbind(-1)
    return pixels, errors


def draw_candidates(
    view: View,
    depth: Float[Tensor, "h w"],
    error: Float[Tensor, "H W"],
    photograph: Float[Tensor, "H W 3"],
    count: int,
) -> Candidates:
    """Draw pixels of known depth with probability proportional to e^2.

    There are always ``count``; those drawn twice or without depth are not ``valid``, and
    ``join_candidates`` leaves them out: a number that the GPU had to tell would be waited for.

    Args:
        view: The view, in the training frame.
        depth: d, 0 where unknown; of any size, covering the whole photograph.
        error: The error e.
        photograph: Colours of new Gaussians, 0 to 1.
        count: The number of draws.
    """
    height, width = error.shape
    # The map is coarser: each pixel takes the depth of the map's pixel that covers it.
    rows = torch.arange(height, device=depth.device) * depth.shape[0] // height
    columns = torch.arange(width, device=depth.device) * depth.shape[1] // width
    d = depth[rows[:, None], columns].flatten()
    # In float64, so that the sum over a large photograph still grows with its last pixels.
    worth = torch.where(d > 0, error.flatten() ** 2, 0.0).double().cumsum(0)
    # Inverse of the cumulative sum: pixel p is drawn with probability e_p^2 / sum e^2.
    drawn = torch.rand(count, dtype=torch.float64, device=worth.device) * worth[-1]
    pixels = torch.searchsorted(worth, drawn, right=True).sort().values
    valid = (pixels < len(d)) & (worth[-1] > 0)
    valid[1:] &= pixels[1:] != pixels[:-1]
    pixels = pixels.clamp(max=len(d) - 1)
    d = d[pixels]
    return {
        "valid": valid,
        "means": _unproject(view, pixels, d),
        "colors": photograph.reshape(-1, 3)[pixels],
        "depths": d,
        "sizes": SIZE * d / float(view.K[0, 0]),
    }


def _unproject(
    view: View, pixels: Int[Tensor, " M"], d: Float[Tensor, " M"]
) -> Float[Tensor, "M 3"]:
    """The pixels' centres in the training frame: x = R^T (d K^-1 (u, v, 1) - t)."""
    u = (pixels % view.width + 0.5 - float(view.K[0, 2])) / float(view.K[0, 0])
    v = (pixels // view.width + 0.5 - float(view.K[1, 2])) / float(view.K[1, 1])
    pose = camera_of(view, d.device).cam_from_world
    in_camera = torch.stack([u * d, v * d, d], dim=1).double()
    return ((in_camera - pose[:3, 3]) @ pose[:3, :3]).float()


def join_candidates(draws: Sequence[Candidates]) -> Candidates:
    """The valid candidates of all draws, in order."""
    joined = {name: torch.cat([each[name] for each in draws]) for name in draws[0]}
    valid = joined.pop("valid").nonzero().squeeze(1)  # a GPU is waited for once, not for each
    return {name: values[valid] for name, values in joined.items()}


@torch.no_grad()
def add_candidates(
    params: Parameters, optimizers: Optimizers, candidates: Candidates, count: int
) -> int:
    """Turn ``count`` candidates, drawn uniformly, into round Gaussians of one colour.

    Returns:
        How many were made: fewer if there are not enough candidates or Gaussians.
    """
    number = len(params["means"])
    count = min(count, len(candidates["depths"]), number)
    if count <= 0:
        return 0
    device = params["means"].device
    some = torch.randperm(len(candidates["depths"]), device=device)[:count]
    chosen = {name: values.to(device)[some] for name, values in candidates.items()}
    # Copies of arbitrary ones have the right shapes and zero moments; then they get their own
    # values.
    copied = torch.zeros(number, dtype=torch.bool, device=device)
    copied[:count] = True
    duplicate(params, optimizers, {}, copied)
    # colour = 1/2 + C0 sh0
    base = (chosen["colors"] - 0.5) / SH_C0
    new = {
        "means": chosen["means"],
        "scales": torch.log(chosen["sizes"])[:, None].expand(-1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).expand(count, 4),
        "opacities": torch.logit(torch.full((count,), OPACITY, device=device)),
        NEAR_DEPTHS: chosen["depths"],
        **dict.fromkeys(BASES, base),
    }
    for name, value in params.items():
        rows = value[number:]
        if name in new:
            rows.copy_(new[name].reshape(rows.shape))
        elif name in HARMONICS:
            rows.zero_()
    return count
