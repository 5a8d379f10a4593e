"""Resumable work of a failed run: features, matches and models in ``OUTPUT_sfm``.

The same command resumes it. With other settings of matching or lenses, features are reused; with
other photographs, masks or camera groups, nothing is. A successful run removes the folder.
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
    """The folder, and whether its matches were made with other settings."""

    folder: Path
    stale_matches: bool = False


def work_key(
    photos: Photos,
    cameras: Iterable[tuple[Sequence[str], Intrinsics | str]],
    masks: Masks | None,
    max_image_size: int,
    matching: Sequence[object],
) -> dict[str, str]:
    """Fingerprint the inputs of features, and the further inputs of matches.

    Args:
        photos: The photographs.
        cameras: For each camera, the names of its photographs, and its intrinsics or model.
        masks: Their masks.
        max_image_size: The size at which features are detected.
        matching: Settings of pairs and their verification.
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
    """Yield the work folder of an output; it is kept if the block fails after work started.

    Yields None if the path is taken or another run has locked the folder.
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
                on_note(f"The same command resumes from {quoted(folder)}.")
            raise
        remove(folder)


def _prepare(folder: Path, key: Mapping[str, str], on_note: Callable[[str], None]) -> bool:
    """Remove content that does not match the key; return whether matches are stale."""
    before: Mapping[str, Any] = read_manifest(folder)
    found = (folder / DATABASE).is_file()
    stale = found and before.get("matches") != key["matches"]
    if not found or before.get("features") != key["features"]:
        stale = False
        for name in (DATABASE, f"{DATABASE}-wal", f"{DATABASE}-shm", MODELS):
            remove(folder / name)
        if found:
            on_note("The work in {} is of other photographs, masks or cameras: started again.")
    elif stale:
        remove(folder / MODELS)
        on_note("The features in {} are used; the settings of matches differ.")
    else:
        on_note("Resumes from the features, matches and models in {}.")
    write_json(folder / MANIFEST, {"command": KIND, **key})
    return stale
