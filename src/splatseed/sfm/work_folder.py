"""Work that outlives a run that fails: features, matches and models, in a folder beside the output.

Of an output ``NAME`` it is ``NAME_sfm``. The same command goes on from it; other settings of
matching or of the lens use its features; other photographs, masks or groups of cameras start anew.
A run that succeeds removes it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

from splatseed.camera import Intrinsics
from splatseed.io.staging import MANIFEST, locked, read_manifest, remove, write_json
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Masks
from splatseed.sfm.cameras import Photos
from splatseed.text import quoted

KIND = "sfm work"
DATABASE, MODELS = "database.db", "models"


class WorkFolder(NamedTuple):
    """The folder of such work, and whether its matches are of other settings."""

    folder: Path
    stale_matches: bool = False


def work_key(
    photos: Photos,
    cameras: Iterable[tuple[Sequence[str], Intrinsics | str]],
    masks: Masks | None,
    max_image_size: int,
    matching: Sequence[object],
) -> dict[str, str]:
    """Digests of what determines features, and of what determines matches beside them.

    ``cameras`` are the names of the photographs that share one, and the lens or its model;
    ``matching`` are the settings that decide on pairs and on their verification.
    """
    features: list[object] = [version("pycolmap"), max_image_size]
    lenses = []
    for names, lens in cameras:
        features += [(name, photos[name].digest, _mask_facts(masks, name)) for name in names]
        features.append("another camera")
        lenses.append(lens if isinstance(lens, str) else (lens.model, lens.params))
    return {"features": _digest(features), "matches": _digest([*lenses, *matching])}


def _mask_facts(masks: Masks | None, name: str) -> tuple[object, ...]:
    if masks is None:
        return ()
    path, flags = masks.files.get(name), (masks.inverted, masks.alpha)
    status = path.stat() if path is not None and path.is_file() else None
    return (*flags, *((status.st_size, status.st_mtime_ns) if status else ()))


def _digest(facts: Sequence[object]) -> str:
    return fingerprint("\n".join(map(repr, facts)).encode())


@contextmanager
def resumable_work(
    output: Path, key: Mapping[str, str], on_note: Callable[[str], None]
) -> Iterator[WorkFolder | None]:
    """The folder for the work of an output; it stays if the block fails after work began.

    None where something else has its name, or another run holds it.
    """
    target = output.resolve()
    folder = target.with_name(f"{target.name}_sfm")
    if folder.exists() and read_manifest(folder).get("command") != KIND:
        yield None
        return
    with ExitStack() as stack:
        folder.mkdir(exist_ok=True)
        try:
            stack.enter_context(locked(folder))
        except OSError:
            yield None
            return
        stale = _prepare(folder, key, lambda text: on_note(text.format(quoted(folder))))
        try:
            yield WorkFolder(folder, stale)
        except BaseException as error:
            if not (folder / DATABASE).exists():
                remove(folder)
            elif isinstance(error, KeyboardInterrupt):
                on_note(f"The same command goes on from what is kept in {quoted(folder)}.")
            raise
        remove(folder)


def _prepare(folder: Path, key: Mapping[str, str], on_note: Callable[[str], None]) -> bool:
    """Make a folder's content fit the key; whether its matches do not."""
    before: Mapping[str, Any] = read_manifest(folder)
    found = (folder / DATABASE).is_file()
    stale = found and before.get("matches") != key["matches"]
    if not found or before.get("features") != key["features"]:
        stale = False
        for name in (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm", MODELS):
            remove(folder / name)
        if found:
            on_note("The work kept in {} is of other photographs, masks or cameras: begun anew.")
    elif stale:
        remove(folder / MODELS)
        on_note("The features kept in {} are used; other settings need other matches.")
    else:
        on_note("Goes on from the features, matches and models kept in {}.")
    write_json(folder / MANIFEST, {"command": KIND, **key})
    return stale
