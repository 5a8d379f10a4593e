"""Which Gaussians touch which tiles, in gsplat's layout.

Only for callers that read them: the CPU rasteriser has its own.

Notation: G projected Gaussians, C cameras one after the other, I pairs of a Gaussian and a tile,
and ceil(height / size) x ceil(width / size) tiles per camera. A pair's id is, from the highest bit
down, its camera, its tile (row by row, in as many bits as the number of tiles needs) and the 32
bits of its depth, so that sorted ids are camera by camera, tile by tile, front to back. Promise:
the numbers of gsplat 1.5.3's ``isect_tiles`` and ``isect_offset_encode``.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.render.autograd import is_seen


class Grid(NamedTuple):
    """The tiles of C images of one size."""

    cameras: int
    width: int
    """Pixels."""
    height: int
    """Pixels."""
    size: int
    """Side of a tile in pixels."""

    @property
    def columns(self) -> int:
        """Tiles per row."""
        return -(-self.width // self.size)

    @property
    def rows(self) -> int:
        """Rows of tiles."""
        return -(-self.height // self.size)


class Intersections(NamedTuple):
    """Pairs of a Gaussian and a tile, under gsplat's names."""

    tiles_per_gauss: Int[Tensor, " G"]
    """How many tiles each Gaussian touches, int32."""
    isect_ids: Int[Tensor, " I"]
    """The pairs' ids, sorted, int64."""
    flatten_ids: Int[Tensor, " I"]
    """The Gaussian of each pair, int32."""
    isect_offsets: Int[Tensor, "C rows columns"]
    """The first pair of each tile, int32."""


@torch.no_grad()
def intersect(
    means2d: Float[Tensor, "G 2"],
    radii: Int[Tensor, "G 2"],
    depths: Float[Tensor, " G"],
    cameras: Int[Tensor, " G"],
    grid: Grid,
) -> Intersections:
    """Pair Gaussians with the tiles that their bounding boxes reach.

    Args:
        means2d: Centres, px, float32 [G, 2].
        radii: Half the sizes of the boxes, px, int32 [G, 2]; culled where one is 0.
        depths: z, float32 [G].
        cameras: The camera of each, int64 [G].
        grid: The images' tiles.

    Example:
        >>> pairs = intersect(
        ...     torch.tensor([[17.0, 9.0]]), torch.tensor([[3, 3]]), torch.ones(1),
        ...     torch.zeros(1, dtype=torch.int64), Grid(cameras=1, width=40, height=20, size=16))
        >>> pairs.tiles_per_gauss, pairs.isect_offsets
        (tensor([2], dtype=torch.int32), tensor([[[0, 1, 2],
                 [2, 2, 2]]], dtype=torch.int32))
    """
    first, sizes = _boxes(means2d, radii, grid)
    counts = sizes.prod(dim=1)
    owner = torch.repeat_interleave(counts)
    # Each pair's number within its Gaussian's box of tiles, row by row.
    place = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    columns = sizes[owner, 0]
    row = first[owner, 1] + place // columns
    tile = row * grid.columns + first[owner, 0] + place % columns
    ids, order = torch.sort(_ids(cameras[owner], tile, depths[owner], grid), stable=True)
    total = grid.rows * grid.columns
    pairs = torch.bincount(cameras[owner] * total + tile, minlength=grid.cameras * total)
    offsets = (pairs.cumsum(0) - pairs).int().view(grid.cameras, grid.rows, grid.columns)
    return Intersections(counts.int(), ids, owner[order].int(), offsets)


def _boxes(
    means2d: Tensor, radii: Tensor, grid: Grid
) -> tuple[Int[Tensor, "G 2"], Int[Tensor, "G 2"]]:
    """First column and row of tiles of each box, and the number of both; 0 if culled."""
    center, reach = means2d / grid.size, radii / grid.size
    limit = torch.tensor([grid.columns, grid.rows], dtype=torch.float32)
    zero = torch.zeros(2)
    first = torch.floor(center - reach).clamp(zero, limit)
    end = torch.ceil(center + reach).clamp(zero, limit)
    return first.long(), (end - first).long() * is_seen(radii)[:, None]


def _ids(cameras: Tensor, tiles: Tensor, depths: Tensor, grid: Grid) -> Int[Tensor, " I"]:
    bits = (grid.rows * grid.columns).bit_length()
    # Bits of a positive float sort like the float; the mask undoes the sign's extension.
    depth = depths.detach().contiguous().view(torch.int32).long() & 0xFFFFFFFF
    return (cameras << (32 + bits)) | (tiles << 32) | depth
