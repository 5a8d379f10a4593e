"""The ``info`` of ``rasterization``: gsplat's dictionary, with its costly entries computed lazily.

Notation: N Gaussians, C cameras, B batches, I = B C images, batch by batch; G = I N, or if packed
the number of visible ones, image by image; P pairs of a Gaussian and a tile, and
ceil(height / size) x ceil(width / size) tiles per image. Promise: gsplat 1.5.3's keys, shapes,
types and numbers. A training step does not pay for the lists of pairs, which are made when
``info[...]`` first asks for one; the rasteriser has its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from splatseed.render.autograd import is_seen

LISTS = ("tiles_per_gauss", "isect_ids", "flatten_ids", "isect_offsets")
"""The entries that are made when read."""


class Projected(NamedTuple):
    """N Gaussians in one camera."""

    radii: Tensor
    """Half the sizes of their boxes, px, int32 [N, 2]; 0 where culled."""
    means2d: Tensor
    """px, [N, 2]."""
    depths: Tensor
    """z, [N]."""
    conics: Tensor
    """Inverse covariances xx, xy, yy, px^-2, [N, 3]."""
    opacities: Tensor
    """0 to 1, compensated where antialiased, [N]."""


class Info(dict[str, Any]):
    """A dictionary whose ``LISTS`` are made when ``[]`` reads one of them."""

    def __init__(self, batch: tuple[int, ...], entries: Mapping[str, Any]) -> None:
        """Entries by name, of scenes with these batch dimensions."""
        super().__init__(entries)
        self.batch = batch

    def __missing__(self, name: str) -> Any:
        if name not in LISTS:
            raise KeyError(name)
        depths, images = self["depths"], self["n_batches"] * self["n_cameras"]
        if self["camera_ids"] is None:
            owners = torch.arange(images).repeat_interleave(depths.shape[-1])
        else:
            owners = self.image_ids()
        counts, ids, rows, offsets = intersect(
            self["means2d"].reshape(-1, 2), self["radii"].reshape(-1, 2), depths.flatten(), owners,
            images, self["width"], self["height"], self["tile_size"],
        )  # fmt: skip
        offsets = offsets.view(*self.batch, self["n_cameras"], *offsets.shape[1:])
        self.update(zip(LISTS, (counts.view_as(depths), ids, rows, offsets), strict=True))
        return self[name]

    def image_ids(self) -> Tensor:
        """The image of each packed Gaussian, [G]."""
        ids: Tensor = self["batch_ids"] * self["n_cameras"] + self["camera_ids"]
        return ids


def make_info(
    views: Sequence[Projected],
    batch: tuple[int, ...],
    packed: bool,
    width: int,
    height: int,
    tile_size: int,
) -> Info:
    """The ``info`` of I images.

    Args:
        views: The N Gaussians in each.
        batch: Batch dimensions, of product B.
        packed: Whether only visible Gaussians are listed, image by image; stacked otherwise.
        width: Pixels.
        height: Pixels.
        tile_size: Side in pixels of the tiles in the lists.
    """
    batches = math.prod(batch)
    cameras = len(views) // batches
    entries: dict[str, Any] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    if packed:
        ids = [torch.nonzero(is_seen(view.radii))[:, 0] for view in views]
        images = torch.cat([torch.full_like(each, image) for image, each in enumerate(ids)])
        entries["batch_ids"], entries["camera_ids"] = images // cameras, images % cameras
        entries["gaussian_ids"] = torch.cat(ids)
    for name in Projected._fields:
        tensors = [getattr(view, name) for view in views]
        if packed:
            entries[name] = torch.cat([t[each] for t, each in zip(tensors, ids, strict=True)])
        else:  # a single image's entries are not copied
            stacked = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
            entries[name] = stacked.view(*batch, cameras, *stacked.shape[1:])
    return Info(
        batch,
        {
            **entries,
            "tile_width": -(-width // tile_size),
            "tile_height": -(-height // tile_size),
            "width": width,
            "height": height,
            "tile_size": tile_size,
            "n_batches": batches,
            "n_cameras": cameras,
        },
    )


@torch.no_grad()
def intersect(
    means2d: Float[Tensor, "G 2"],
    radii: Int[Tensor, "G 2"],
    depths: Float[Tensor, " G"],
    images: Int[Tensor, " G"],
    count: int,
    width: int,
    height: int,
    size: int,
) -> tuple[Int[Tensor, " G"], Int[Tensor, " P"], Int[Tensor, " P"], Int[Tensor, "I rows columns"]]:
    """Pair Gaussians with the tiles that their bounding boxes reach.

    A pair's id is, from the highest bit down, its image, its tile (row by row, in as many bits as
    the number of tiles needs) and the 32 bits of its depth, so that sorted ids are image by image,
    tile by tile, front to back: gsplat's ``isect_tiles`` and ``isect_offset_encode``.

    Args:
        means2d: Centres, px, float32 [G, 2].
        radii: Half the sizes of the boxes, px, int32 [G, 2]; culled where one is 0.
        depths: z, float32 [G].
        images: The image of each, int64 [G].
        count: I.
        width: Pixels.
        height: Pixels.
        size: Side of a tile in pixels.

    Returns:
        How many tiles each Gaussian touches, int32 [G]; the pairs' ids, sorted, int64 [P]; the
        Gaussian of each pair, int32 [P]; and the first pair of each tile, int32 [I, rows, columns].

    Example:
        >>> counts, _, _, offsets = intersect(
        ...     torch.tensor([[17.0, 9.0]]), torch.tensor([[3, 3]]), torch.ones(1),
        ...     torch.zeros(1, dtype=torch.int64), 1, width=40, height=20, size=16)
        >>> counts, offsets
        (tensor([2], dtype=torch.int32), tensor([[[0, 1, 2],
                 [2, 2, 2]]], dtype=torch.int32))
    """
    columns, rows = -(-width // size), -(-height // size)
    tiles = columns * rows
    limit, zero = torch.tensor([columns, rows], dtype=torch.float32), torch.zeros(2)
    center, reach = means2d / size, radii / size
    # First column and row of tiles of each box, and the number of both; 0 if culled.
    first = torch.floor(center - reach).clamp(zero, limit)
    sizes = torch.ceil(center + reach).clamp(zero, limit) - first
    first, sizes = first.long(), sizes.long() * is_seen(radii)[:, None]
    counts = sizes.prod(dim=1)
    owner = torch.repeat_interleave(counts)
    # Each pair's number within its Gaussian's box of tiles, row by row.
    place = torch.arange(len(owner)) - (counts.cumsum(0) - counts)[owner]
    across = sizes[owner, 0]
    tile = (first[owner, 1] + place // across) * columns + first[owner, 0] + place % across
    # Bits of a positive float sort like the float; the mask undoes the sign's extension.
    depth = depths.detach().contiguous().view(torch.int32).long()[owner] & 0xFFFFFFFF
    keys = (images[owner] << (32 + tiles.bit_length())) | (tile << 32) | depth
    ids, order = torch.sort(keys, stable=True)
    pairs = torch.bincount(images[owner] * tiles + tile, minlength=count * tiles)
    offsets = (pairs.cumsum(0) - pairs).int().view(count, rows, columns)
    return counts.int(), ids, owner[order].int(), offsets
