"""Tile lists against every Gaussian meeting every pixel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from splatseed.rendering._kernels.binning import RECORD, TILE
from splatseed.rendering.binning import depth_order, list_tiles

View = tuple[np.ndarray, np.ndarray, np.ndarray, int, int]


def lists_of(means2d, conics, reach, width, height):
    """The lists of Gaussians whose alpha reaches 1/255 where sigma is ``reach``."""
    records = np.zeros((len(reach), RECORD), np.float32)
    records[:, :2], records[:, 2:5] = means2d, conics * np.float32([-1 / 16, -1 / 8, -1 / 16])
    records[:, 5] = (reach - np.log(255.0)) / 8
    return list_tiles(records.ravel(), width, height)


def random_view(rng, n, width, height):
    """Ellipses of all sizes and shapes in and around an image, some of one pixel, some of a
    thousand."""
    axes = np.exp(rng.uniform(np.log(0.55), np.log(300.0), (n, 2)))
    axes[n // 2 :] = axes[n // 2 :].clip(max=4.0)
    angles = rng.uniform(0.0, np.pi, n)
    turn = np.stack([np.cos(angles), -np.sin(angles), np.sin(angles), np.cos(angles)], axis=1)
    half = turn.reshape(n, 2, 2) / axes[:, None, :]
    inverse = half @ half.transpose(0, 2, 1)
    conics = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)
    means2d = rng.uniform(-30.0, 30.0 + max(width, height), (n, 2))
    reach = np.log(255.0 * rng.uniform(1 / 255, 1.0, n))
    return *(each.astype(np.float32) for each in (means2d, conics, reach)), width, height


def touched(view, slack):
    """Which Gaussian has a pixel of which tile with sigma <= reach + slack: bool [G, rows,
    columns]."""
    means2d, conics, reach, width, height = view
    columns, rows = -(-width // TILE), -(-height // TILE)
    x = np.arange(columns * TILE)[None, None, :] + 0.5 - means2d[:, 0, None, None].astype(float)
    y = np.arange(rows * TILE)[None, :, None] + 0.5 - means2d[:, 1, None, None].astype(float)
    a, b, c = (conics[:, k, None, None].astype(float) for k in range(3))
    sigma = 0.5 * (a * x * x + c * y * y) + b * x * y
    inside = sigma <= reach[:, None, None] + slack
    return inside.reshape(-1, rows, TILE, columns, TILE).any(axis=(2, 4))


def listed(lists, view):
    """Which Gaussian is listed in which tile: bool [G, rows, columns]."""
    columns, rows = -(-view[3] // TILE), -(-view[4] // TILE)
    counts = np.zeros((len(view[2]), rows * columns), int)
    tiles = np.repeat(np.arange(rows * columns), np.diff(lists.tile_start))
    np.add.at(counts, (lists.listed_rank, tiles), 1)
    assert counts.max(initial=0) <= 1, "a Gaussian is listed twice in a tile"
    return counts.reshape(-1, rows, columns).astype(bool)


@pytest.mark.parametrize("size", [(40, 33), (8, 8), (3, 5), (1, 1), (200, 9)])
def test_no_pair_is_missing_and_few_are_unnecessary(rng, size):
    view = random_view(rng, 300, *size)
    lists = lists_of(*view)
    owner = np.repeat(np.arange(len(view[2])), np.diff(lists.span_start))
    assert np.array_equal(owner[lists.listed_span], lists.listed_rank)
    counts, needed = listed(lists, view), touched(view, -1e-4)
    assert needed.any()
    assert not (needed & ~counts).any()
    # Exact in the rectangle of pixel centres, not at the centres: an ellipse may pass between them.
    assert counts.sum() <= 1.15 * touched(view, 1e-4).sum() + 10


@pytest.mark.parametrize("conic", [(1e-12, 0.0, 1e-12), (1e-38, 0.0, 1e-38), (0.0, 0.0, 0.0),
                                   (1e-40, 0.0, 1e-40), (1.0, 1.0, 1.0),
                                   (1.0, -1.0001, 1.0)])  # fmt: skip
def test_huge_or_degenerate_ellipses_are_listed_in_all_tiles(conic):
    lists = lists_of(
        np.array([[5.0, 7.0]], np.float32), np.array([conic], np.float32),
        np.array([3.0], np.float32), 40, 24,
    )  # fmt: skip
    assert lists.span_start.tolist() == [0, 3]
    assert np.diff(lists.tile_start).tolist() == [1] * 15


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(0.0, 2.0**127, width=32, allow_subnormal=True), max_size=40),
    st.integers(0, 2**31),
)
def test_depth_order_is_a_stable_sort(depths, seed):
    values = np.array(depths + depths[::2], np.float32)
    visible = np.random.default_rng(seed).random(len(values)) < 0.7
    expected = [i for i in np.argsort(values, kind="stable") if visible[i]]
    assert depth_order(values, visible).tolist() == expected
