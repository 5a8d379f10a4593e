"""Prepare a cloud for all methods: clean, centred, spatially sorted, with neighbours.

Notation: n distinct finite originals in *rows* (kd-tree leaf order: neighbouring rows are
neighbours in space, which keeps every later pass in cache); ``rank`` is a row's place among them
in file order; k neighbours per row, nearest first, never the row itself; h = ``spacing`` = mean
distance to the 6 nearest. A point's *number* is its place in the array that a kd-tree was built
from.
Promise: random draws are assigned by rank, not by row, and equal distances are ordered by number,
also where the k-th of them is as far as the next, so that results follow from the points alone: any
tree over the same points gives the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float64, Int32, Int64, UInt8
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.methods.contract import nothing_finite
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress, in_threads, silent
from splatseed.runtime.memory import check_memory
from splatseed.scene import Scene

SPACING_NEIGHBORS = 6  # nearest points over which the spacing h is averaged
OUTLIER_NEIGHBORS = 16  # neighbours that a point's spacing is compared with
OUTLIER_FACTOR = 3.0
"""Spacing of an isolated point over the lower quartile of theirs: finds 55% of planted outliers."""
NEIGHBOR_BYTES = 12
"""Memory per neighbour: its row, int32, and its distance, float64."""
QUERY_BLOCK = 1 << 13  # rows per task of a thread
SHORT_TRACK = 3  # images, up to which a track counts as short
BAD_ERROR = 2.0  # reprojection errors above this are bad, in units of the scene's median
DRAW_BLOCK = 1 << 20
"""Ranks per block: bases are drawn per block first, then within it."""


@dataclass(frozen=True, eq=False)
class Neighbors:
    """The k nearest other rows of each row, nearest first, and their distances."""

    idx: Int32[np.ndarray, "n k"]
    distance: Float64[np.ndarray, "n k"]

    @property
    def k(self) -> int:
        """Neighbours per row."""
        return int(self.idx.shape[1])

    @cached_property
    def spacing(self) -> Float64[np.ndarray, " n"]:
        """Local spacing h of every row: mean distance to the 6 nearest (fewer if k < 6)."""
        return np.asarray(self.distance[:, :SPACING_NEIGHBORS].mean(axis=1))

    def nearest(self, k: int) -> Neighbors:
        """Return the first ``k`` neighbours of each row."""
        if k >= self.k:
            return self
        return Neighbors(
            np.ascontiguousarray(self.idx[:, :k]), np.ascontiguousarray(self.distance[:, :k])
        )


@dataclass(frozen=True, eq=False)
class PreparedCloud:
    """Distinct finite originals in spatial order."""

    xyz: Float64[np.ndarray, "n 3"]  # relative to ``center``, scene units
    rgb: UInt8[np.ndarray, "n 3"]
    rank: Int64[np.ndarray, " n"]  # place of each row in file order
    trusted: Bool[np.ndarray, " n"]  # rows that may serve as bases
    center: Float64[np.ndarray, " 3"]  # centroid in the world
    tree: cKDTree  # over the positions in file order
    progress: Progress = silent

    def __len__(self) -> int:
        return len(self.xyz)

    def neighbors(self, k: int) -> Neighbors:
        """Find the ``k`` nearest other rows of each row, or all if there are fewer.

        Raises:
            PointCloudError: There is one point only.
            ParameterError: ``k`` neighbours of all points do not fit into memory.
        """
        k = min(k, len(self) - 1)
        if k < 1:
            raise PointCloudError(
                "at least 2 distinct finite points",
                found=f"{len(self)}",
                fix="Check that the scene holds more than one point.",
            )
        check_memory(
            k, NEIGHBOR_BYTES * len(self), f"neighbours of each of {len(self):,} points",
            fix="Pass a smaller k, {limit} at most, or close other programs.",
        )  # fmt: skip
        tree, idx = self.tree, np.empty((len(self), k), np.int32)
        row_of_rank = np.empty(len(self), np.int32)
        row_of_rank[self.rank] = np.arange(len(self), dtype=np.int32)

        def query(start: int, stop: int) -> None:
            _, ranks = nearest_others(tree, self.xyz[start:stop], self.rank[start:stop], k)
            idx[start:stop] = row_of_rank[ranks]

        in_threads(query, len(self), QUERY_BLOCK, "neighbours", self.progress)
        farthest = float(np.abs(self.xyz).max())
        return Neighbors(idx, distances_of(self.xyz, idx, min_distance(farthest)))


def min_distance(farthest: float) -> float:
    """Return the smallest distance of points whose largest centred coordinate is ``farthest``.

    It replaces 0 for points that centring in float64 has made equal.
    """
    return float(np.finfo(np.float64).eps * farthest)


def prepare(
    points: PointCloud, trusted: Bool[np.ndarray, " N"] | None = None, progress: Progress = silent
) -> PreparedCloud:
    """Mask, de-duplicate, centre and sort the originals of a cloud (``source`` 0).

    ``trusted`` marks the points that may be bases (all if None). Queries for neighbours report to
    ``progress``. Raises ``PointCloudError`` if there is no finite original.
    """
    originals = np.flatnonzero(points.source == ORIGINAL)
    keep_idx = originals[points.select(originals).distinct]
    if len(keep_idx) == 0:
        raise nothing_finite(len(points))
    # In float64 about the centroid: UTM coordinates lose nothing.
    center = points.xyz[keep_idx].sum(axis=0, dtype=np.float64) / len(keep_idx)
    xyz = points.xyz[keep_idx].astype(np.float64) - center
    tree = cKDTree(xyz, balanced_tree=False)
    rank = np.asarray(tree.indices, np.int64)
    rows = keep_idx[rank]
    trusted_rows = np.ones(len(rows), bool) if trusted is None else trusted[rows]
    return PreparedCloud(xyz[rank], points.rgb[rows], rank, trusted_rows, center, tree, progress)


def prepare_scene(scene: Scene, progress: Progress = silent) -> PreparedCloud:
    """Prepare the originals of a scene; only ``trusted_originals`` may be bases."""
    return prepare(scene.points.originals, trusted_originals(scene), progress)


def trusted_originals(scene: Scene) -> Bool[np.ndarray, " N"] | None:
    """Mark the originals with a long track or a small error, which may be bases; None for all.

    A point in few images with a large reprojection error is often a mismatch. On the demo capture
    this rule finds 43% of the planted outliers and 0.8% of the others; with the rule for isolated
    points (``sound_bases``) 75% and 0.9%. On real Kinect data (7-Scenes red kitchen against its
    depth maps) it finds only 3% of the points that are over 40 cm off. Untrusted points stay in the
    output; no point is made from them.
    """
    tracks = scene.tracks
    if tracks is None or len(tracks) != scene.points.num_original or len(tracks) == 0:
        return None
    known = tracks.errors >= 0
    if not known.any():
        return None
    limit = BAD_ERROR * np.median(tracks.errors[known])
    return np.asarray((tracks.lengths > SHORT_TRACK) | (tracks.errors <= limit))


@dataclass(frozen=True, eq=False)
class Bases:
    """Number and place of the new points of each row, in a CSR layout.

    Row i makes the new points ``start[i] : start[i] + count[i]``, ordered by rank.
    """

    start: Int64[np.ndarray, " n"]
    count: Int64[np.ndarray, " n"]
    total: int


def draw_bases(
    cloud: PreparedCloud,
    num_new: int,
    rng: np.random.Generator,
    *,
    weight: Float64[np.ndarray, " n"],
) -> Bases:
    """Draw ``num_new`` bases with probability proportional to ``weight`` [n], with replacement.

    If all weights are 0, all rows are equally likely.
    """
    by_rank = np.empty(len(cloud))
    by_rank[cloud.rank] = weight if weight.any() else 1.0
    blocks = [by_rank[first : first + DRAW_BLOCK] for first in range(0, len(cloud), DRAW_BLOCK)]
    sums = np.array([block.sum() for block in blocks])
    totals = rng.multinomial(num_new, sums / sums.sum())
    # Counts per base, drawn by rank: rows depend on how the kd-tree cut space.
    drawn = [
        rng.multinomial(total, block / block.sum()) if total else np.zeros(len(block), np.int64)
        for block, total in zip(blocks, totals, strict=True)
    ]
    counts = np.concatenate(drawn)
    starts = np.cumsum(counts) - counts
    return Bases(starts[cloud.rank], counts[cloud.rank].astype(np.int64), num_new)


def sound_bases(cloud: PreparedCloud, neighbors: Neighbors) -> Float64[np.ndarray, " n"]:
    """Return weight 1 for trusted rows that are not isolated, else 0.

    An isolated row has a spacing of over 3 times the lower quartile of its neighbours' spacings.
    The test is local; a global one would take a sparse background for noise.
    """
    spacing, idx = neighbors.spacing, neighbors.idx[:, :OUTLIER_NEIGHBORS]
    isolated = np.empty(len(idx), bool)
    # The lower quartile, which a few outliers among the neighbours do not move.
    nth = idx.shape[1] // 4

    def check(start: int, stop: int) -> None:
        quartile = np.partition(spacing[idx[start:stop]], nth, axis=1)[:, nth]
        isolated[start:stop] = spacing[start:stop] > OUTLIER_FACTOR * quartile

    in_threads(check, len(idx), QUERY_BLOCK, "isolated points", silent)
    return np.asarray(cloud.trusted & ~isolated, np.float64)


AT_ONCE = 1 << 20  # neighbours fetched at once for points at whose k-th distance there are several


def nearest_others(
    tree: cKDTree, xyz: Float64[np.ndarray, "q 3"], own: Int64[np.ndarray, " q"], k: int
) -> tuple[Float64[np.ndarray, "q k"], Int64[np.ndarray, "q k"]]:
    """Find the k nearest points of a tree to each query, except the query itself.

    Args:
        tree: Of n points.
        xyz: Queries.
        own: Number of the tree's point that a query is, -1 if it is none.
        k: Neighbours.

    Returns:
        Distances and numbers; infinite and n where the tree has fewer points.
    """
    # One for the query itself, and one to see whether another is as far as the k-th.
    distance, number = _others(tree, xyz, own, k + 2)
    first, second = distance[:, :k], distance[:, 1 : k + 1]
    tied = np.flatnonzero(((first == second) & np.isfinite(second)).any(axis=1))
    if len(tied):
        distance[tied, :k], number[tied, :k] = _resolved(tree, xyz[tied], own[tied], k, k + 2)
    return distance[:, :k], number[:, :k]


def _others(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """Find the ``wanted - 1`` nearest points other than the query, ties in any order."""
    if (own < 0).all():
        distance, number = tree.query(xyz, wanted - 1)
        return distance, number
    distance, number = tree.query(xyz, wanted)
    # Queries are mostly the first of their own neighbours, but for those at distance 0 beside
    # another that rounding has brought together.
    other = np.flatnonzero(number[:, 0] != own)
    if len(other):
        itself = number[other] == own[other, None]
        place = np.where(itself.any(axis=1), itself.argmax(axis=1), wanted - 1)
        moved = np.arange(wanted) <= place[:, None]
        for values in (distance, number):
            rows = values[other]
            values[other] = np.where(moved, np.roll(rows, 1, axis=1), rows)
    return distance[:, 1:], number[:, 1:]


def _resolved(
    tree: cKDTree, xyz: np.ndarray, own: np.ndarray, k: int, wanted: int
) -> tuple[np.ndarray, np.ndarray]:
    """Order ties by number: query more points until one is farther than the k-th."""
    distance, number = np.empty((len(xyz), k)), np.empty((len(xyz), k), np.int64)
    for start in range(0, len(xyz), max(AT_ONCE // wanted, 1)):
        part = slice(start, start + max(AT_ONCE // wanted, 1))
        found, which = sort_rows(*_others(tree, xyz[part], own[part], wanted))
        distance[part], number[part] = found[:, :k], which[:, :k]
        last = found[:, -1]
        open_ = np.flatnonzero((last == found[:, k - 1]) & np.isfinite(last)) + start
        if len(open_):
            more = min(2 * wanted, tree.n + 2)  # then the last is missing
            distance[open_], number[open_] = _resolved(tree, xyz[open_], own[open_], k, more)
    return distance, number


def sort_rows(
    distance: Float64[np.ndarray, "q m"], number: Int64[np.ndarray, "q m"]
) -> tuple[Float64[np.ndarray, "q m"], Int64[np.ndarray, "q m"]]:
    """Sort each row by distance, then by number."""
    order = np.lexsort((number, distance), axis=1)
    return np.take_along_axis(distance, order, axis=1), np.take_along_axis(number, order, axis=1)


def distances_of(
    xyz: Float64[np.ndarray, "n 3"], idx: Int32[np.ndarray, "m k"], minimum: float
) -> Float64[np.ndarray, "m k"]:
    """Compute the distances of the first m rows from their neighbours, at least ``minimum``."""
    distance = np.empty(idx.shape)

    def fill(start: int, stop: int) -> None:
        apart = xyz[idx[start:stop]] - xyz[start:stop, None]
        apart *= apart
        squared = apart[..., 0] + apart[..., 1] + apart[..., 2]
        distance[start:stop] = np.maximum(np.sqrt(squared), minimum)

    in_threads(fill, len(idx), QUERY_BLOCK, "distances", silent)
    return distance
