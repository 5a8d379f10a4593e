"""The method ``cloud`` on a made room with known surfaces and planted outliers (ghosts)."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import KDTree

import splatseed as ss
from splatseed.errors import PointCloudError
from splatseed.methods import SOURCE_CODES
from splatseed.seeding.clouds.method import Cloud
from splatseed.similarity import Similarity

CLOUD, COVER = SOURCE_CODES["cloud"], SOURCE_CODES["cover"]
NUM, GHOSTS = 75_000, 2_000
MOVE = Similarity(2.5, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]), np.array([5e5, 5e6, 90.0]))


@pytest.fixture(scope="module")
def scan(room_capture):
    """Points on the surfaces in their colours, and magenta ghosts in front of them."""
    rng = np.random.default_rng(5)
    parts, textures = room_capture.room.surfaces.parts, room_capture.room.textures
    share = np.array([part.area for part in parts])
    counts = rng.multinomial(NUM, share / share.sum())
    xyz = [part.sample(count, rng) for part, count in zip(parts, counts, strict=True)]
    rgb = [178 * texture(each) for texture, each in zip(textures, xyz, strict=True)]
    ghosts = rng.uniform((-1.3, -1.3, 0.2), (1.3, 1.3, 1.3), (GHOSTS, 3))
    ghosts[::2] = (0.6, -0.6, 0.9) + 0.05 * rng.normal(size=(GHOSTS // 2, 3))
    xyz = np.concatenate([*xyz, ghosts]) + 0.001 * rng.normal(size=(NUM + GHOSTS, 3))
    rgb = np.concatenate([*rgb, np.tile((220, 20, 220), (GHOSTS, 1))])
    return xyz, np.clip(rgb, 0, 255).astype(np.uint8)


def written(folder, scan):
    np.savez(folder / "scan.npz", xyz=scan[0], rgb=scan[1])
    return folder / "scan.npz"


@pytest.fixture(scope="module")
def path(tmp_path_factory, scan):
    return written(tmp_path_factory.mktemp("scan"), scan)


@pytest.fixture(scope="module")
def seeds(room, path):
    notes = []
    return ss.upsample(room, Cloud().of(path), note=notes.append), notes


def new_points(seeds):
    return seeds.select(seeds.source == CLOUD)


def test_points_on_surfaces_stay_and_ghosts_are_dropped(room, room_capture, seeds):
    cloud, notes = seeds
    np.testing.assert_array_equal(cloud.xyz[: len(room.points)], room.points.xyz)
    new = new_points(cloud)
    assert len(room.points) + len(new) == len(cloud)
    off = np.abs(room_capture.surfaces.distance(new.xyz.astype(float)))
    assert np.median(off) < 0.004
    assert np.mean(off > 0.05) < 0.002
    near = np.linalg.norm(new.xyz - (0.6, -0.6, 0.9), axis=1) < 0.1
    assert np.count_nonzero(near) <= 3
    (kept,) = [note.text for note in notes if note.kind == "contradicted-points"]
    assert f"{len(new):,} of" in kept


def test_without_colours_free_space_drops_ghosts(room, room_capture, scan, tmp_path):
    np.savez(tmp_path / "bare.npz", xyz=scan[0])
    kept, new = {}, {}
    for clean in (True, False):
        new[clean] = new_points(ss.upsample(room, Cloud(clean=clean).of(tmp_path / "bare.npz")))
        ghosts = np.abs(room_capture.surfaces.distance(new[clean].xyz.astype(float))) > 0.05
        kept[clean] = np.count_nonzero(ghosts), np.count_nonzero(~ghosts)
    assert kept[True][0] < 0.1 * kept[False][0]
    assert kept[True][1] > 0.97 * kept[False][1]
    # Colours are from the photographs, as they are with ``recolor``.
    painted = Cloud(clean=False, recolor=True).of(written(tmp_path, scan))
    np.testing.assert_array_equal(new[False].rgb, new_points(ss.upsample(room, painted)).rgb)
    assert new[False].rgb.std() > 10
    # So are those of a cloud in which all points are black.
    black = Cloud(clean=False).of(written(tmp_path, (scan[0], np.zeros_like(scan[1]))))
    np.testing.assert_array_equal(new[False].rgb, new_points(ss.upsample(room, black)).rgb)


def test_points_that_the_scan_left_black_or_filled_take_the_photographs_colours(
    room, scan, seeds, tmp_path
):
    right = new_points(seeds[0])
    left = scan[0][:, 0] > 0
    random = np.random.default_rng(0).random(len(left)) < 0.5
    for which, filling in ((random, 0), (left, 128)):
        rgb = np.where(which[:, None], filling, scan[1]).astype(np.uint8)
        notes = []
        new = new_points(
            ss.upsample(room, Cloud().of(written(tmp_path, (scan[0], rgb))), note=notes.append)
        )
        (text,) = [each.text for each in notes if each.kind == "colors-of-photographs"]
        assert "no colour in the cloud" in text
        assert abs(len(new) - len(right)) < 0.05 * len(right)
        nearest = KDTree(right.xyz).query(new.xyz)[1]
        difference = np.abs(new.rgb.astype(int) - right.rgb[nearest]).max(axis=1)
        assert np.median(difference) < 8
        assert np.quantile(difference, 0.95) < 64
        assert (new.rgb == filling).all(axis=1).mean() < 0.01


def test_a_national_grid_and_another_scale_lose_no_precision(room, scan, seeds, tmp_path):
    moved = written(tmp_path, (MOVE.points(scan[0]), scan[1]))
    again = ss.upsample(room, Cloud().of(moved, transform=MOVE.inverse))
    first = seeds[0]
    assert abs(len(again) - len(first)) < 0.002 * len(first)  # rounding may cross a voxel's side
    assert np.quantile(KDTree(first.xyz).query(again.xyz)[0], 0.99) < 1e-4


def test_with_cover_and_a_budget(room, path):
    both = ss.upsample(room, "cover", extra_method=Cloud().of(path), budget="8k")
    assert len(both) == 8000
    assert {0, CLOUD} <= set(both.source)
    alone = ss.upsample(room, "cover")
    assert np.count_nonzero(both.source == COVER) < np.count_nonzero(alone.source == COVER)


@pytest.mark.parametrize(
    ("move", "found"),
    [
        (lambda xyz: np.add(xyz, (1e6, 0, 0)), "none of 77,000.*`align=True`.*`transform`"),
        (lambda xyz: 0.7 * xyz[:, [2, 0, 1]] + (0.4, -1, 0.5), "at its depth"),
    ],
)
def test_clouds_in_another_frame_are_refused(move, found, room, scan, tmp_path):
    with pytest.raises(PointCloudError, match=found):
        ss.upsample(room, Cloud().of(written(tmp_path, (move(scan[0]), scan[1]))))
