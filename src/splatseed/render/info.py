"""The ``info`` of ``rasterization``: gsplat's dictionary, with its costly entries computed lazily.

Notation: N Gaussians, C cameras, B batches, I = B C images, batch by batch; G = I N, or if packed
the number of visible ones, image by image. Promise: gsplat 1.5.3's keys, shapes and types; a
training step does not pay for the lists of intersections, which are made when one of them is first
read.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from enum import Enum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from splatseed.render.autograd import is_seen
from splatseed.render.intersections import Grid, Intersections, intersect


class View(NamedTuple):
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


class _Wait(Enum):
    """Placeholder of a list."""

    UNTIL_READ = "made when first read"


class Info(dict[str, Any]):
    """A dictionary whose lists of intersections are made when one of them is read.

    ``in``, ``len``, ``keys()`` and printing know all names and make nothing; whatever returns an
    entry makes it, and so does copying the dictionary.
    """

    def __init__(self, batch: tuple[int, ...], entries: Mapping[str, Any]) -> None:
        """Entries by name, of scenes with these batch dimensions."""
        super().__init__(entries)
        self.batch = batch

    def __getitem__(self, name: str) -> Any:
        if super().__getitem__(name) is _Wait.UNTIL_READ:
            self._make_lists()
        return super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:  # else ``dict(info)`` would bypass ``[]``
        return super().__iter__()

    def __or__(self, other: Any) -> Any:
        return dict(self) | other

    def __ror__(self, other: Any) -> Any:
        return other | dict(self)

    def copy(self) -> dict[str, Any]:
        """A plain dictionary of the same entries."""
        return dict(self)

    def get(self, name: str, default: Any = None) -> Any:
        """The entry, or the default if there is none."""
        return self[name] if name in self else default  # noqa: SIM401  (this method is ``get`` itself)

    def items(self) -> Any:
        """Names and entries."""
        self._make_lists()
        return super().items()

    def pop(self, name: str, *default: Any) -> Any:
        """The entry, removed; the default if there is none."""
        self.get(name)
        return super().pop(name, *default)

    def setdefault(self, name: str, default: Any = None) -> Any:
        """The entry, set to the default if there is none."""
        self.get(name)
        return super().setdefault(name, default)

    def values(self) -> Any:
        """The entries."""
        self._make_lists()
        return super().values()

    def _make_lists(self) -> None:
        """Replace the placeholders by the lists."""
        places = [name for name in _LISTS if super(Info, self).get(name) is _Wait.UNTIL_READ]
        if places:
            made = self._intersections()._asdict()
            self.update({name: made[name] for name in places})

    def _intersections(self) -> Intersections:
        """The intersections of the Gaussians in the order listed here."""
        depths = self["depths"]
        images = self["n_batches"] * self["n_cameras"]
        if self["camera_ids"] is None:
            owners = torch.arange(images).repeat_interleave(depths.shape[-1])
        else:
            owners = self.image_ids()
        sizes = (self[name] for name in ("width", "height", "tile_size"))
        made = intersect(
            self["means2d"].reshape(-1, 2), self["radii"].reshape(-1, 2), depths.flatten(), owners,
            Grid(images, *sizes),
        )  # fmt: skip
        return made._replace(
            tiles_per_gauss=made.tiles_per_gauss.view_as(depths),
            isect_offsets=made.isect_offsets.view(
                *self.batch, self["n_cameras"], *made.isect_offsets.shape[1:]
            ),
        )

    def image_ids(self) -> Tensor:
        """The image of each packed Gaussian, [G]."""
        ids: Tensor = self["batch_ids"] * self["n_cameras"] + self["camera_ids"]
        return ids


_LISTS = Intersections._fields


def make_info(
    views: Sequence[View],
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
    grid = Grid(len(views), width, height, tile_size)
    return Info(
        batch,
        {
            **(_packed(views, cameras) if packed else _stacked(views, (*batch, cameras))),
            "tile_width": grid.columns,
            "tile_height": grid.rows,
            **dict.fromkeys(_LISTS, _Wait.UNTIL_READ),
            "width": width,
            "height": height,
            "tile_size": tile_size,
            "n_batches": batches,
            "n_cameras": cameras,
        },
    )


def _packed(views: Sequence[View], cameras: int) -> dict[str, Tensor]:
    ids = [torch.nonzero(is_seen(view.radii))[:, 0] for view in views]
    images = torch.cat([torch.full_like(each, image) for image, each in enumerate(ids)])
    entries = {
        "batch_ids": images // cameras,
        "camera_ids": images % cameras,
        "gaussian_ids": torch.cat(ids),
    }
    for name in View._fields:
        rows = [getattr(view, name)[each] for view, each in zip(views, ids, strict=True)]
        entries[name] = torch.cat(rows)
    return entries


def _stacked(views: Sequence[View], shape: tuple[int, ...]) -> dict[str, Tensor | None]:
    """Image by image along axes of ``shape``; a single image's entries are not copied."""
    entries: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    for name in View._fields:
        tensors = [getattr(view, name) for view in views]
        stacked = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
        entries[name] = stacked.view(*shape, *stacked.shape[1:])
    return entries
