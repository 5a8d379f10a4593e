"""``upsample``: photographs by default, a fallback without them, cover, budgets."""

from __future__ import annotations

import numpy as np
import pytest

import splatseed as ss
from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.methods import SOURCE_CODES
from splatseed.photos import loading
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.scene import Split
from splatseed.seeding.budget import describe_rho, parse_budget
from splatseed.seeding.thinning import thin_to
from splatseed.seeding.upsampling import share_covered

pytestmark = pytest.mark.usefixtures("compare_once")
by_photographs = pytest.mark.parametrize("method", ["stereo", "cover", "auto"])
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


@pytest.mark.parametrize(
    ("method", "options"), [("stereo", {}), ("cover", {}), ("auto", {"budget": 600})]
)
def test_the_same_seed_gives_the_same_bytes_on_any_number_of_threads(
    method, options, room, set_threads, compare_anew
):
    first = ss.upsample(room, method, seed=3, **options)
    set_threads(1)
    second = ss.upsample(room, method, seed=3, **options)
    for name in ("xyz", "rgb", "source"):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()


@by_photographs
def test_held_out_photographs_are_never_read(method, room_path, monkeypatch):
    room, read, load = load_scene(room_path), [], loading.load_photograph
    monkeypatch.setattr(
        loading,
        "load_photograph",
        lambda path, *a, **k: (read.append(path.name), load(path, *a, **k))[1],
    )
    ss.upsample(room, method, test_every=4, cover=12)
    names = sorted(image.name for image in room.images)
    assert sorted(set(read)) == [name for i, name in enumerate(names) if i % 4]
    if method == "cover":  # the same, where the scene itself says which test
        read.clear()
        listed = Split(frozenset(names[1:]), frozenset(names[:1]), "list")
        ss.upsample(room.replace(listed=listed), method)
        assert sorted(set(read)) == names[1:]


@by_photographs
@pytest.mark.parametrize("size", [{"ratio": 4}, {"num_points": 5000}], ids=str)
def test_the_photographs_say_how_many(method, size, room):
    with pytest.raises(ParameterError, match="`budget`"):
        ss.upsample(room, method, **size)


def test_without_photographs_mls_stands_in_and_says_so(room):
    notes = []
    seeds = ss.upsample(room.points, note=notes.append)
    assert len(seeds) == 4 * len(room.points)
    assert set(seeds.source) == {0, SOURCE_CODES["mls"]}
    assert [note.kind for note in notes] == ["fallback-method"]


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


def test_a_budget_covers_in_the_cells_that_the_method_has(room):
    whole = ss.upsample(room, "cover", cell=24)
    thinned = ss.upsample(room, "cover", cell=24, budget=len(whole) - 1)
    guesses = [np.count_nonzero(each.source == COVER) for each in (whole, thinned)]
    assert guesses[1] <= guesses[0] + 1


def test_a_budget_may_be_below_the_originals(room):
    """The default then makes nothing, as if new points had been thinned away, and says so."""
    num, notes = room.points.num_original // 2, []
    assert len(ss.upsample(room, "linear", budget=num)) == num
    assert len(ss.upsample(room, "cover", budget=f"{num / (160 * 120)}rho")) == num
    thinned = ss.upsample(room, budget=num, note=notes.append)
    assert len(thinned) == thinned.num_original == num
    assert notes[-1].kind == "no-room-for-seeds"
    for odd in ({"bogus": 3}, {"cell": -5}, {"profile": "zzz"}, {"seed": -1}):
        with pytest.raises(ParameterError):
            ss.upsample(room, budget=num, **odd)
    made = ss.upsample(room, cover=8, budget=num)  # the long way
    np.testing.assert_array_equal(made.xyz, thinned.xyz)


def test_a_small_budget_keeps_a_part_of_a_scan(room):
    own = room.points.originals
    scan, guesses = (
        own.replace(xyz=own.xyz + np.float32(off), source=np.full(len(own), code, np.uint8))
        for off, code in ((0.2, CLOUD), (0.4, COVER))
    )
    cloud = PointCloud.concatenate(PointCloud.concatenate(own, scan), guesses)
    num = len(own) // 2
    kept = thin_to(room, cloud, num, None, 0, silent)
    assert len(kept) == num
    assert np.count_nonzero(kept.source == CLOUD) > num // 10


BUDGETS = {"50000": 50_000, " 5e4": 50_000, 50_000: 50_000, "50k": 50_000, "0.5M": 500_000}
BUDGETS |= {"0.25rho": 500, "1 RHO": 2000, 2.6: 3}
BUDGETS |= {"0.25": r"Did you mean 0.25rho\?", 0.75: r"Did you mean 0.75rho\?"}
WRONG = ["", "many", "rho", "-3", "0", "0.1", "nan", "inf", "1e-9rho", "1e30", "0,25rho"]
BUDGETS |= dict.fromkeys(WRONG, "expected a budget such as 50000")


@pytest.mark.parametrize("budget", BUDGETS)
def test_a_budget_is_a_number_or_a_density(budget):
    if isinstance(says := BUDGETS[budget], int):
        assert parse_budget(budget, 2000) == says
    else:
        with pytest.raises(ParameterError, match=says):
            parse_budget(budget, 2000)


def test_a_density_names_the_size_of_the_photographs(room):
    assert describe_rho(room, "0.5rho") == ": 0.5rho of 160 x 120 pixels"
    assert not describe_rho(room, None)
    assert not describe_rho(room, "500k")
