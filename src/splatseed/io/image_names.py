"""Names of images that are spelled otherwise in a COLMAP model than on disk.

An umlaut has two forms in Unicode: one character (NFC), or a letter and a mark (NFD), as macOS
writes it. COLMAP stores the bytes of a name, which older Windows programs write in the encoding of
their country: such a name is read with surrogates, as ``os.fsdecode`` does. Promise: a name is only
replaced by that of an existing file that is the same text.
"""

from __future__ import annotations

import os
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.scene import Image
from splatseed.text import agreeing, counted

_ENCODINGS = ("utf-8", "cp1252", "gbk", "shift_jis", "big5", "euc_kr", "cp1251", "cp437")
"""Tried in this order; the first with which most files are found is used."""


def named_as_files(
    images: Sequence[Image], folders: Sequence[Path], model_file: Path
) -> tuple[tuple[Image, ...], list[Finding]]:
    """Return images with the names of their files in one of some folders, and what was renamed.

    Raises:
        SceneFormatError: Names in the model, or of files, are in no or another encoding than UTF-8.
    """
    odd = [image.name for image in images if not image.name.isascii()]
    if not odd:
        return tuple(images), []
    best, encoding, where = dict[str, str](), "utf-8", folders[0]
    for folder in folders:
        for each in _ENCODINGS:
            found = _files_of(odd, folder, each)
            if len(found) > len(best):
                best, encoding, where = found, each, folder
    _check_names(best, odd, where, model_file)
    changed = {name: file for name, file in best.items() if name != file}
    if not changed:
        return tuple(images), []
    how = "their Unicode form" if encoding == "utf-8" else f"the encoding, {encoding}"
    example, take = next(iter(changed.values())), agreeing(len(changed), "takes", "take")
    text = f"{counted(len(changed), 'image')} {take} the name of the file, such as {example}: "
    text += f"the model's differ in {how}."
    renamed = tuple(replace(im, name=changed.get(im.name, im.name)) for im in images)
    return renamed, [Finding("renamed-images", text, "info", tuple(changed.values()))]


def _files_of(names: Sequence[str], folder: Path, encoding: str) -> dict[str, str]:
    """Find the files of names in a folder; names, and those of files, may be in an encoding."""

    @cache
    def listing(place: Path) -> Mapping[str, str]:
        files = os.listdir(place) if place.is_dir() else []  # noqa: PTH208  (names, not paths)
        texts = {file: _composed(file, encoding) for file in files if not file.isascii()}
        found = {text: file for file, text in texts.items() if text is not None}
        return found | {file: file for file in files if file.isascii()}

    found = {}
    for name in names:
        if _is_text(name) and (folder / name).is_file():
            found[name] = name
        elif text := _composed(name, encoding):
            place: Path | None = folder
            for part in PurePosixPath(text).parts:
                file = listing(place).get(part) if place else None
                place = place / file if place and file else None
            if place and place.is_file():
                found[name] = place.relative_to(folder).as_posix()
    return found


def _composed(name: str, encoding: str) -> str | None:
    """Return a name in NFC, its bytes read in an encoding if they are not UTF-8; None if not."""
    try:
        if not _is_text(name):
            name = _bytes_of(name).decode(encoding)
    except (UnicodeError, ValueError):
        return None
    return unicodedata.normalize("NFC", name)


def _bytes_of(name: str) -> bytes:
    return name.encode("utf-8", "surrogateescape")


def _is_text(name: str) -> bool:
    return not any("\ud800" <= each <= "\udfff" for each in name)


def _check_names(
    found: Mapping[str, str], names: Sequence[str], folder: Path, model_file: Path
) -> None:
    """Raise ``SceneFormatError`` unless all names are text, those of files included."""
    files = [file for file in found.values() if not _is_text(file)]
    if files:
        raise SceneFormatError(
            f"photographs in {folder} with names in UTF-8",
            found=f"{counted(len(files), 'name')} in another encoding: {_readings(files[0])}",
            fix="Rename the files to names in UTF-8 (on Linux with convmv); the model may stay.",
        )
    unread = [name for name in names if not _is_text(found.get(name, name))]
    if unread:
        raise SceneFormatError(
            f"image names in UTF-8, or those of files, in {model_file}",
            found=f"{counted(len(unread), 'name')} in another encoding: {_readings(unread[0])}",
            fix="Copy the photographs to their folder, or reconstruct the scene with plain names.",
        )


def _readings(name: str) -> str:
    """Show the bytes of a name, and what they are in a few encodings."""
    readings = {encoding: _composed(name, encoding) for encoding in _ENCODINGS[1:4]}
    shown = [f"{text} in {encoding}" for encoding, text in readings.items() if text]
    return ", ".join([f"the bytes {_bytes_of(name)[:80].hex(' ')}", *shown])
