"""Seeds from depth maps that come with a capture, where photographs confirm nothing."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import splatseed as ss
from splatseed.camera import Intrinsics
from splatseed.depth.kinds import UNIT_MISMATCH
from splatseed.depthmap import DepthMap, HeldDepths
from splatseed.methods import SOURCE_CODES
from splatseed.photos.view import view_of
from splatseed.pointcloud import PointCloud
from splatseed.seeding.map_seeds import depth_at_cells, unit_ratio

pytestmark = pytest.mark.usefixtures("compare_once")
DEPTH, COVER = SOURCE_CODES["depth"], SOURCE_CODES["cover"]


class MetricMaps(HeldDepths):
    """Maps that come with a capture, in its unit."""

    in_scene_units = True


@pytest.fixture(scope="module")
def make_maps(room, room_capture):
    """Makes true maps, after ``change(z, i)`` of the i-th image's, with a confidence."""

    def make(change=lambda z, _: z, confidence=None, kind=MetricMaps):
        maps = kind()
        for i, (image, z) in enumerate(zip(room.images, room_capture.depths, strict=True)):
            values = change(np.where(z > 0, z, np.nan).astype(np.float32), i)
            maps[image.name] = DepthMap(values, confidence=confidence)
        return maps

    return make


def off_surface(seeds, capture, code):
    return capture.surfaces.distance(seeds.xyz[seeds.source == code].astype(np.float64))


def test_measured_depth_replaces_guesses(room, room_capture, make_maps):
    notes = []
    guessed = ss.upsample(room)
    scene = room.replace(depths=make_maps())
    seeds = ss.upsample(scene, note=notes.append)
    off = off_surface(seeds, room_capture, DEPTH)
    assert len(off) > 300
    assert off.max() < 2e-3  # metres; the room measures 5
    assert np.count_nonzero(seeds.source == COVER) < 0.7 * np.count_nonzero(guessed.source == COVER)
    (used,) = [note.text for note in notes if note.kind == "depth-maps-used"]
    assert "it is that of the scene's 16 depth maps" in used
    confidence = seeds.confidence[seeds.source == DEPTH]
    assert seeds.confidence[seeds.source == COVER].max() < confidence.min()
    without = ss.upsample(scene, depth_maps=False)
    np.testing.assert_array_equal(without.xyz, guessed.xyz)


def test_maps_without_a_unit_or_of_several_are_not_used(room, make_maps):
    """Those of a network, in a folder that the user named, have no unit."""
    found = ss.upsample(room.replace(depths=make_maps(kind=HeldDepths)))
    assert DEPTH not in found.source
    notes = []
    several = room.replace(depths=make_maps(lambda z, i: (1.5 + 0.05 * i) * z))
    assert DEPTH not in ss.upsample(several, note=notes.append).source
    assert notes[-1].kind == UNIT_MISMATCH


@pytest.mark.parametrize(("factor", "most"), [(1000.0, 2e-3), (0.4, 0.05)])
def test_maps_of_another_unit_are_converted(room, room_capture, make_maps, factor, most):
    notes = []
    scene = room.replace(depths=make_maps(lambda z, _: factor * z))
    off = off_surface(ss.upsample(scene, note=notes.append), room_capture, DEPTH)
    assert len(off) > 300
    assert off.max() < most  # metres, of 5; a power of ten is exact
    (unit,) = [note.text for note in notes if note.kind == UNIT_MISMATCH]
    assert float(unit.partition("depth is ")[2].split()[0]) == pytest.approx(factor, rel=0.01)


def test_single_maps_of_another_unit_are_left_out(room, room_capture, make_maps):
    """As if a part of the capture came from another device; the median map is right."""
    notes = []
    maps = make_maps(lambda z, i: (5 if i in {3, 9, 12} else 1) * z)
    seeds = ss.upsample(room.replace(depths=maps), note=notes.append)
    off = off_surface(seeds, room_capture, DEPTH)
    assert len(off) > 200
    assert off.max() < 2e-3
    left_out, used = notes
    assert left_out.text.startswith("3 of 16 depth maps are left out (view_003.png, view_009.png, ")
    assert left_out.subjects == ("view_003.png", "view_009.png", "view_012.png")
    assert "it is that of the scene's 13 depth maps" in used.text


def test_maps_of_another_unit_do_not_guide_stereo(room, make_maps):
    """Begun at wrong depths, stereo would find nothing to contradict them."""
    few = room.replace(images=room.images[:5])  # which is quicker
    bare, notes = few.with_points(PointCloud.empty()), []
    scene = bare.replace(depths=make_maps(lambda z, _: 1000 * z))
    seeds = ss.upsample(scene, note=notes.append)
    mismatches = [note.text for note in notes if note.kind == UNIT_MISMATCH]
    assert "do not guide stereo" in mismatches[0]
    assert "have another unit" in mismatches[1]
    assert DEPTH in seeds.source
    assert unit_ratio(bare.replace(depths=make_maps()), bare.images) is None


def test_uncertain_and_contradicted_depth_gives_no_seed(room, room_capture, make_maps):
    half = np.full((120, 160), 2, np.uint8)
    half[:, 80:] = 0

    def change(z, i):
        z[:, 80:] *= 0.6
        if i == 7:
            z[40:80, 20:60] *= 0.5  # a blob in the air that all others see through
        return z

    maps = make_maps(change, half)
    seeds = ss.upsample(room.replace(depths=maps))
    assert off_surface(seeds, room_capture, DEPTH).max() < 2e-3
    seeds = ss.upsample(room.replace(depths=maps), min_confidence=0)
    assert off_surface(seeds, room_capture, DEPTH).max() > 0.1


def test_depth_at_cells_equals_a_loop(room, rng):
    """Of a map of another size, with distances along rays, of a photograph with distortion."""
    image = room.images[0]
    lens = Intrinsics(1, "SIMPLE_RADIAL", 160, 120, (150.0, 82.0, 57.0, 0.1))
    image = dataclasses.replace(image, intrinsics=lens)
    view = view_of(room.images[0])
    plane = 3.0 + 0.001 * np.arange(80) + 0.002 * np.arange(60)[:, None]
    values = plane.astype(np.float32)
    values[20:30, 30:40] = np.nan
    found = depth_at_cells(view, image, DepthMap(values, "ray"), 8)
    assert found.shape == (15, 20)
    checked = 0
    for row, column in zip(*np.nonzero(np.isfinite(found)), strict=True):
        x = (8 * column + 4 - view.K[0, 2]) / view.K[0, 0]
        y = (8 * row + 4 - view.K[1, 2]) / view.K[1, 1]
        bend = 1 + 0.1 * (x * x + y * y)
        u, v = (150 * bend * x + 82) / 2, (150 * bend * y + 57) / 2
        if not (0.5 <= u <= 79.5 and 0.5 <= v <= 59.5):  # outside of the pixels' centres
            continue
        distance = 3.0 + 0.001 * (u - 0.5) + 0.002 * (v - 0.5)
        assert found[row, column] == pytest.approx(distance / np.sqrt(x * x + y * y + 1), rel=1e-4)
        checked += 1
    assert 100 < checked < 300
    assert np.isnan(depth_at_cells(view, image, DepthMap(values, "inverse"), 8)).all()
