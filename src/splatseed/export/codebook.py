"""Scalar and vector quantisation for SOG's palettes: nothing random, the same bytes every time.

Notation: a *codebook* holds the 256 numbers that stand for all values; a *palette* holds K vectors,
and a *label* says which of them stands for each of N vectors.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatseed.progress import Progress, silent

CODES = 256
LLOYD_STEPS = 20
"""Alternations of assigning values to codes and moving codes to the means."""
POWER_STEPS = 3
"""Steps of power iteration: a rough principal direction is enough to halve a group."""


def codebook(values: Float32[np.ndarray, "..."]) -> Float64[np.ndarray, " 256"]:
    """The 256 numbers, ascending, that quantise values with small square error (1D Lloyd).

    Args:
        values: At least one, finite.
    """
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # Half of the codes start evenly spaced, half at even ranks: both the tails and the middle get
    # some.
    ranks = np.quantile(ordered, (np.arange(CODES // 2) + 0.5) / (CODES // 2))
    centers = np.sort(np.concatenate([ranks, np.linspace(ordered[0], ordered[-1], CODES // 2)]))
    for _ in range(LLOYD_STEPS):
        edges = np.searchsorted(ordered, (centers[1:] + centers[:-1]) / 2)
        bounds = np.concatenate([[0], edges, [len(ordered)]])
        counts = np.diff(bounds)
        means = np.diff(sums[bounds]) / np.maximum(counts, 1)
        centers = np.sort(np.where(counts > 0, means, centers))
    return centers


def codes(
    values: Float32[np.ndarray, "..."], centers: Float64[np.ndarray, " 256"]
) -> UInt8[np.ndarray, "..."]:
    """The index of the codebook number nearest to each value."""
    return np.searchsorted((centers[1:] + centers[:-1]) / 2, values).astype(np.uint8)


def palette(
    vectors: Float32[np.ndarray, "N D"], levels: int, progress: Progress = silent
) -> tuple[Float32[np.ndarray, "K D"], Int64[np.ndarray, " N"]]:
    """2^levels vectors that stand for N: groups are halved repeatedly where they vary most.

    Args:
        vectors: Finite; N is at least 2^levels.
        levels: How often to halve.
        progress: Called with the stage and the fraction done.
    """
    count = 2**levels
    size = -(-len(vectors) // count)
    # Groups keep one size, so that a level is a few array operations; to fill up, the first are
    # repeated.
    order = np.resize(np.arange(len(vectors)), size * count)[None]
    for level in range(levels):
        progress("encode", level / levels)
        along = _spread(vectors, order)
        order = np.take_along_axis(order, np.argsort(along, axis=1, kind="stable"), axis=1)
        order = order.reshape(2 * len(order), -1)
    labels = np.empty(len(vectors), np.int64)
    labels[order] = np.arange(count)[:, None]
    sums = np.zeros((count, vectors.shape[1]))
    np.add.at(sums, labels, vectors)
    members = np.bincount(labels, minlength=count)
    return (sums / np.maximum(members, 1)[:, None]).astype(np.float32), labels


def _spread(
    vectors: Float32[np.ndarray, "N D"], order: Int64[np.ndarray, "G M"]
) -> Float32[np.ndarray, "G M"]:
    """Where each vector lies along the principal direction of its group (power iteration)."""
    along = np.empty(order.shape, np.float32)
    step = max(1, 2**20 // order.shape[1])
    for first in range(0, len(order), step):
        part = vectors[order[first : first + step]]
        part = part - part.mean(axis=1, keepdims=True)
        axis = part[np.arange(len(part)), np.argmax((part**2).sum(axis=2), axis=1)]
        for _ in range(POWER_STEPS):
            axis = np.einsum("gm,gmd->gd", np.einsum("gmd,gd->gm", part, axis), part)
            axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-20)
        along[first : first + step] = np.einsum("gmd,gd->gm", part, axis)
    return along
