"""Boxes that each hold about as many points: the cuts of a kd-tree, made by a sample.

Notation: a *cut* halves a box across one axis, what lies below it to the left; a *tile* is a box
that is not cut further. Tiles are numbered from left to right through the tree, so that tiles of
neighbouring numbers lie beside each other. Promise: every finite point is in exactly one tile.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float32, Int32

from splatseed.kernels.jit import kernel, parallel_range


@dataclass
class Cuts:
    """A kd-tree's cuts.

    Args:
        axis: The axis of each cut.
        at: Its coordinate.
        child: What is left and right of it: another cut from 0, or the tile ``-1 - child``.
        walls: The lowest and highest corner of each tile, some of them infinite.
    """

    axis: list[int] = field(default_factory=list)
    at: list[np.float32] = field(default_factory=list)
    child: list[list[int]] = field(default_factory=list)
    walls: list[Float32[np.ndarray, "2 3"]] = field(default_factory=list)

    def __len__(self) -> int:
        """The number of tiles."""
        return len(self.walls)

    def tiles_of(self, xyz: Float32[np.ndarray, "n 3"]) -> Int32[np.ndarray, " n"]:
        """The tile of each point, int32 [n]."""
        out = np.zeros(len(xyz), np.int32)
        if self.axis:
            child = np.array(self.child, np.int32)
            _descend(xyz, np.array(self.axis, np.int32), np.array(self.at), child, out)
        return out


@kernel
def _descend(xyz, axis, at, child, out):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(len(xyz)):
        node = 0
        while node >= 0:
            side = 1 if xyz[i, axis[node]] >= at[node] else 0
            node = child[node, side]
        out[i] = -1 - node


def cut_up(sample: Float32[np.ndarray, "s 3"], rows: int, most: int) -> Cuts:
    """Cuts for a cloud.

    Args:
        sample: Some of its finite points, chosen evenly.
        rows: Points of the cloud.
        most: Points wanted in a tile.
    """
    each = max(most * len(sample) / max(rows, 1), 1.0)
    cuts = Cuts()
    walls = np.array([[-np.inf] * 3, [np.inf] * 3], np.float32)
    parts = max(int(np.ceil(len(sample) / each)), 1)
    _cut(cuts, sample, parts, walls)
    return cuts


def _cut(cuts: Cuts, sample: np.ndarray, parts: int, walls: np.ndarray) -> int:
    """Cut a box into ``parts`` tiles; returns the number that its parent has for it."""
    place = _where(sample, parts // 2 / parts) if parts > 1 else None
    if place is None:
        cuts.walls.append(walls)
        return -len(cuts.walls)
    axis, at = place
    node = len(cuts.axis)
    cuts.axis.append(axis)
    cuts.at.append(at)
    cuts.child.append([0, 0])
    below = sample[:, axis] < at
    share = np.count_nonzero(below) / len(sample)
    left = min(max(round(share * parts), 1), parts - 1)
    for side, (chosen, number) in enumerate(((below, left), (~below, parts - left))):
        inner = walls.copy()
        inner[1 - side, axis] = at
        cuts.child[node][side] = _cut(cuts, sample[chosen], number, inner)
    return node


def _where(sample: np.ndarray, share: float) -> tuple[int, np.float32] | None:
    """The axis and the place of a cut with about ``share`` of the sample below it, if any."""
    if not len(sample):
        return None
    axis = int(np.argmax(sample.max(axis=0).astype(np.float64) - sample.min(axis=0)))
    values = sample[:, axis]
    at = np.partition(values, int(share * len(values)))[int(share * len(values))]
    if at == values.min():  # nothing would be below it
        above = values[values > at]
        if not len(above):
            return None
        at = above.min()
    return axis, at
