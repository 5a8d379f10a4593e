"""What is kept of a run that fails, and when it is used."""

from __future__ import annotations

import pytest

pytest.importorskip("pycolmap", reason="needs pycolmap")

from splatseed.io.staging import locked
from splatseed.scene import Masks
from splatseed.sfm.cameras import Photo
from splatseed.sfm.work_folder import resumable_work, work_key

PHOTOS = {name: Photo((40, 30), digest=name) for name in ("a.jpg", "b.jpg", "c.jpg")}


def key(
    photos=PHOTOS, lens="OPENCV", groups=None, masks=None, size=1600, matching=("exhaustive", 0)
):
    groups = groups or [list(photos)]
    return work_key(photos, [(names, lens) for names in groups], masks, size, matching)


def fail(output, key):
    """A run that gets to its database and models, then fails; its notes, and whether they stay."""
    notes = []
    with (  # noqa: PT012  (what the block does is the run)
        pytest.raises(KeyboardInterrupt),
        resumable_work(output, key, notes.append) as kept,
    ):
        found = (kept.folder / "models" / "0").is_dir()
        stale = kept.stale_matches, (kept.folder / "database.db").exists()
        (kept.folder / "database.db").touch()
        (kept.folder / "models" / "0").mkdir(parents=True, exist_ok=True)
        raise KeyboardInterrupt
    assert f"{output.name}_sfm" in notes.pop()
    return notes, (*stale, found)


def test_the_same_run_goes_on_and_success_removes_what_was_kept(tmp_path):
    assert fail(tmp_path / "out", key()) == ([], (False, False, False))
    notes, state = fail(tmp_path / "out", key())
    assert state == (False, True, True)
    assert len(notes) == 1
    assert "models" in notes[0]
    assert str(tmp_path / "out_sfm") in notes[0]
    with resumable_work(tmp_path / "out", key(), notes.append):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "other",
    [{"lens": "SIMPLE_RADIAL"}, {"matching": ("sequential", 0)}, {"matching": ("exhaustive", 1)}],
)
def test_other_settings_use_the_features(other, tmp_path):
    fail(tmp_path / "out", key())
    notes, state = fail(tmp_path / "out", key(**other))
    assert state == (True, True, False)
    assert "features" in notes[0]


CHANGED = {**PHOTOS, "a.jpg": PHOTOS["a.jpg"]._replace(digest="other")}


@pytest.mark.parametrize(
    "other",
    [
        {"photos": CHANGED},
        {"groups": [["a.jpg"], ["b.jpg", "c.jpg"]]},
        {"masks": Masks({})},
        {"size": 800},
    ],
)
def test_other_photographs_masks_or_cameras_begin_anew(other, tmp_path):
    fail(tmp_path / "out", key())
    notes, state = fail(tmp_path / "out", key(**other))
    assert state == (False, False, False)
    assert "again" in notes[0]


def test_nothing_is_kept_before_work_began_or_where_it_is_not_ours(tmp_path):
    with pytest.raises(KeyboardInterrupt), resumable_work(tmp_path / "out", key(), print):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    (tmp_path / "out_sfm").mkdir()
    (tmp_path / "out_sfm" / "mine.txt").touch()
    with resumable_work(tmp_path / "out", key(), print) as kept:
        assert kept is None
    assert (tmp_path / "out_sfm" / "mine.txt").exists()
    fail(tmp_path / "other", key())
    with locked(tmp_path / "other_sfm"), resumable_work(tmp_path / "other", key(), print) as kept:
        assert kept is None  # another run works there
