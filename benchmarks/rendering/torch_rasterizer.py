"""A peer: 3D Gaussian splatting as one would write it in plain PyTorch, with autograd's gradients.

Notation: N Gaussians, one camera, D = 3 channels; tiles are 16 x 16 px. Promise: it is given what
costs nothing to give: projection, culling and spherical harmonics are gsplat's own PyTorch
versions, for all Gaussians at once; lists are sorted once; within a tile everything is computed
for all pixels and listed Gaussians. The specification is ``splatseed.rendering.reference``'s,
cut-offs included, and the tests hold the two rasterisers to each other.
"""

from __future__ import annotations

from typing import Any

import torch
from gsplat.cuda._torch_impl import (  # its public functions need CUDA
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)
from jaxtyping import Float, Int
from torch import Tensor

__all__ = ["rasterize"]

TILE = 16
MIN_ALPHA, MAX_ALPHA, STOP = 1.0 / 255.0, 0.999, 1e-4


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    colors: tuple[Float[Tensor, "N 1 3"], Float[Tensor, "N K 3"]],
    viewmats: Float[Tensor, "1 4 4"],
    Ks: Float[Tensor, "1 3 3"],
    width: int,
    height: int,
    sh_degree: int,
    packed: bool = False,  # noqa: ARG001  (gsplat's argument; ``info`` here never is)
) -> tuple[Float[Tensor, "1 H W 3"], Float[Tensor, "1 H W 1"], dict[str, Any]]:
    """Image, alphas and ``info``, as ``splatseed.rendering.rasterization`` gives them."""
    covariances, _ = _quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    radii, means2d, depths, conics, _ = _fully_fused_projection(
        means, covariances, viewmats, Ks, width, height
    )
    directions = means - torch.linalg.inv(viewmats[0])[:3, 3]
    shades = _spherical_harmonics(sh_degree, directions, torch.cat(colors, dim=1))
    shades = torch.clamp_min(shades + 0.5, 0.0)
    names = {"means2d": means2d, "radii": radii, "depths": depths, "conics": conics}
    info = {**names, "opacities": opacities[None], "width": width, "height": height}
    kept = torch.nonzero((radii[0] > 0).all(dim=-1) & (opacities >= MIN_ALPHA))[:, 0]
    kept = kept[torch.argsort(depths[0, kept], stable=True)]
    listed, starts = _tile_lists(means2d[0, kept], radii[0, kept], width, height)
    gaussians = torch.cat(
        [means2d[0, kept], conics[0, kept], opacities[kept, None], shades[kept]], dim=1
    )
    image = _blend(gaussians, listed, starts, width, height)
    return image[None, ..., :3], image[None, ..., 3:], info


@torch.no_grad()
def _tile_lists(
    means2d: Float[Tensor, "G 2"], radii: Int[Tensor, "G 2"], width: int, height: int
) -> tuple[Int[Tensor, " P"], list[int]]:
    """Gaussians by tile, in order, and where each tile's begin: bounding boxes of 3.33 sigma."""
    tiles = torch.tensor([-(-width // TILE), -(-height // TILE)])
    low = ((means2d - radii) / TILE).floor().long().clamp(min=0)
    high = torch.minimum(((means2d + radii) / TILE).ceil().long(), tiles)
    size = (high - low).clamp(min=0)
    counts = size.prod(dim=1)
    which = torch.repeat_interleave(torch.arange(len(counts)), counts)
    place = torch.arange(len(which)) - (counts.cumsum(0) - counts)[which]
    column, row = low[which, 0] + place % size[which, 0], low[which, 1] + place // size[which, 0]
    tile, order = torch.sort(row * tiles[0] + column, stable=True)
    starts = torch.searchsorted(tile, torch.arange(int(tiles.prod()) + 1))
    return which[order], starts.tolist()


def _blend(
    gaussians: Float[Tensor, "G 9"],
    listed: Int[Tensor, " P"],
    starts: list[int],
    width: int,
    height: int,
) -> Float[Tensor, "H W 4"]:
    """Colours and alphas, tile by tile."""
    columns = -(-width // TILE)
    y, x = torch.meshgrid(torch.arange(TILE), torch.arange(TILE), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).reshape(-1, 2) + 0.5
    rows = []
    for row in range(-(-height // TILE)):
        tiles = []
        for column in range(columns):
            tile = row * columns + column
            mine = gaussians[listed[starts[tile] : starts[tile + 1]]]
            corner = torch.tensor([TILE * column, TILE * row])
            tiles.append(_tile(mine, pixels + corner).reshape(TILE, TILE, 4))
        rows.append(torch.cat(tiles, dim=1))
    return torch.cat(rows)[:height, :width]


def _tile(gaussians: Float[Tensor, "G 9"], pixels: Float[Tensor, "P 2"]) -> Float[Tensor, "P 4"]:
    """Colours and alpha of a tile's pixels; Gaussians nearest first."""
    means, conics, opacities, colors = torch.split(gaussians, [2, 3, 1, 3], dim=1)
    dx, dy = (means[:, None, :] - pixels).unbind(dim=-1)
    a, b, c = (each[:, None] for each in conics.unbind(dim=1))
    sigma = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacities * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
    alpha = torch.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, torch.zeros_like(alpha))
    rest = torch.cumprod(1 - alpha, dim=0)
    before = torch.cat([torch.ones_like(rest[:1]), rest[:-1]])
    gained = torch.where(rest > STOP, alpha * before, torch.zeros_like(alpha))
    total = gained.sum(dim=0)[:, None]
    return torch.cat([gained.T @ colors, total], dim=1)
