"""What is kept of a run that fails or is to be resumed, and when it is used."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")

from splatseed.io.staging import locked
from splatseed.progress import silent, silent_note
from splatseed.scene import Masks
from splatseed.sfm import Settings, mapping, pipeline
from splatseed.sfm.cameras import Photo
from splatseed.sfm.colmap import ColmapRun, posed_model, require_pycolmap
from splatseed.sfm.database import run_database
from splatseed.sfm.matching import match_photographs
from splatseed.sfm.work_folder import WorkFolder, WorkKey, resumable_work, work_key

from ..wide_png import png16

PHOTOS = {name: Photo((40, 30), digest=name) for name in ("a.jpg", "b.jpg", "c.jpg")}


def key(
    photos=PHOTOS, lens="OPENCV", groups=None, masks=None, seed=0, size=1600, matcher="exhaustive"
):
    cameras = [(names, lens) for names in groups or [list(photos)]]
    return work_key(photos, cameras, masks, seed, features=[size], pairs=[matcher])


def fail(output, key, **how):
    """A run that gets to its database and models, then fails: its notes, and what it found."""
    notes = []
    with (  # noqa: PT012  (what the block does is the run)
        pytest.raises(KeyboardInterrupt),
        resumable_work(output, key, lambda each: notes.append(str(each)), **how) as kept,
    ):
        found = kept.unchanged, len(kept.reusable), (kept.folder / "models" / "0").is_dir()
        (kept.folder / "database.db").touch()
        kept.set_contents(list(key.features))
        (kept.folder / "models" / "0").mkdir(parents=True, exist_ok=True)
        (kept.folder / "models" / "complete").touch()
        raise KeyboardInterrupt
    assert f"{output.name}_sfm" in notes.pop()
    return notes, found


def test_the_same_run_goes_on_and_success_removes_what_was_kept(tmp_path):
    assert fail(tmp_path / "out", key()) == ([], (False, 0, False))
    notes, found = fail(tmp_path / "out", key())
    assert found == (True, 3, True)
    assert len(notes) == 1
    assert "models" in notes[0]
    assert str(tmp_path / "out_sfm") in notes[0]
    with resumable_work(tmp_path / "out", key(), silent_note):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("other", "unchanged", "reusable", "note"),
    [
        ({"lens": "SIMPLE_RADIAL"}, False, 3, "The features and matches"),
        ({"groups": [["a.jpg"], ["b.jpg", "c.jpg"]]}, False, 3, "The features and matches"),
        ({"seed": 1}, False, 3, "The features and matches"),
        ({"matcher": "sequential"}, True, 3, "the features and matches"),
        ({"photos": {**PHOTOS, "a.jpg": Photo((40, 30), digest="x")}}, False, 2, "2 of 3"),
        ({"photos": {**PHOTOS, "d.jpg": Photo((40, 30), digest="d")}}, False, 3, "3 of 4"),
        ({"masks": Masks({})}, False, 0, "started again"),
        ({"size": 800}, False, 0, "started again"),
    ],
)
def test_another_run_uses_what_applies(other, unchanged, reusable, note, tmp_path):
    fail(tmp_path / "out", key())
    notes, found = fail(tmp_path / "out", key(**other))
    assert found == (unchanged, reusable, False)
    assert note in notes[0]
    assert fail(tmp_path / "out", key(**other))[1] == (True, len(other.get("photos", PHOTOS)), True)


def test_brighter_photographs_of_few_bits_make_features_anew(tmp_path, monkeypatch):
    """Features are found at the white of the whole capture."""
    whites = []

    def stop(*_, features, **__):
        whites.append(features[-1])
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "work_key", stop)
    (photos := tmp_path / "photos").mkdir()
    for name, largest in (("a.png", 900), ("b.png", 800), ("c.png", 4000)):
        (photos / name).write_bytes(png16(np.full((30, 40, 3), largest)))
        if name != "a.png":
            with pytest.raises(KeyboardInterrupt):
                pipeline.reconstruct(photos, tmp_path / "out")
    assert whites == [1023, 4095]


def test_a_kill_before_the_database_is_rewritten_loses_only_what_differs(tmp_path):
    changed = {**PHOTOS, "a.jpg": Photo((40, 30), digest="x")}
    fail(tmp_path / "out", key())
    with pytest.raises(KeyboardInterrupt), resumable_work(tmp_path / "out", key(changed), print):
        raise KeyboardInterrupt
    assert fail(tmp_path / "out", key())[1] == (False, 2, False)  # of a.jpg nothing is sure


def test_resume_keeps_the_work_of_a_success_for_all_later_runs(tmp_path):
    notes = []
    for i, resume in enumerate((True, False)):
        with resumable_work(tmp_path / "out", key(), notes.append, resume=resume) as kept:
            assert kept.unchanged == bool(i)
            (kept.folder / "database.db").write_bytes(bytes(3 << 20))
            kept.set_contents(list(PHOTOS))
        assert "3 MB" in str(notes[-1])
        assert (tmp_path / "out_sfm" / "database.db").exists()


def test_nothing_is_kept_before_work_began_or_where_it_is_not_ours(tmp_path):
    with pytest.raises(KeyboardInterrupt), resumable_work(tmp_path / "out", key(), print):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    (tmp_path / "out_sfm").mkdir()
    (tmp_path / "out_sfm" / "mine.txt").touch()
    notes = []
    with resumable_work(tmp_path / "out", key(), notes.append) as kept:
        assert kept is None
    assert [each.kind for each in notes] == ["work-not-kept"]
    assert (tmp_path / "out_sfm" / "mine.txt").exists()
    fail(tmp_path / "other", key())
    with locked(tmp_path / "other_sfm"), resumable_work(tmp_path / "other", key(), print) as kept:
        assert kept is None  # another run works there


def test_features_and_matches_move_to_the_database_of_other_photographs(room, tmp_path):
    """After a kill amid matching, photographs 1 and 2 of 0 to 2 stay and one comes before them."""
    pycolmap = require_pycolmap()
    photos, folder, work = tmp_path / "photos", tmp_path / "out_sfm", tmp_path / "work"
    for each in (folder, work):
        each.mkdir()
    shutil.copytree(room.source.image_dir, photos)
    run = ColmapRun(pycolmap, Settings("exhaustive", "cpu"), photos, work, silent)

    def of(numbers, earlier=()):
        images = [room.images[i] for i in numbers]
        names = [image.name for image in images]
        kept = WorkFolder(folder, WorkKey({}, "", ""), reusable=frozenset(earlier) & {*names})
        return replace(run, kept=kept), posed_model(pycolmap, images), names

    before, model, names = of([0, 1, 2])
    match_photographs(before, model)
    with pycolmap.Database.open(before.database) as database:
        descriptors = database.read_descriptors(2).data
        matches = database.read_matches(2, 3)
        for image in database.read_all_images():  # as a kill amid matching leaves them
            image.name = str(image.image_id)
            database.update_image(image)
    now, model, _ = of([3, 1, 2], earlier=names)  # image 1 is another
    with run_database(now, model) as database:
        assert [image.name for image in database.read_all_images()] == [
            room.images[i].name for i in (3, 1, 2)
        ]
        assert not database.exists_keypoints(1)
        np.testing.assert_array_equal(database.read_descriptors(2).data, descriptors)
        np.testing.assert_array_equal(database.read_matches(2, 3), matches)
        assert not database.exists_matches(1, 2)
        assert database.num_verified_image_pairs() == 0
    match_photographs(replace(now, kept=now.kept._replace(unchanged=True)), model)
    fresh = replace(run, work=tmp_path / "fresh")
    fresh.work.mkdir()
    match_photographs(fresh, model)
    with (
        pycolmap.Database.open(now.database) as resumed,
        pycolmap.Database.open(fresh.database) as anew,
    ):
        for pair in ((1, 2), (1, 3), (2, 3)):
            found = [each.read_two_view_geometry(*pair).inlier_matches for each in (resumed, anew)]
            assert len(found[0]) > 30
            np.testing.assert_array_equal(*found)


def test_mapping_goes_on_from_the_last_sure_snapshot(room, tmp_path, monkeypatch):
    folder, work = tmp_path / "out_sfm", tmp_path / "work"
    for each in (folder, work):
        each.mkdir()
    monkeypatch.setattr(mapping, "_SNAPSHOT_FRAMES", 2)
    settings = Settings("sequential", "cpu")
    kept = WorkFolder(folder, WorkKey({}, "", ""))
    run = ColmapRun(require_pycolmap(), settings, room.source.image_dir, work, silent, kept)
    images = room.images[:8]
    match_photographs(run, posed_model(run.pycolmap, images))
    names = [image.name for image in images]

    def interrupt(stage, _):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        mapping.map_images(
            replace(run, on_progress=interrupt), names, "PINHOLE", None, partial=False
        )
    given = []
    real_extend = mapping._extend

    def extend(run, stage, snapshot, *rest):
        given.append(run.pycolmap.Reconstruction(snapshot).num_reg_images())
        return real_extend(run, stage, snapshot, *rest)

    monkeypatch.setattr(mapping, "_extend", extend)
    model, _ = mapping.map_images(run, names, "PINHOLE", None, partial=False)
    assert 2 < given[0] < 8
    assert run.pycolmap.Reconstruction(model).num_reg_images() == 8
    assert {path.name for path in (folder / "models").iterdir()} == {"0", "complete"}
