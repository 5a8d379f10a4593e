"""The ``info`` of ``rasterization``: gsplat's dictionary, with its costly entries computed lazily.

Notation: N Gaussians, C cameras, G = C N, or if packed the number of visible ones, camera by
camera. Promise: gsplat 1.5.3's keys, shapes and types; a training step does not pay for the lists
of intersections, which are made when one of them is first read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from enum import Enum
from typing import Any, NamedTuple

import torch
from torch import Tensor

from splatseed.render.autograd import is_seen
from splatseed.render.intersections import Grid, Intersections, intersect

__all__ = ["Info", "View", "make_info"]


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
        depths, cameras = self["depths"], self["camera_ids"]
        if cameras is None:
            cameras = torch.arange(len(depths)).repeat_interleave(depths.shape[1])
        names = ("n_cameras", "width", "height", "tile_size")
        made = intersect(
            self["means2d"].reshape(-1, 2), self["radii"].reshape(-1, 2), depths.flatten(), cameras,
            Grid(*(self[name] for name in names)),
        )  # fmt: skip
        return made._replace(tiles_per_gauss=made.tiles_per_gauss.view_as(depths))


_LISTS = Intersections._fields


def make_info(views: Sequence[View], packed: bool, width: int, height: int, tile_size: int) -> Info:
    """The ``info`` of C cameras.

    Args:
        views: The N Gaussians in each.
        packed: Whether only visible Gaussians are listed, camera by camera; stacked otherwise.
        width: Pixels.
        height: Pixels.
        tile_size: Side in pixels of the tiles in the lists.
    """
    grid = Grid(len(views), width, height, tile_size)
    return Info(
        {
            **(_packed(views) if packed else _stacked(views)),
            "tile_width": grid.columns,
            "tile_height": grid.rows,
            **dict.fromkeys(_LISTS, _Wait.UNTIL_READ),
            "width": width,
            "height": height,
            "tile_size": tile_size,
            "n_batches": 1,
            "n_cameras": len(views),
        }
    )


def _packed(views: Sequence[View]) -> dict[str, Tensor]:
    ids = [torch.nonzero(is_seen(view.radii))[:, 0] for view in views]
    cameras = torch.cat([torch.full_like(each, c) for c, each in enumerate(ids)])
    entries = {
        "batch_ids": torch.zeros_like(cameras),
        "camera_ids": cameras,
        "gaussian_ids": torch.cat(ids),
    }
    for name in View._fields:
        rows = [getattr(view, name)[each] for view, each in zip(views, ids, strict=True)]
        entries[name] = torch.cat(rows)
    return entries


def _stacked(views: Sequence[View]) -> dict[str, Tensor | None]:
    """Camera by camera along a new axis; a single camera's entries are not copied."""
    entries: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    for name in View._fields:
        tensors = [getattr(view, name) for view in views]
        entries[name] = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
    return entries
