"""New points in a region alone: the same as without it, and a budget is spent there."""

from __future__ import annotations

import json

import numpy as np
import pytest

import splatseed as ss
from splatseed import load_scene
from splatseed.errors import ParameterError
from splatseed.io.load import with_own_depths
from splatseed.io.regions import parse_region
from splatseed.pointcloud import ORIGINAL
from splatseed.seeding.photo_methods import Auto

pytestmark = pytest.mark.usefixtures("compare_once")


@pytest.fixture(scope="module")
def few(room):
    """The room with a part of its points."""
    return room.with_points(room.points.select(np.arange(len(room.points)) % 3 == 0))


@pytest.fixture(scope="module")
def box(few):
    """A box around a fifth of the room's points, as text and as a region."""
    low, high = np.percentile(few.points.xyz, (20, 80), axis=0)
    low[0], high[0] = np.percentile(few.points.xyz[:, 0], (0, 50))
    text = ",".join(f"{value:.6g}" for value in [*low, *high])
    share = parse_region(text)(few.points.xyz).mean()
    assert 0.05 < share < 0.5
    return text, parse_region(text)


def _new(cloud):
    return cloud.select(cloud.source != ORIGINAL)


def test_seeds_are_those_of_the_whole_scene_that_lie_in_it(few, box):
    text, inside = box
    whole, notes = ss.upsample(few), []
    part = ss.upsample(few, region=text, note=notes.append)
    kept = (whole.source == ORIGINAL) | inside(whole.xyz)
    assert part == whole.select(kept)
    assert np.array_equal(part.originals.xyz, few.points.xyz)
    assert 0 < len(_new(part)) < len(_new(whole)) / 2
    (said,) = (note.text for note in notes if note.kind == "seeds-of-region")
    assert said.startswith(f"{len(_new(part)):,} of {len(_new(whole)):,} new points are in")
    assert f"{inside(few.points.xyz).sum():,} of them in the region" in said


def test_a_budget_is_spent_in_it(few, box, room_capture):
    text, inside = box
    plain = ss.upsample(few, region=text)
    budget = len(few.points) + 3 * len(_new(plain))
    dense = ss.upsample(few, region=text, budget=budget)
    assert 0.9 * budget < len(dense) <= budget
    assert np.array_equal(dense.originals.xyz, few.points.xyz)
    new = _new(dense)
    assert inside(new.xyz).all()
    everywhere = _new(ss.upsample(few, budget=budget))
    assert len(new) > 2 * np.count_nonzero(inside(everywhere.xyz))
    # No worse than those that are made without a region: guesses know what lies behind it.
    off, usual = (room_capture.surfaces.distance(each.xyz) for each in (new, everywhere))
    assert np.median(off) < 2 * np.median(usual)
    # Less than the sparse seeds in it thins them.
    thinned = ss.upsample(few, region=text, budget=len(few.points) + len(_new(plain)) // 2)
    assert len(thinned) == len(few.points) + len(_new(plain)) // 2
    assert inside(_new(thinned).xyz).all()


@pytest.mark.parametrize("method", ["linear", "mls", "voronoi", "random"])
def test_methods_that_need_points_start_from_those_in_it(method, few, box):
    text, inside = box
    number = int(np.count_nonzero(inside(few.points.xyz)))
    cloud = ss.upsample(few, method, ratio=3, region=text)
    assert np.array_equal(cloud.originals.xyz, few.points.xyz)
    assert inside(_new(cloud).xyz).all()
    assert number < len(_new(cloud)) <= 2 * number
    more = ss.upsample(few, method, num_points=len(few.points) + 50, region=inside)
    assert 25 <= len(_new(more)) <= 50
    assert np.array_equal(
        ss.upsample(few.points, "linear", region=inside).originals.xyz, few.points.xyz
    )


def test_depth_maps_give_as_many_points_in_it_as_wanted(few, box):
    text, inside = box
    scene = with_own_depths(few)
    number = int(np.count_nonzero(inside(few.points.xyz)))
    cloud = ss.upsample(scene, "depth", ratio=4, region=text)
    assert len(_new(cloud)) == 3 * number
    assert inside(_new(cloud).xyz).all()
    with pytest.raises(ss.SplatseedError, match="in the region"):
        ss.upsample(scene, "depth", num_points=10**6, region=text)


@pytest.mark.parametrize("method", ["mls", "cover", Auto()])
def test_a_region_without_points_is_an_error(method, few):
    with pytest.raises(
        ParameterError, match=r"`region` to hold .*; found none of [1-9][\d,]*, which"
    ):
        ss.upsample(few, method, region="900,900,900,901,901,901")


def test_the_command_records_it_and_follows_recentered_scenes(room_path, splatseed, tmp_path):
    scene = load_scene(room_path)
    middle = np.median(scene.points.xyz, axis=0)
    text = ",".join(f"{value:.6g}" for value in [*middle, 1.0])
    words = ("--method", "mls", f"--region={text}", "--ratio", 3)
    run = splatseed("upsample", room_path, *words, "-o", tmp_path / "out")
    assert run.code == 0
    facts = json.loads((tmp_path / "out" / "splatseed.json").read_text())
    assert facts["region"] == text
    assert f"{facts['num_new']:,} of" in run.err
    out = load_scene(tmp_path / "out")
    new = _new(out.points).xyz
    assert len(new) == facts["num_new"] > 0
    assert parse_region(text)(new).all()
    splatseed("upsample", room_path, *words, "--recenter", "-o", tmp_path / "moved")
    moved = load_scene(tmp_path / "moved")
    again = _new(moved.points).xyz + moved.offset - out.offset
    assert np.abs(moved.offset - out.offset).max() > 0.1
    assert len(again) == len(new)
    assert parse_region(text)(again).mean() > 0.99  # rounded to float32
    run = splatseed("upsample", room_path, "--region", "1,2", "-o", tmp_path / "none")
    assert run.code == 2
    assert "--region x0,y0,z0,x1,y1,z1" in run.err
