"""The ``info`` of ``rasterization``: gsplat's dictionary, of which the costly entries wait.

Notation: N Gaussians, C cameras, G = C N, or packed the number of those seen, camera by camera.
Promise: gsplat 1.5.3's keys, shapes and types; a training step pays for none of the lists of
intersections, which are made when one of them is read for the first time.
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
    """What stands in a list's place."""

    UNTIL_READ = "made when it is read"


class Info(dict[str, Any]):
    """A dictionary whose lists of intersections are made when one of them is read.

    ``in``, ``len``, ``keys()`` and printing know all names and make nothing; whatever hands out an
    entry, a copy of the dictionary too, makes it.
    """

    def __getitem__(self, name: str) -> Any:
        if super().__getitem__(name) is _Wait.UNTIL_READ:
            self._make_lists()
        return super().__getitem__(name)

    def __iter__(self) -> Iterator[str]:  # without it ``dict(info)`` would copy past ``[]``
        return super().__iter__()

    def __or__(self, other: Any) -> Any:
        return dict(self) | other

    def __ror__(self, other: Any) -> Any:
        return other | dict(self)

    def copy(self) -> dict[str, Any]:
        """A plain dictionary of the same entries."""
        return dict(self)

    def get(self, name: str, default: Any = None) -> Any:
        """The entry, or the default where there is none."""
        return self[name] if name in self else default  # noqa: SIM401  (which is this)

    def items(self) -> Any:
        """Names and entries."""
        self._make_lists()
        return super().items()

    def pop(self, name: str, *default: Any) -> Any:
        """The entry, taken out; the default where there is none."""
        self.get(name)
        return super().pop(name, *default)

    def setdefault(self, name: str, default: Any = None) -> Any:
        """The entry, which becomes the default where there is none."""
        self.get(name)
        return super().setdefault(name, default)

    def values(self) -> Any:
        """The entries."""
        self._make_lists()
        return super().values()

    def _make_lists(self) -> None:
        """Put the lists in the places that wait for them."""
        places = [name for name in _LISTS if super(Info, self).get(name) is _Wait.UNTIL_READ]
        if places:
            made = self._intersections()._asdict()
            self.update({name: made[name] for name in places})

    def _intersections(self) -> Intersections:
        """Those of the Gaussians as they are listed here."""
        depths, cameras = self["depths"], self["camera_ids"]
        if cameras is None:
            cameras = torch.arange(len(depths)).repeat_interleave(depths.shape[1])
        names = ("n_cameras", "width", "height", "tile_size")
        found = intersect(
            self["means2d"].reshape(-1, 2), self["radii"].reshape(-1, 2), depths.flatten(), cameras,
            Grid(*(self[name] for name in names)),
        )  # fmt: skip
        return found._replace(tiles_per_gauss=found.tiles_per_gauss.view_as(depths))


_LISTS = Intersections._fields


def make_info(views: Sequence[View], packed: bool, width: int, height: int, tile_size: int) -> Info:
    """What ``rasterization`` says of C cameras.

    Args:
        views: The N Gaussians in each.
        packed: Whether only the Gaussians that are seen are listed, camera by camera; stacked
            otherwise.
        width: Pixels.
        height: Pixels.
        tile_size: Pixels a tile of the lists is wide and high.
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
    """Camera by camera along a new axis; what is of one camera is not copied."""
    entries: dict[str, Tensor | None] = dict.fromkeys(("batch_ids", "camera_ids", "gaussian_ids"))
    for name in View._fields:
        tensors = [getattr(view, name) for view in views]
        entries[name] = tensors[0][None] if len(tensors) == 1 else torch.stack(tensors)
    return entries
