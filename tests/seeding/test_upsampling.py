"""``upsample``: photographs by default, a fallback without them, cover, verify, budgets."""

from __future__ import annotations

import numba
import numpy as np
import pytest

import splatseed as ss
from splatseed.errors import ParameterError
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.seeding.upsampling import parse_budget, share_covered, thin_to
from splatseed.upsample.registry import SOURCE_CODES
from splatseed.views import view

PHOTOGRAPH_METHODS = ("stereo", "cover", "auto")
STEREO, COVER, CLOUD = (SOURCE_CODES[name] for name in ("stereo", "cover", "cloud"))


@pytest.fixture(scope="module")
def seeds(room):
    return ss.upsample(room)


def test_by_default_surfaces_are_found_and_gaps_filled(room, room_capture, seeds):
    count = len(room.points)
    assert set(seeds.source[:count]) == {0}
    assert {STEREO, COVER} <= set(seeds.source[count:])
    np.testing.assert_array_equal(seeds.xyz[:count], room.points.xyz)
    assert seeds.finite.all()
    off = room_capture.surfaces.distance(seeds.xyz[seeds.source == STEREO])
    assert np.median(off) < 0.02  # metres
    assert share_covered(room, room.points) < 0.9 < share_covered(room, seeds)


def test_the_maps_are_those_that_seeds_are_made_of(room, seeds):
    """Where a pixel of a map has the seed of its cell in it, both have one depth to the bit."""
    xyz = seeds.xyz[seeds.source == STEREO]
    close = 0
    for found in ss.METHODS["auto"]().maps(room, [0, 7], 0, silent):
        uv, z = found.camera.project(xyz)
        inside = (z > 0) & ((uv >= 0) & (uv < found.depth.shape[::-1])).all(axis=1)
        column, row = uv[inside].astype(int).T
        close += (np.abs(found.depth[row, column] / z[inside] - 1) < 1e-6).sum()
    assert close > 50


@pytest.mark.parametrize("method", PHOTOGRAPH_METHODS)
def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(method, room):
    first = ss.upsample(room, method, seed=3)
    threads = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        second = ss.upsample(room, method, seed=3)
    finally:
        numba.set_num_threads(threads)
    assert first.xyz.tobytes() == second.xyz.tobytes()
    assert first.rgb.tobytes() == second.rgb.tobytes()
    assert first.source.tobytes() == second.source.tobytes()


@pytest.mark.parametrize("method", PHOTOGRAPH_METHODS)
def test_held_out_photographs_are_never_read(method, room, monkeypatch):
    read = []
    load = view.load_photograph
    monkeypatch.setattr(
        view, "load_photograph", lambda path, *a: (read.append(path.name), load(path, *a))[1]
    )
    ss.upsample(room, method, hold_out=4)
    names = sorted(image.name for image in room.images)
    assert sorted(read) == [name for i, name in enumerate(names) if i % 4]


def test_without_photographs_mls_stands_in_and_says_so(room):
    notes = []
    seeds = ss.upsample(room.points, note=notes.append)
    assert len(seeds) == 4 * len(room.points)
    assert set(seeds.source) == {0, SOURCE_CODES["mls"]}
    assert any("photographs" in note and "mls" in note for note in notes)


@pytest.mark.parametrize("method", PHOTOGRAPH_METHODS)
@pytest.mark.parametrize("size", [{"ratio": 4}, {"num_points": 5000}], ids=str)
def test_the_photographs_say_how_many(method, size, room):
    with pytest.raises(ParameterError, match="--budget"):
        ss.upsample(room, method, **size)


def test_cover_fills_the_gaps_of_any_method(room):
    plain = ss.upsample(room, "linear", ratio=2)
    covered = ss.upsample(room, "linear", ratio=2, cover=8)
    np.testing.assert_array_equal(covered.xyz[: len(plain)], plain.xyz)
    assert set(covered.source[len(plain) :]) == {COVER}
    assert share_covered(room, plain) < 0.9 < share_covered(room, covered)


