"""Which model is kept: the one whose poses explain the matches."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")

from splatseed.progress import silent
from splatseed.sfm import Settings, agreement, mapping
from splatseed.sfm.agreement import compare_with_matches
from splatseed.sfm.colmap import ColmapRun, posed_model, require_pycolmap
from splatseed.sfm.mapping import map_images
from splatseed.sfm.matching import match_photographs
from splatseed.similarity import fit_similarity


@pytest.fixture(scope="module")
def matched(room, tmp_path_factory):
    """A run on eight photographs of the room whose pairs are matched, and their true model."""
    work = tmp_path_factory.mktemp("mapping")
    run = ColmapRun(require_pycolmap(), Settings(threads=2), room.source.image_dir, work, silent)
    model = posed_model(run.pycolmap, room.images[:8])
    match_photographs(run, model)
    return run, model


@pytest.fixture
def run(matched, tmp_path, monkeypatch):
    """The run, whose models go to another folder each time."""
    run, model = matched
    monkeypatch.setattr(mapping, "MODELS", str(tmp_path / "models"))
    return run, model


def with_turned(run, model, numbers, degrees):
    """A copy of the model in which some cameras are turned about their vertical axis."""
    turned = run.pycolmap.Reconstruction(model)
    half = np.radians(degrees) / 2
    turn = run.pycolmap.Rigid3d(
        run.pycolmap.Rotation3d(np.array([0, np.sin(half), 0, np.cos(half)])), np.zeros(3)
    )
    for number in numbers:
        frame = turned.image(number).frame
        frame.rig_from_world = turn * frame.rig_from_world
    return turned


def with_displaced(run, model, numbers, shift=(1.0, 0.0, 0.0)):
    """A copy of the model in which some cameras are displaced."""
    displaced = run.pycolmap.Reconstruction(model)
    for number in numbers:
        frame = displaced.image(number).frame
        rotation = frame.rig_from_world.rotation
        moved = frame.rig_from_world.translation + rotation.matrix() @ np.array(shift)
        frame.rig_from_world = run.pycolmap.Rigid3d(rotation, moved)
    return displaced


def misplaced(model, found):
    """Largest distance of a camera from its true place, in the room's metres."""
    ids = range(1, 9)
    true = np.array([model.image(i).projection_center() for i in ids])
    images = [found.find_image_with_name(model.image(i).name) for i in ids]
    centers = np.array([image.projection_center() for image in images])
    return np.linalg.norm(fit_similarity(centers, true).points(centers) - true, axis=1).max()


def explained(run, model):
    return compare_with_matches(run, model).explained


def test_true_poses_explain_the_matches_and_a_turned_camera_does_not_explain_its_own(matched):
    run, model = matched
    found = compare_with_matches(run, model)
    assert min(found.explained, found.link) > 0.99
    with run.pycolmap.Database.open(run.database) as database:
        pairs, counts = database.read_two_view_geometry_num_inliers()
    pairs = [run.pycolmap.pair_id_to_image_pair(pair) for pair in pairs]
    own = sum(count for pair, count in zip(pairs, counts, strict=True) if 3 in pair)
    rest = 1 - own / sum(counts)
    assert rest < 0.98
    assert explained(run, with_turned(run, model, [3], 15)) == pytest.approx(rest, abs=0.03)
    without = run.pycolmap.Reconstruction(model)
    without.deregister_frame(without.image(3).frame_id)
    assert explained(run, without) == pytest.approx(rest, abs=0.01)


def test_two_parts_that_are_displaced_are_found_at_their_weakest_link(matched, monkeypatch):
    run, model = matched
    displaced = with_displaced(run, model, (2, 5, 7))
    found = compare_with_matches(run, displaced)
    assert found.part == tuple(model.image(i).name for i in (2, 5, 7))
    assert found.link < 0.2
    assert found.explained > 0.3
    monkeypatch.setattr(agreement, "_PART", 0.5)  # no part of three of the eight any more
    even = compare_with_matches(run, displaced)
    assert len(even.part) == 4
    assert even.link > found.link


