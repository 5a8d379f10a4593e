"""Budgets above what the sparse comparison gives: as many seeds as photographs confirm."""

from __future__ import annotations

import dataclasses
import re
import tracemalloc

import numpy as np
import pytest

import splatseed as ss
from splatseed.methods import SOURCE_CODES
from splatseed.runtime import memory
from splatseed.seeding import dense
from splatseed.seeding.dense import plan_comparisons

STEREO, COVER = SOURCE_CODES["stereo"], SOURCE_CODES["cover"]
BUDGET = 9000


@pytest.fixture(scope="module")
def sparse(room):
    return ss.upsample(room)


@pytest.fixture(scope="module")
def made(room):
    """Dense seeds, and what was said before and after."""
    before, notes = [], []
    seeds = ss.upsample(room, budget=BUDGET, announce=before.append, note=notes.append)
    return seeds, before, notes


def test_a_budget_is_filled_where_photographs_confirm_points(made, sparse, room, room_capture):
    seeds, before, notes = made
    assert len(sparse) < 0.6 * BUDGET < 0.9 * BUDGET < len(seeds) <= BUDGET
    count = len(room.points)
    np.testing.assert_array_equal(seeds.xyz[:count], room.points.xyz)
    assert seeds.num_original == count
    new, old = (each.select(each.source == STEREO) for each in (seeds, sparse))
    assert len(new) > 3 * len(old)
    # Guesses stay as sparse as they are.
    assert (seeds.source == COVER).sum() < 1.1 * (sparse.source == COVER).sum()
    off = [room_capture.surfaces.distance(each.xyz.astype(float)) for each in (new, old)]
    for near in (0.01, 0.05):  # metres, in a room of 4
        assert (off[0] < near).mean() > (off[1] < near).mean() - 0.02
    cosine = np.abs(
        (room_capture.surfaces.normals(new.xyz.astype(float)) * new.normals).sum(axis=1)
    )
    assert np.median(cosine) > 0.97
    assert 0 < np.median(new.sizes) < 0.7 * np.median(old.sizes)
    assert ((new.confidence > 0) & (new.confidence <= 1)).all()
    assert len(before) == 1
    assert re.search(r"9,000 points: 16 photographs .* 160 x 120 .* about .* of memory", before[0])
    assert not [note for note in notes if "budget" in note]


def test_what_photographs_do_not_confirm_is_not_made_up(room, sparse):
    notes = []
    seeds = ss.upsample(room, "stereo", budget="10M", note=notes.append)
    assert len(sparse) < len(seeds) < 200_000
    assert f"Photographs confirm {len(seeds):,} of the 10,000,000 points" in notes[-1]


def test_a_budget_that_sparse_seeds_fill_only_thins_them(room, sparse, monkeypatch):
    monkeypatch.setattr(dense, "compare_closer", None)
    for budget in (len(sparse) // 2, len(sparse)):
        thinned = ss.upsample(room, budget=budget)
        same = ss.upsample(room, budget=budget, dense=False)
        assert thinned.xyz.tobytes() == same.xyz.tobytes()
        assert len(thinned) == budget
    plain = ss.upsample(room, budget=2 * len(sparse), dense=False)
    assert plain.xyz.tobytes() == sparse.xyz.tobytes()


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(made, room, set_threads):
    set_threads(1)
    second = ss.upsample(room, budget=BUDGET)
    for name in ("xyz", "rgb", "source", "normals", "sizes", "confidence"):
        assert getattr(made[0], name).tobytes() == getattr(second, name).tobytes()


def test_memory_is_predicted_and_kept_within_what_is_free(room, monkeypatch):
    monkeypatch.setattr(dense, "resident_bytes", lambda: 1)
    before, notes = [], []
    tracemalloc.start()
    ss.upsample(room, budget=BUDGET, announce=before.append)
    peak = tracemalloc.get_traced_memory()[1] / 2**20
    tracemalloc.stop()
    predicted = float(re.search(r"and (\d+) MB of memory", before.pop())[1])
    assert 0.5 * peak < predicted < 2 * peak
    plans = plan_comparisons(room.images, 1, 4, 1.0, 10**7)
    assert [plan.grid for plan in plans] == [1, 2, 3, 4]
    assert [plan.memory for plan in plans] == sorted((p.memory for p in plans), reverse=True)
    free = int(plans[1].memory / dense.DENSE.usable) + 2
    monkeypatch.setattr(dense, "free_memory", lambda: free)
    ss.upsample(room, budget="10M", note=notes.append, announce=before.append)
    assert "with a depth every 2" in before[0]
    assert f"{memory.format_bytes(plans[0].memory)} hold all" in notes[-1]


@pytest.mark.parametrize(
    ("finest", "expected"),
    [(4.2, (2, 2)), (1.0, (2, 2)), (8.5, (2, 4)), (10.0, (2, 4)), (12.0, (3, 4)), (40.0, (3, 4))],
)
def test_size_and_grid_follow_from_the_spacing(finest, expected, room):
    """Photographs of 1,800 pixels, which the first comparison reduced by 3."""
    image = room.images[0]
    lens = image.intrinsics.resized(1800, 1350)
    images = [dataclasses.replace(image, intrinsics=lens)]
    plan = plan_comparisons(images, 3, 4, finest, 1000)[0]
    assert (plan.factor, plan.grid) == expected