@pytest.mark.parametrize("method", ["linear", "auto"])
def test_a_budget_is_met_and_keeps_the_pictures_covered(method, room, seeds):
    whole = seeds if method == "auto" else ss.upsample(room, method)
    num = len(whole) // 2
    thinned = ss.upsample(room, method, budget=num)
    assert len(thinned) == num
    known = thinned.select(thinned.source != COVER)  # cover is made anew for what is left
    assert {row.tobytes() for row in known.xyz} <= {row.tobytes() for row in whole.xyz}
    assert len(known) >= 0.7 * num
    at_random = whole.select(np.random.default_rng(0).permutation(len(whole))[:num])
    assert share_covered(room, thinned) > share_covered(room, at_random)


def test_a_budget_may_be_below_the_originals_and_a_share_of_the_pixels(room):
    count = len(room.points)
    assert len(ss.upsample(room, "linear", budget=count // 2)) == count // 2
    pixels = 160 * 120
    assert len(ss.upsample(room, "cover", budget=f"{count / 2 / pixels}rho")) == round(count / 2)


def test_a_budget_that_originals_fill_is_theirs_alone(room):
    """As if new points had been made and thinned away; the user is told."""
    count, notes = room.points.num_original, []
    thinned = ss.upsample(room, budget=count // 2, note=notes.append)
    assert len(thinned) == thinned.num_original == count // 2
    assert "are thinned, and none are added" in notes[-1]
    made = ss.upsample(room, cover=8, budget=count // 2)  # the long way
    np.testing.assert_array_equal(made.xyz, thinned.xyz)


def test_a_small_budget_keeps_a_part_of_a_scan(room):
    scan = room.points.originals
    scan = scan.replace(xyz=scan.xyz + np.float32(0.2), source=np.full(len(scan), CLOUD, np.uint8))
    guesses = scan.replace(
        xyz=scan.xyz + np.float32(0.2), source=np.full(len(scan), COVER, np.uint8)
    )
    cloud = PointCloud.concatenate(room.points.originals, scan, guesses)
    num = room.points.num_original // 2
    kept = thin_to(room, cloud, num, 8, 0, 0, silent)
    assert len(kept) == num
    assert np.count_nonzero(kept.source == CLOUD) > num // 10


def test_verify_moves_and_drops_interpolated_points(room, room_capture):
    notes = []
    plain = ss.upsample(room, "mls", ratio=4)
    checked = ss.upsample(room, "mls", ratio=4, verify=True, note=notes.append)
    count = len(room.points)
    np.testing.assert_array_equal(checked.xyz[:count], room.points.xyz)
    assert count < len(checked) < len(plain)
    off = room_capture.surfaces.distance
    assert off(checked.xyz[count:]).mean() < 0.8 * off(plain.xyz[count:]).mean()
    assert any("agree with the photographs" in each for each in notes)


@pytest.mark.parametrize(
    ("budget", "number"),
    [
        ("50000", 50_000),
        (" 5e4", 50_000),
        (50_000, 50_000),
        ("50k", 50_000),
        ("0.5M", 500_000),
        ("0.25rho", 500),
        ("1 RHO", 2000),
        (2.6, 3),
    ],
)
def test_a_budget_is_a_number_or_a_density(budget, number):
    assert parse_budget(budget, 2000) == number


@pytest.mark.parametrize(
    "budget", ["", "many", "rho", "-3", "0", "0.1", "nan", "inf", "1e-9rho", "1e30", "0,25rho"]
)
def test_no_other_budget_is_taken(budget):
    with pytest.raises(ParameterError, match="expected a budget such as 50000"):
        parse_budget(budget, 2000)


@pytest.mark.parametrize("budget", ["0.25", 0.75])
def test_a_fraction_alone_may_have_been_meant_as_a_density(budget):
    with pytest.raises(ParameterError, match=rf"Did you mean {budget}rho\?"):
        parse_budget(budget, 2000)
