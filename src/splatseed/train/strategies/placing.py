"""New Gaussians on wrong pixels, at the depth that stereo knows there.

Notation: for a pixel p, e is its absolute error and d its planar depth in training units. A
*candidate* is a pixel drawn as a place for a Gaussian. Promise: candidates lie on pixels with known
depth and nonzero error, and depend on PyTorch's generator only. Splitting only adds beside existing
Gaussians; this reaches a leaf, a rod, or a piece of wall without a seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from gsplat.strategy.ops import duplicate
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.splat.gaussians import SH_C0
from splatseed.splat.rendering import camera_of
from splatseed.train.parameters import NEAR_DEPTHS, Optimizers, Parameters
from splatseed.views.view import View

Candidates = Mapping[str, Tensor]
"""``means`` [M, 3], ``colors`` [M, 3] from the photograph, 0 to 1, ``depths`` [M], and ``sizes``
[M], standard deviations: training units; while they are collected also ``valid`` [M], bool."""
OPACITY = 0.6
"""Opacity of a new Gaussian. It stands on a surface; a fainter one takes the rest of the run to
show."""
SIZE = 1.0
"""Standard deviation of a new Gaussian, in pixels of its view."""


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
    new = {
        "means": chosen["means"],
        "scales": torch.log(chosen["sizes"])[:, None].expand(-1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).expand(count, 4),
        "opacities": torch.logit(torch.full((count,), OPACITY, device=device)),
        # colour = 1/2 + C0 sh0
        "sh0": ((chosen["colors"] - 0.5) / SH_C0)[:, None],
        "shN": torch.zeros_like(params["shN"][:count]),
        NEAR_DEPTHS: chosen["depths"],
    }
    for name, value in params.items():
        value[number:] = new[name]
    return count
