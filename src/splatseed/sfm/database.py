"""The database of a run: its images and cameras, and what applies of an earlier run's.

A database of the run's photographs is written beside an earlier one and then takes its place, so
that a kill leaves one or the other. Features are copied where the photograph is unchanged, matches
where both are; the geometry of pairs is verified again, which depends on cameras, too.

Images and cameras are written before features are detected, so that ids are ours: camera i has rig
i, image i has frame i, counted from 1; a rig of panoramas has the id of its first camera, a frame
of theirs that of its first image. Python's sqlite3 is another copy of SQLite, and two copies in one
process release each other's file locks, which corrupts the file: only pycolmap opens it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from splatseed.io.staging import remove
from splatseed.sfm.colmap import ColmapRun


@contextmanager
def run_database(run: ColmapRun, model: Any) -> Iterator[Any]:
    """Open the database of a run on the images and cameras of ``model``."""
    pycolmap, path, kept = run.pycolmap, run.database, run.kept
    found = kept is not None and path.is_file()
    if kept is not None and found:
        with pycolmap.Database.open(path) as database:
            _restore_names(database, kept.image_names)
    if kept is None or not (found and kept.unchanged):
        fresh = path.with_name(f"new_{path.name}")
        _remove(fresh)
        with pycolmap.Database.open(fresh) as database:
            _write_model(database, model)
            if kept is not None and found:
                with pycolmap.Database.open(path) as earlier:
                    _copy(pycolmap, earlier, database, kept.reusable)
        _remove(path)
        fresh.rename(path)
        if kept is not None:
            kept.set_contents([model.image(i).name for i in sorted(model.images)])
    with pycolmap.Database.open(path) as database:
        yield database


@contextmanager
def numbered(database: Any) -> Iterator[None]:
    """Give the database's images their ids as names: in lists of pairs a name ends at a space.

    After a kill, ``run_database`` restores the names.
    """
    names = _names(database)
    _rename(database, {image_id: str(image_id) for image_id in names})
    try:
        yield
    finally:
        _rename(database, names)


def _write_model(database: Any, model: Any) -> None:
    for _, camera in sorted(model.cameras.items()):
        database.write_camera(camera, use_camera_id=True)
    for rig_id in sorted(model.rigs):
        database.write_rig(model.rig(rig_id), use_rig_id=True)
    for frame_id in sorted(model.frames):
        database.write_frame(model.frame(frame_id), use_frame_id=True)
    for image_id in sorted(model.images):
        database.write_image(model.image(image_id), use_image_id=True)


def _copy(pycolmap: Any, earlier: Any, database: Any, names: Collection[str]) -> None:
    """Copy features of photographs, by name, and their matches with each other."""
    now = {name: image_id for image_id, name in _names(database).items()}
    ids = {i: now[n] for i, n in _names(earlier).items() if n in names and n in now}
    for old, new in ids.items():
        if earlier.exists_keypoints(old) and earlier.exists_descriptors(old):
            database.write_keypoints(new, earlier.read_keypoints(old))
            database.write_descriptors(new, earlier.read_descriptors(old))
    for pair_id in earlier.read_num_matches()[0]:
        one, other = pycolmap.pair_id_to_image_pair(pair_id)
        if one in ids and other in ids:
            matches = earlier.read_matches(one, other)
            database.write_matches(ids[one], ids[other], matches)


def _restore_names(database: Any, names: Sequence[str]) -> None:
    """Undo ``numbered`` after a kill; photographs' names have a suffix."""
    numbers = (i for i, name in _names(database).items() if name == str(i))
    _rename(database, {i: names[i - 1] for i in numbers if i <= len(names)})


def _rename(database: Any, names: Mapping[int, str]) -> None:
    for image_id, name in names.items():
        image = database.read_image(image_id)
        if image.name != name:
            image.name = name
            database.update_image(image)


def _names(database: Any) -> dict[int, str]:
    return {image.image_id: image.name for image in database.read_all_images()}


def _remove(path: Path) -> None:
    for suffix in ("", "-wal", "-shm"):
        remove(path.with_name(path.name + suffix))
