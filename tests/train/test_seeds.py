"""Which points a run starts from."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene, write_scene
from splatseed.io.staging import MANIFEST
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.train.seeds import seeded, seeds_digest, usable_seeds
from splatseed.train.settings import TrainSettings

ORIGINALS, NEW = 40, 60


@pytest.fixture
def points(rng) -> PointCloud:
    xyz = rng.normal(size=(ORIGINALS + NEW, 3))
    source = np.repeat([0, 4], [ORIGINALS, NEW]).astype(np.uint8)
    return PointCloud(xyz, np.zeros((ORIGINALS + NEW, 3), np.uint8), source)


def thinned(
    points: PointCloud, cap: int, seed: int = 0, **settings
) -> tuple[PointCloud, list[str]]:
    notes: list[str] = []
    asked = TrainSettings(cap_max=cap, seed=seed, **settings)
    return usable_seeds(points, asked, notes.append), notes


def test_more_than_the_cap_are_thinned_and_told_of(points):
    seeds, notes = thinned(points, 70)
    assert len(seeds) == 49  # seven tenths: default adds the rest
    assert np.isin(seeds.xyz, points.xyz).all()
    told = f"100 seeds were thinned to 49, {seeds.num_original} of them originals"
    assert notes == [f"{told}: there may be 70 Gaussians; strategy default adds the rest."]
    seeds = usable_seeds(points, TrainSettings(cap_max=70, strategy="none"), notes.append)
    told = f"100 seeds were thinned to 70, {seeds.num_original} of them originals"
    assert notes[1:] == [f"{told}: there may be 70 Gaussians."]


def test_what_crowds_goes_first(points):
    """Of pairs a hair apart one stays each, the original."""
    xyz = np.concatenate([points.xyz[:ORIGINALS], points.xyz[:ORIGINALS] + np.float32(1e-4)])
    source = np.repeat([0, 4], ORIGINALS).astype(np.uint8)
    pairs = PointCloud(xyz, np.zeros((2 * ORIGINALS, 3), np.uint8), source)
    seeds, _ = thinned(pairs, ORIGINALS, strategy="none")
    assert np.array_equal(seeds.xyz, points.xyz[:ORIGINALS])


def test_originals_are_asked_first_wherever_they_stand(points):
    mixed = points.select(np.random.default_rng(0).permutation(len(points)))
    one, other = (thinned(each, 50)[0] for each in (points, mixed))
    assert one.num_original == other.num_original


def test_which_stay_does_not_depend_on_the_seed(points):
    assert np.array_equal(*(thinned(points, 70, seed)[0].xyz for seed in (0, 1)))


def test_points_that_are_not_finite_are_left_out_and_told_of(points):
    xyz = points.xyz.copy()
    xyz[3] = np.nan
    seeds, notes = thinned(points.replace(xyz=xyz), 1000)
    assert len(seeds) == ORIGINALS + NEW - 1
    assert notes == ["1 points without finite coordinates were left out."]


@pytest.fixture
def known(points) -> PointCloud:
    """The points with a size that follows from the position, normals of some, and confidence."""
    normals = np.tile([0.0, 0, 1], (len(points), 1))
    normals[::3] = np.nan
    sizes = np.abs(points.xyz[:, 0])
    return points.replace(normals=normals, sizes=sizes, confidence=np.ones(len(points)))


def test_of_what_is_known_only_what_is_asked_for_has_a_part(known, points):
    begun = {
        names: usable_seeds(known, TrainSettings(**dict.fromkeys(names, True)), print)
        for names in ((), ("seed_sizes",), ("seed_normals",), ("seed_sizes", "seed_normals"))
    }
    assert [sorted(seeds.attributes) for seeds in begun.values()] == [
        *([], ["sizes"], ["normals"], ["normals", "sizes"])
    ]
    digests = [seeds_digest(seeds) for seeds in begun.values()]
    assert len(set(digests)) == 4
    assert digests[0] == seeds_digest(points)


def test_what_is_known_follows_the_points_that_stay(known):
    settings = TrainSettings(cap_max=55, seed_sizes=True)
    seeds = usable_seeds(known, settings, lambda _: None)
    np.testing.assert_array_equal(seeds.sizes, np.abs(seeds.xyz[:, 0]))


def test_asking_for_what_is_not_known_is_told(points):
    notes: list[str] = []
    unknown = points.replace(sizes=np.full(len(points), np.nan))
    usable_seeds(unknown, TrainSettings(seed_sizes=True, seed_normals=True), notes.append)
    assert [note.split()[0] for note in notes] == ["seed_sizes", "seed_normals"]


def test_a_plain_scene_is_seeded_on_request_and_the_user_told(room):
    notes: list[str] = []
    points = seeded(room, TrainSettings(seeding="auto"), "cpu", notes.append, silent)[0].points
    assert len(points) > len(room.points)
    assert np.array_equal(points.originals.xyz, room.points.xyz)
    assert "--seeds scene" in notes[-1]
    bounded = TrainSettings(seeding="auto", strategy="none", cap_max=len(room.points) + 10)
    assert (
        len(seeded(room, bounded, "cpu", notes.append, silent)[0].points) == len(room.points) + 10
    )


def test_what_upsample_only_thinned_is_left_alone(room, tmp_path):
    write_scene(room.replace(points=room.points.select(slice(100))), tmp_path / "thin")
    thin, asked = load_scene(tmp_path / "thin"), TrainSettings(seeding="auto")
    (tmp_path / "thin" / MANIFEST).write_text('{"command": "upsample"}')
    assert seeded(thin, asked, "cpu", print, silent) == (thin, None)
    (tmp_path / "thin" / MANIFEST).write_text('{"command": "sfm"}')
    assert len(seeded(thin, asked, "cpu", lambda _: None, silent)[0].points) > len(thin.points)


@pytest.mark.parametrize(
    "settings", [{}, {"seeding": "auto", "strategy": "default-3dgs"}, {"seeding": "auto"}]
)
def test_other_points_are_left_alone(settings, room):
    """Those that are to stay, those of 3DGS's conventions, and those that splatseed has added
    to."""
    touched = room.replace(
        points=room.points.replace(source=np.full(len(room.points), 4, np.uint8))
    )
    scene = touched if settings == {"seeding": "auto"} else room
    notes: list[str] = []
    assert seeded(scene, TrainSettings(**settings), "cpu", notes.append, silent)[0] is scene
    assert not notes


def test_beginning_with_its_own_points_is_not_advised_where_there_are_none(room):
    settings = TrainSettings(seeding="auto", cap_max=500, max_steps=10)
    notes: list[str] = []
    empty = room.replace(points=room.points.select(slice(0)), tracks=None)
    cloud = seeded(empty, settings, "cpu", notes.append, silent)[0].points
    assert len(cloud)
    (said,) = [note for note in notes if note.startswith("Seeds by method auto")]
    assert "--seeds scene" not in said
    assert f"{len(cloud):,} points" in said