@pytest.mark.parametrize("incremental", ["no model", "wrong poses"])
def test_where_incremental_mapping_fails_all_photographs_are_mapped_at_once(
    incremental, run, monkeypatch
):
    run, model = run
    real = mapping._map

    def fail(run, stage, folder, *rest):
        if stage != "mapping":
            return real(run, stage, folder, *rest)
        if incremental == "no model":
            return {}
        wrong = with_turned(run, model, [1, 2, 3, 4], 40)  # half of the room beside the other
        (folder / "0").mkdir()
        wrong.write(folder / "0")
        return {0: wrong}

    monkeypatch.setattr(mapping, "_map", fail)
    names = [model.image(i).name for i in range(1, 9)]
    folder, finding = map_images(run, names, "PINHOLE", None, partial=False)
    assert finding is None
    found = run.pycolmap.Reconstruction(folder)
    assert found.num_reg_images() == 8
    assert found.compute_mean_reprojection_error() < 1
    assert misplaced(model, found) < 0.05
    assert {path.name for path in folder.parent.iterdir()} == {"0", "complete"}


def test_poses_that_explain_the_matches_are_not_mapped_again(run, monkeypatch):
    run, model = run
    monkeypatch.setattr(mapping, "_map_globally", None)
    names = [model.image(i).name for i in range(1, 9)]
    folder, _ = map_images(run, names, "PINHOLE", None, partial=False)
    assert misplaced(model, run.pycolmap.Reconstruction(folder)) < 0.05


def test_a_worse_model_of_all_photographs_at_once_is_not_kept(run, monkeypatch):
    run, model = run
    monkeypatch.setattr(mapping, "_EXPLAINED", 1.1)
    wrong = with_turned(run, model, [1, 2, 3, 4], 40)
    real = mapping._map

    def extend(run, stage, folder, *rest):
        return {0: wrong} if stage == "further mapping" else real(run, stage, folder, *rest)

    monkeypatch.setattr(mapping, "_map", extend)
    names = [model.image(i).name for i in range(1, 9)]
    folder, finding = map_images(run, names, "PINHOLE", None, partial=False)
    assert finding is None
    assert misplaced(model, run.pycolmap.Reconstruction(folder)) < 0.05
    assert {path.name for path in folder.parent.iterdir()} == {"0", "complete"}


def test_a_displaced_part_is_mapped_again_without_what_displaced_it(run, tmp_path, monkeypatch):
    run, model = run
    names = [model.image(i).name for i in range(1, 9)]
    folder, _ = map_images(run, names, "PINHOLE", None, partial=False)
    right, real = run.pycolmap.Reconstruction(folder), mapping._map
    numbers = [right.find_image_with_name(names[i]).image_id for i in (1, 4)]
    wrong = with_displaced(run, right, numbers, (2.0, 3.0, 1.0))
    assert compare_with_matches(run, wrong).part == (names[1], names[4])
    with run.pycolmap.Database.open(run.database) as database:
        pairs = database.num_verified_image_pairs()

    def map_wrongly(run, stage, folder, *rest):
        if stage != "mapping":
            return real(run, stage, folder, *rest)
        (folder / "0").mkdir()
        wrong.write(folder / "0")
        return {0: wrong}

    monkeypatch.setattr(mapping, "_map", map_wrongly)
    monkeypatch.setattr(mapping, "_map_globally", None)
    monkeypatch.setattr(mapping, "MODELS", str(tmp_path / "again"))
    folder, finding = map_images(run, names, "PINHOLE", None, partial=False)
    assert finding is None
    assert misplaced(model, run.pycolmap.Reconstruction(folder)) < 0.05
    assert {path.name for path in folder.parent.iterdir()} == {"0", "complete"}
    with run.pycolmap.Database.open(run.database) as database:  # the user's keep theirs
        assert database.num_verified_image_pairs() == pairs


def test_a_part_that_stays_misplaced_is_named(run, monkeypatch):
    run, model = run
    wrong = with_displaced(run, model, (2, 5, 7))

    def map_wrongly(run, stage, folder, *rest):
        (folder / "0").mkdir()
        wrong.write(folder / "0")
        return {0: wrong}

    monkeypatch.setattr(mapping, "_map", map_wrongly)
    monkeypatch.setattr(mapping, "_map_globally", lambda *_: {})
    names = [model.image(i).name for i in range(1, 9)]
    _, finding = map_images(run, names, "PINHOLE", None, partial=False)
    assert "% of the matches between 3 of the photographs (view_001.png, " in str(finding)
