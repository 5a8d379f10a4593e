"""New Gaussians on pixels where renders are wrong and the depth is known.

Notation: e is the absolute error of a pixel, d its planar depth in training units. A *candidate* is
a pixel drawn as the place of a new Gaussian. Promise: candidates lie on pixels with known depth and
nonzero error; drawing does not synchronise with a GPU.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from gsplat.strategy.ops import duplicate
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.photos.view import View
from splatseed.splat.gaussians import SH_C0
from splatseed.splat.rendering import camera_tensors
from splatseed.training.parameters import MIN_VIEW_DEPTH, Optimizers, Parameters

Candidates = Mapping[str, Tensor]
"""``means`` [M, 3], ``colors`` [M, 3] of the photograph, 0 to 1, ``depths`` [M] and ``sizes`` [M]
(standard deviations), in training units; before ``join_candidates`` also ``valid`` [M], bool."""
SH0_NAMES, SHN_NAMES = ("sh0", "features_dc"), ("shN", "features_rest")
"""gsplat's and nerfstudio's names for the harmonics of degree 0 and of higher degrees."""
NEW_OPACITY = 0.6
"""Opacity of a new Gaussian. It lies on a surface; with a lower one it becomes visible too late."""
NEW_SIZE = 1.0
"""Standard deviation of a new Gaussian, px of its view."""


def draw_candidates(
    view: View,
    depth: Float[Tensor, "h w"],
    error: Float[Tensor, "H W"],
    photograph: Float[Tensor, "H W 3"],
    count: int,
) -> Candidates:
    """Draw pixels of known depth with probability proportional to e^2.

    Args:
        view: The view, in the training frame.
        depth: d, 0 where unknown; at any size, of the whole photograph.
        error: The error e.
        photograph: The colours of new Gaussians, 0 to 1.
        count: The number of draws.

    Returns:
        ``count`` candidates. Those drawn twice or without depth are not ``valid``, because
        removing them would synchronise with a GPU.
    """
    height, width = error.shape
    # The map is coarser: each pixel takes the depth of the map's pixel that covers it.
    rows = torch.arange(height, device=depth.device) * depth.shape[0] // height
    columns = torch.arange(width, device=depth.device) * depth.shape[1] // width
    d = depth[rows[:, None], columns].flatten()
    # In float64, so that the sum over a large photograph still grows with its last pixels.
    weight = torch.where(d > 0, error.flatten() ** 2, 0.0).double().cumsum(0)
    # Inverse of the cumulative sum: pixel p is drawn with probability e_p^2 / sum e^2.
    drawn = torch.rand(count, dtype=torch.float64, device=weight.device) * weight[-1]
    pixels = torch.searchsorted(weight, drawn, right=True).sort().values
    valid = (pixels < len(d)) & (weight[-1] > 0)
    valid[1:] &= pixels[1:] != pixels[:-1]
    pixels = pixels.clamp(max=len(d) - 1)
    d = d[pixels]
    return {
        "valid": valid,
        "means": _unproject(view, pixels, d),
        "colors": photograph.reshape(-1, 3)[pixels],
        "depths": d,
        "sizes": NEW_SIZE * d / float(view.K[0, 0]),
    }


def _unproject(
    view: View, pixels: Int[Tensor, " M"], d: Float[Tensor, " M"]
) -> Float[Tensor, "M 3"]:
    """Return the pixels' centres in the training frame: x = R^T (d K^-1 (u, v, 1) - t)."""
    u = (pixels % view.width + 0.5 - float(view.K[0, 2])) / float(view.K[0, 0])
    v = (pixels // view.width + 0.5 - float(view.K[1, 2])) / float(view.K[1, 1])
    pose = camera_tensors(view, d.device).cam_from_world
    in_camera = torch.stack([u * d, v * d, d], dim=1).double()
    return ((in_camera - pose[:3, 3]) @ pose[:3, :3]).float()


def join_candidates(draws: Sequence[Candidates]) -> Candidates:
    """Concatenate the valid candidates of all draws, in order."""
    joined = {name: torch.cat([draw[name] for draw in draws]) for name in draws[0]}
    valid = joined.pop("valid").nonzero().squeeze(1)  # the only synchronisation with a GPU
    return {name: values[valid] for name, values in joined.items()}


@torch.no_grad()
def add_candidates(
    params: Parameters, optimizers: Optimizers, candidates: Candidates, count: int
) -> int:
    """Turn ``count`` candidates, drawn uniformly, into round Gaussians of one colour.

    Returns:
        The number added: lower if there are fewer candidates, or fewer Gaussians.
    """
    number = len(params["means"])
    count = min(count, len(candidates["depths"]), number)
    if count <= 0:
        return 0
    device = params["means"].device
    some = torch.randperm(len(candidates["depths"]), device=device)[:count]
    chosen = {name: values.to(device)[some] for name, values in candidates.items()}
    # Copies of the first Gaussians have the right shapes and zero moments; then their values are
    # replaced.
    copied = torch.zeros(number, dtype=torch.bool, device=device)
    copied[:count] = True
    duplicate(params, optimizers, {}, copied)
    # colour = 1/2 + C0 sh0
    base = (chosen["colors"] - 0.5) / SH_C0
    new = {
        "means": chosen["means"],
        "scales": torch.log(chosen["sizes"])[:, None].expand(-1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0], device=device).expand(count, 4),
        "opacities": torch.logit(torch.full((count,), NEW_OPACITY, device=device)),
        MIN_VIEW_DEPTH: chosen["depths"],
        **dict.fromkeys(SH0_NAMES, base),
    }
    for name, value in params.items():
        rows = value[number:]
        if name in new:
            rows.copy_(new[name].reshape(rows.shape))
        elif name in SHN_NAMES:
            rows.zero_()
    return count
