"""Pairs of photographs in the database: as pycolmap matches them, none twice, names kept."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image as PilImage

from splatseed.progress import silent
from splatseed.sfm import Settings
from splatseed.sfm.cameras import Photo, SharedCamera
from splatseed.sfm.colmap import ColmapRun, guessed_model, posed_model, require_pycolmap
from splatseed.sfm.database import run_database
from splatseed.sfm.matching import _pairs, detect_features, match_pairs, match_photographs

pycolmap = pytest.importorskip("pycolmap")


@pytest.fixture
def run(room, tmp_path):
    """A run on four photographs of the room, whose names have spaces, and their model."""
    folder = tmp_path / "photos"
    images = [replace(image, name=f"a view {image.name}") for image in room.images[:4]]
    for old, new in zip(room.images, images, strict=False):
        (folder / new.name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(room.source.image_dir / old.name, folder / new.name)
    work = tmp_path / "work"
    work.mkdir()
    settings = Settings("exhaustive", "cpu", threads=1)
    run = ColmapRun(require_pycolmap(), settings, folder, work, silent)
    return run, posed_model(pycolmap, images)


def test_successors_follow_the_numbers_in_names(run):
    run, _ = run
    photograph = next(run.image_dir.glob("*.png"))
    names = [f"{number}.png" for number in range(14)]
    for name in names:
        shutil.copy(photograph, run.image_dir / name)
    model = guessed_model(run, [SharedCamera(tuple(names), names[0], "")], "SIMPLE_RADIAL")
    assert [model.image(i).name for i in sorted(model.images)] == names
    run = replace(run, settings=replace(run.settings, matcher="sequential"))
    with run_database(run, model) as database:
        pairs = _pairs(run, database)
    partners = [names[b - 1] for a, b in pairs if names[a - 1] == "1.png"]
    assert partners == [f"{number}.png" for number in range(2, 12)]
    assert len(pairs) == len(set(pairs))


def matches(database, pair):
    found = database.read_two_view_geometry(*pair).inlier_matches
    return database.read_matches(*pair).tolist(), found.tolist()


def test_a_list_of_pairs_is_matched_as_by_pycolmap_and_none_twice(run):
    run, model = run
    progress = []
    object.__setattr__(run, "on_progress", lambda *step: progress.append(step))
    with run_database(run, model) as database:
        detect_features(run, database, model)
        names = {image.image_id: image.name for image in database.read_all_images()}
        match_pairs(run, database, [(1, 2), (2, 4)])
        assert database.num_matched_image_pairs() == 2
        first = matches(database, (1, 2)), matches(database, (2, 4))
        assert len(first[0][1]) > 50
        progress.clear()
        match_pairs(run, database, [(1, 2), (1, 3)], "more")
        # Fractions in between are polled, which a quick match may outrun.
        assert progress[-1] == ("more", 1.0)
        assert database.num_matched_image_pairs() == 3
        assert {image.image_id: image.name for image in database.read_all_images()} == names
        database.clear_matches()
        database.clear_two_view_geometries()
        pycolmap.match_exhaustive(
            run.database,
            verification_options=pycolmap.TwoViewGeometryOptions(ransac={"random_seed": 0}),
            device=pycolmap.Device.cpu,
        )
        assert (matches(database, (1, 2)), matches(database, (2, 4))) == first


def test_a_pair_without_a_match_was_matched(run, rng):
    run, model = run
    photograph = run.image_dir / model.image(4).name
    size = PilImage.open(photograph).size
    noise = rng.integers(0, 255, (size[1], size[0], 3), np.uint8)
    PilImage.fromarray(noise).save(photograph)
    match_photographs(run, model)
    with pycolmap.Database.open(run.database) as database:
        assert len(database.read_two_view_geometry_num_inliers()[0]) == 3
    assert run.num_pairs() == 6


def test_features_without_doubling_are_fewer_and_coarser(run):
    run, model = run
    counts, sizes = [], []
    for doubled in (True, False):
        work = run.work / str(doubled)
        work.mkdir()
        settings = replace(run.settings, doubled=doubled)
        with run_database(replace(run, work=work, settings=settings), model) as database:
            detect_features(replace(run, work=work, settings=settings), database, model)
            keypoints = database.read_keypoints(1)
        counts.append(len(keypoints))
        sizes.append(np.hypot(keypoints[:, 2], keypoints[:, 4]).min())
    assert counts[1] < 0.7 * counts[0]
    assert sizes[1] == pytest.approx(2 * sizes[0], rel=0.1)


def test_poses_of_large_photographs_need_no_doubling():
    settings = Settings(seed=3)
    small, large = ({"a.jpg": Photo(size)} for size in ((1440, 1080), (1200, 1600)))
    assert settings.for_poses(small) == settings
    undoubled = replace(settings, max_image_size=2000, doubled=False)
    assert settings.for_poses(large) == undoubled
    chosen = replace(settings, max_image_size=1200)
    assert chosen.for_poses(large) == chosen
