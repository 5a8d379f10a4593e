"""Choose the pairs of photographs to match by a first look at few large features of every pair.

Preemptive matching (Wu 2013, "Towards linear-time incremental structure from motion"): features of
the largest scales are few, and overlapping photographs have many of them in common. Every pair is
matched by its 256 largest features, which costs a hundredth of a full match; only the pairs that
agree best are matched in full.

Notation: N photographs in order of name; K features each; photographs are indices from 0.
``agreement`` [N, N] counts the mutual matches between the K largest features of two photographs.
Promise: results depend on the features only. Products of 8-bit descriptors are integers below 2^24,
which float32 sums exactly in any order.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float32, Int32, UInt8
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from splatseed.progress import Progress, in_threads, silent

Pair: TypeAlias = tuple[int, int]
Agreement: TypeAlias = Int32[np.ndarray, "N N"]


@dataclass(frozen=True)
class FirstLook:
    """Settings of the first look."""

    features: int = 256
    """Largest features of a photograph that are compared."""
    max_ratio: float = 0.8
    """Largest ratio of the angles to the nearest and the second descriptor, COLMAP's default."""
    max_angle: float = 0.7
    """Largest angle between matching descriptors, radians, COLMAP's default."""
    partners: int = 12
    """Partners of a photograph: those that agree best with it."""
    max_partners: int = 20
    """The same while all pairs are few: 12 lose 5% of the points of 35 photographs, 20 lose 2%."""
    few_pairs: int = 1_000
    """Pairs, counted once for both photographs, that are few: a minute or two of matching."""
    bridges: int = 8
    """Further partners, each outside the neighbourhoods of the others: they close loops."""
    min_agreement: int = 8
    """Fewest common features of a further partner: chance gives fewer."""
    successors: int = 2
    """Following photographs by name that are always matched: names mostly follow time."""
    max_exhaustive: int = 28
    """Up to as many photographs, all pairs are matched: there is little to save."""
    further: int = 36
    """Partners to add for a photograph that is poorly connected or gets no pose."""
    strong: int = 30
    """Fewest verified matches of a strong connection: COLMAP's fewest for a pose."""
    min_connections: int = 3
    """Photographs with fewer strong connections are poorly connected."""


FIRST_LOOK = FirstLook()
STAGE = "first look"
NEIGHBOURS = "neighbour matching"  # a stage that follows if poses are known
_NORM = 512.0  # of SIFT's descriptors as 8-bit integers, in COLMAP and elsewhere


def largest_features(database: Any, image_ids: Sequence[int]) -> UInt8[np.ndarray, "N K 128"]:
    """Read the descriptors of the largest features of images; rows of zeros fill up."""
    found = np.zeros((len(image_ids), FIRST_LOOK.features, 128), np.uint8)
    for row, image_id in zip(found, image_ids, strict=True):
        # COLMAP's keypoints are x, y and the affine shape [[2, 3], [4, 5]].
        shapes = database.read_keypoints(image_id)[:, 2:6].reshape(-1, 2, 2)
        areas = np.abs(np.linalg.det(shapes))
        largest = np.argsort(-areas, kind="stable")[: len(row)]
        row[: len(largest)] = database.read_descriptors(image_id).data[largest]
    return found


def measure_agreement(
    features: UInt8[np.ndarray, "N K 128"], progress: Progress = silent
) -> Agreement:
    """Count the mutual nearest neighbours of every two photographs that pass COLMAP's tests."""
    number, count = len(features), np.zeros((len(features), len(features)), np.int32)
    exact = features.astype(np.float32)

    def compare(i: int, _: int) -> None:
        for j in range(i + 1, number, _AT_ONCE):
            count[i, j : j + _AT_ONCE] = _matches(exact[i], exact[j : j + _AT_ONCE])

    in_threads(compare, max(number - 1, 0), 1, STAGE, progress)
    return count + count.T


_AT_ONCE = 8  # photographs compared with another at once: 2 MB of products stay in cache


def _matches(
    one: Float32[np.ndarray, "K 128"], others: Float32[np.ndarray, "J K 128"]
) -> Int32[np.ndarray, " J"]:
    number, size, _ = others.shape
    products = (one @ others.reshape(-1, 128).T).reshape(size, number, size)  # one's K first
    nearest = products.argmax(axis=2)[..., None]  # of each of one's K, in each other photograph
    best = np.take_along_axis(products, nearest, 2)[..., 0]
    of_other = products.max(axis=0)  # J, K
    mutual = best == of_other[np.arange(number), nearest[..., 0]]
    np.put_along_axis(products, nearest, -1.0, 2)
    angle, second = (
        np.arccos(np.minimum(each / _NORM**2, 1.0)) for each in (best, products.max(axis=2))
    )
    good = mutual & (angle < FIRST_LOOK.max_angle) & (angle < FIRST_LOOK.max_ratio * second)
    return np.asarray(good.sum(axis=0), np.int32)


def choose_pairs(agreement: Agreement) -> list[Pair]:
    """Choose pairs for a connected graph that closes loops, sorted.

    Each photograph gets its 12 to 20 best partners; then further ones that agree with it and are
    not among the best partners of those before; and its successors by name.
    """
    number = len(agreement)
    if number <= FIRST_LOOK.max_exhaustive:
        return [(i, j) for i in range(number) for j in range(i + 1, number)]
    ranked, few = ranking(agreement), 2 * FIRST_LOOK.few_pairs // number
    count = max(FIRST_LOOK.partners, min(few, FIRST_LOOK.max_partners))
    best = [partners[:count] for partners in ranked]
    chosen = set[Pair]()
    for i in range(number):
        bridges, covered = list[int](), {i, *best[i]}
        for j in ranked[i]:
            if len(bridges) == FIRST_LOOK.bridges or agreement[i, j] < FIRST_LOOK.min_agreement:
                break
            if j not in covered:
                bridges.append(j)
                covered |= {j, *best[j]}
        successors = range(i + 1, min(i + 1 + FIRST_LOOK.successors, number))
        chosen |= {(min(i, j), max(i, j)) for j in (*best[i], *bridges, *successors)}
    return sorted(chosen)


def ranking(agreement: Agreement) -> list[list[int]]:
    """List the other photographs with common features of each one, best first."""
    order = np.argsort(-agreement, axis=1, kind="stable")
    return [[int(j) for j in row if agreement[i, j] > 0 and j != i] for i, row in enumerate(order)]


def poorly_connected(number: int, verified: Mapping[Pair, int]) -> list[int]:
    """Find photographs with few strong connections, or outside the largest connected part.

    ``verified``: the number of verified matches of pairs.
    """
    strong = np.array([p for p, count in verified.items() if count >= FIRST_LOOK.strong], np.int64)
    rows, columns = strong.reshape(-1, 2).T
    graph = coo_array((np.ones(len(rows), bool), (rows, columns)), (number, number))
    _, part = connected_components(graph, directed=False)
    connections = np.bincount(strong.ravel(), minlength=number)
    apart = part != np.bincount(part).argmax()
    return np.flatnonzero(apart | (connections < FIRST_LOOK.min_connections)).tolist()


def further_pairs(
    agreement: Agreement, photographs: Iterable[int], matched: Collection[Pair]
) -> list[Pair]:
    """Choose the next best partners of some photographs, sorted; ``matched`` are left out."""
    ranked, chosen = ranking(agreement), set[Pair]()
    for i in photographs:
        pairs = [(min(i, j), max(i, j)) for j in ranked[i]]
        chosen |= set([pair for pair in pairs if pair not in matched][: FIRST_LOOK.further])
    return sorted(chosen)
