"""Budgets above what the sparse comparison gives: as many seeds as photographs confirm."""

from __future__ import annotations

import dataclasses
import re
import tracemalloc

import numpy as np
import pytest

import splatseed as ss
from splatseed.depth.stereo import detail
from splatseed.methods import SOURCE_CODES
from splatseed.photos import loading
from splatseed.runtime import memory
from splatseed.seeding import dense, few_photographs
from splatseed.seeding.dense import SECOND_COMPARISON, plan_comparisons

STEREO, COVER = SOURCE_CODES["stereo"], SOURCE_CODES["cover"]
BUDGET = 6000


@pytest.fixture(scope="module")
def few(room):
    """Six photographs, which is quicker, seeded as more would be."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(few_photographs, "MAX_WITH_POINTS", 5)
        yield room.replace(images=room.images[:6])


@pytest.fixture(scope="module")
def sparse(few):
    return ss.upsample(few)


@pytest.fixture(scope="module")
def made(few):
    """Dense seeds, and what was found."""
    notes = []
    return ss.upsample(few, budget=BUDGET, note=notes.append), notes


def test_a_budget_is_filled_where_photographs_confirm_points(made, sparse, few, room_capture):
    seeds, notes = made
    assert len(sparse) < 0.6 * BUDGET < 0.9 * BUDGET < len(seeds) <= BUDGET
    count = len(few.points)
    np.testing.assert_array_equal(seeds.xyz[:count], few.points.xyz)
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
    (announced,) = notes
    assert announced.kind == SECOND_COMPARISON
    expected = r"6,000 points: 6 photographs .* 160 x 120 .* about .* of memory"
    assert re.search(expected, announced.text)


def test_what_photographs_do_not_confirm_is_not_made_up(few, sparse):
    notes = []
    seeds = ss.upsample(few, "stereo", budget="10M", note=notes.append)
    assert len(sparse) < len(seeds) < 60_000
    assert notes[-1].text == (
        f"Photographs confirm {len(seeds):,} of the 10,000,000 points of the budget."
    )


def test_where_no_third_view_confirms_a_depth_sparse_seeds_remain(few, sparse, monkeypatch):
    monkeypatch.setattr(
        detail, "_is_strong", lambda stereo, i: np.zeros_like(stereo.costs[i], bool)
    )
    notes = []
    seeds = ss.upsample(few, budget=BUDGET, note=notes.append)
    assert seeds.xyz.tobytes() == sparse.xyz.tobytes()
    confirmed = len(few.points) + (sparse.source == STEREO).sum()
    assert notes[-1].text.startswith(f"Photographs confirm {confirmed:,} of the 6,000 points")


def test_a_budget_that_sparse_seeds_fill_only_thins_them(few, sparse, monkeypatch):
    monkeypatch.setattr(dense, "compare_closer", None)
    for budget in (len(sparse) // 2, len(sparse)):
        thinned = ss.upsample(few, budget=budget)
        same = ss.upsample(few, budget=budget, dense=False)
        assert thinned.xyz.tobytes() == same.xyz.tobytes()
        assert len(thinned) == budget
    plain = ss.upsample(few, budget=2 * len(sparse), dense=False)
    assert plain.xyz.tobytes() == sparse.xyz.tobytes()


def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(made, few, set_threads):
    set_threads(1)
    second = ss.upsample(few, budget=BUDGET)
    for name in ("xyz", "rgb", "source", "normals", "sizes", "confidence"):
        assert getattr(made[0], name).tobytes() == getattr(second, name).tobytes()


def test_held_out_photographs_are_not_compared_again(few, monkeypatch):
    read, load = [], loading.load_photograph
    monkeypatch.setattr(
        loading,
        "load_photograph",
        lambda path, *a, **k: (read.append(path.name), load(path, *a, **k))[1],
    )
    seeds = ss.upsample(few, budget=BUDGET, test_every=3)
    assert 0.9 * BUDGET < len(seeds) <= BUDGET
    names = sorted(image.name for image in few.images)
    # By the check-up, and twice by stereo.
    assert sorted(read) == sorted(3 * [name for i, name in enumerate(names) if i % 3])


def test_memory_is_predicted_and_kept_within_what_is_free(few, monkeypatch):
    monkeypatch.setattr(dense, "resident_bytes", lambda: 1)
    notes = []
    tracemalloc.start()
    ss.upsample(few, budget=BUDGET, note=notes.append)
    peak = tracemalloc.get_traced_memory()[1] / 2**20
    tracemalloc.stop()
    predicted = float(re.search(r"and (\d+) MB of memory", notes.pop().text)[1])
    assert 0.5 * peak < predicted < 2 * peak
    plans = plan_comparisons(few.images, 1, 4, 1.0, 10**7)
    assert [(plan.grid, plan.split) for plan in plans] == [(2, 2), (4, 2)]
    assert plans[0].memory > plans[1].memory
    free = int(plans[1].memory / dense.DENSE.usable) + 2
    monkeypatch.setattr(dense, "free_memory", lambda: free)
    ss.upsample(few, budget="10M", note=notes.append)
    assert [note.kind for note in notes] == ["budget-not-filled"]  # as coarse as the first
    assert f"takes {memory.format_bytes(plans[0].memory)} of memory, which is not" in notes[-1].text
    assert " more fill gaps. " in notes[-1].text


@pytest.mark.parametrize(
    ("finest", "expected"),
    [
        (1.0, [(2, 2, 2), (2, 4, 2), (3, 4, 2)]),
        (4.2, [(2, 4, 2), (3, 4, 2)]),
        (8.5, [(2, 4, 1), (3, 4, 2)]),
        (10.0, [(2, 4, 1), (3, 4, 2)]),
        (12.0, [(3, 4, 1)]),
        (40.0, [(3, 4, 1)]),
    ],
)
def test_size_and_grid_follow_from_the_spacing(finest, expected, few):
    """Photographs of 1,800 pixels, which the first comparison reduced by 3."""
    image = few.images[0]
    lens = image.intrinsics.resized(1800, 1350)
    images = [dataclasses.replace(image, intrinsics=lens, folder=None)] * 2
    plans = plan_comparisons(images, 3, 4, finest, 1000)
    assert [(plan.factor, plan.grid, plan.split) for plan in plans] == expected
