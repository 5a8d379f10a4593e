"""Read and write files of Gaussians.

The content decides the format on reading, the file name on writing. Writing is atomic. Gaussians
that cannot be drawn are dropped on reading (``cleaning.py``). A .ply is lossless; packed formats
lose fine detail and the order of Gaussians.
"""

from __future__ import annotations

import io
import json
import re
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.files import ARCHIVE_FAILURES, COPY_AGAIN, StrPath, read_bytes
from splatseed.io.staging import atomic_file
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.splat import (
    checkpoint,
    compressed_ply,
    gltf,
    gsplat_png,
    model_ply,
    sog,
    splat_file,
    spz,
)
from splatseed.splat.cleaning import drop_unusable
from splatseed.splat.gaussians import Gaussians
from splatseed.text import beginning, did_you_mean, name_some

_HEADER = 1 << 20
_MODEL_SUFFIXES = (".spz", ".splat", ".sog", ".ksplat", *checkpoint.SUFFIXES)
_UNWRITTEN = {
    ".ksplat": "GaussianSplats3D's own tool (util/create-ksplat.js) makes one from a .ply",
    ".glb": f"{sog.CONVERTER} MODEL.ply OUT.glb makes one from a .ply",
    ".gltf": f"{sog.CONVERTER} MODEL.ply OUT.glb makes a .glb from a .ply",
    ".usdz": "NVIDIA's converter (PyPI: usd-convert-gsplat) makes one from a .ply",
}
"""Formats that are not written, and tools that do."""
_UNREAD = (".ksplat", ".lcc")
"""Formats of Gaussians that are not read, but by the converter."""
_JSON_FORMATS = {".json": "sog", ".gltf": "glb"}
_SCALE_IN_PLY = re.compile(rb"[ _]scale_0\r?\n")


class Format(NamedTuple):
    """A file format; ``description`` lists what it preserves and its readers.

    One without ``encode`` is only read.
    """

    suffix: str
    description: str
    decode: Callable[[Path, Note], Gaussians]
    encode: Callable[[Gaussians, Note], Iterable[bytes | memoryview]] | None = None


FORMATS = {
    "compressed-ply": Format(
        ".compressed.ply", "all but fine detail; PlayCanvas, SuperSplat", compressed_ply.decode
    ),
    "ply": Format(
        ".ply", "everything, as 3DGS writes it; every tool reads it",
        model_ply.decode, model_ply.encode,
    ),
    "splat": Format(
        ".splat", "no view-dependent colour; web viewers", splat_file.decode, splat_file.encode
    ),
    "spz": Format(
        ".spz", "all but fine detail; Niantic, three.js viewers, glTF tools",
        spz.decode, spz.encode,
    ),
    "sog": Format(".sog", "all but fine detail; PlayCanvas, SuperSplat", sog.decode, sog.encode),
    "glb": Format(".glb", "everything; glTF's KHR_gaussian_splatting", gltf.decode),
    "checkpoint": Format(
        ".ckpt", "everything; the checkpoint of a trainer", checkpoint.decode
    ),
    "gsplat-png": Format("meta.json", "all but fine detail; gsplat", gsplat_png.decode),
}  # fmt: skip
"""Formats by name; a suffix stands before those that it ends with."""
SUFFIXES = {each.suffix: name for name, each in FORMATS.items()}
"""Names of formats by suffix."""
WRITTEN_SUFFIXES = tuple(each.suffix for each in FORMATS.values() if each.encode)


RUN_FILE = "point_cloud.ply"
"""The Gaussians in the folder of a run."""


def read_gaussians(path: StrPath, note: Note = silent_note) -> Gaussians:
    """Read the Gaussians of any trainer.

    Args:
        path: The folder of a run or of gsplat's PNG compression, or a .ply, compressed .ply,
            .splat, .spz, .sog (or its meta.json), .glb, or a checkpoint of gsplat, nerfstudio or
            graphdeco, recognised by its content.
        note: Called with findings, such as Gaussians with NaN, which are left out.

    Returns:
        The Gaussians, in the order and frame of the file.

    Raises:
        SceneNotFoundError: The file does not exist.
        SceneFormatError: The format is unknown, the file is damaged, or no Gaussian can be drawn.
        MissingDependencyError: An .spz of version 4 needs zstandard, a checkpoint PyTorch.
    """
    path = Path(path)
    if path.is_dir():
        path = next((p for p in (path / RUN_FILE, unpacked_model(path)) if p and p.is_file()), path)
    gaussians = FORMATS[detect_format(path, read_bytes(path))].decode(path, note)
    return drop_unusable(path, gaussians, note)


def unpacked_model(folder: Path) -> Path | None:
    """Return the ``meta.json`` of an unpacked SOG, or of gsplat's PNGs, in a folder; else None."""
    file = folder / sog.META
    return file if file.is_file() and holds_gaussians(file) else None


def round_trip(
    gaussians: Gaussians, suffix: str, progress: Progress = silent, note: Note = silent_note
) -> Gaussians:
    """Return Gaussians as they are read after writing them in the format of a suffix."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"model{suffix}"
        write_gaussians(path, gaussians, progress, note)
        return read_gaussians(path)


def write_gaussians(
    path: StrPath, gaussians: Gaussians, progress: Progress = silent, note: Note = silent_note
) -> None:
    """Write one or more Gaussians, at finite positions, in the format of the file name's suffix.

    ``note`` is called with findings on what the format cannot represent.

    Raises:
        ParameterError: The suffix is not of a supported format.
        OutputError: The file cannot be written.
    """
    path = Path(path)
    name = format_of_name(path)
    progress("encode", 0.0)
    if name == "sog":
        parts: Iterable[bytes | memoryview] = sog.encode(gaussians, note, progress)
    else:
        encode = FORMATS[name].encode
        assert encode is not None  # noqa: S101  (format_of_name refuses formats that are only read)
        parts = encode(gaussians, note)
    progress("encode", 1.0)
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.writelines(parts)


def format_of_name(path: Path, more: Collection[str] = ()) -> str:
    """Return the name of the format to write, by a file name's suffix.

    ``more`` are suffixes that the caller handles, for the message.
    """
    found, other = path.suffix or "none", _UNWRITTEN.get(path.suffix.lower())
    known = (*WRITTEN_SUFFIXES, *more)
    fix = f"Export a .ply: {other}." if other else f"{did_you_mean(found, known)}Choose one."
    for suffix, name in SUFFIXES.items():
        if path.name.lower().endswith(suffix):
            if suffix in known:
                return name
            found = f"{suffix}, which is only read"
            if not other:
                fix = (
                    "Write a .sog, its successor." if name == "compressed-ply" else "Write a .ply."
                )
            break
    raise ParameterError(
        f"a file name that ends in one of {', '.join(known)}", found=found, fix=fix
    )


def detect_format(path: Path, data: bytes) -> str:
    """Return the name of the format of a file's content (of a .splat, of its name)."""
    if (name := _format_of_content(path, data)) is not None:
        return name
    suffix = path.suffix.lower()
    if suffix in checkpoint.SUFFIXES:
        return "checkpoint"
    found, fix = beginning(data), "Name a file of trained Gaussians."
    if suffix == ".splat":
        size = splat_file.RECORD.itemsize
        if data and len(data) % size == 0:
            return "splat"
        found = f"{len(data):,} bytes, not a multiple of the {size} of a .splat's Gaussian"
        fix = COPY_AGAIN
    elif suffix in _UNREAD:
        found = f"a {suffix}"
        fix = f"Export a .ply where it came from, or try {sog.CONVERTER} IN{suffix} OUT.ply."
    elif suffix in _UNWRITTEN:
        found, fix = f"a {suffix}", "Export a .ply where it came from."
    expected = f"{path} to hold trained Gaussians ({', '.join(SUFFIXES)})"
    raise SceneFormatError(expected, found=found, fix=fix)


def _format_of_content(path: Path, data: bytes) -> str | None:
    if data.startswith(b"ply") and data[3:4] in (b"\n", b"\r", b" ", b"\t"):
        return "compressed-ply" if b"packed_position" in data[:_HEADER] else "ply"
    if data.startswith(b"PK\x03\x04"):
        return _format_of_archive(path, data)
    if data.startswith(gltf.MAGIC):
        return "glb"
    if data[:1] == b"{" and path.suffix.lower() in _JSON_FORMATS:
        name = _JSON_FORMATS[path.suffix.lower()]
        with suppress(ValueError, RecursionError):
            return "gsplat-png" if gsplat_png.is_gsplat_png(json.loads(data)) else name
        return name
    start = data
    with suppress(zlib.error):
        start = zlib.decompressobj(wbits=31).decompress(data[:4096], 4)
    return "spz" if start.startswith(spz.MAGIC) else None


def _format_of_archive(path: Path, data: bytes) -> str:
    """Return the name of the format of a .zip: PyTorch's, or SOG, or what its suffix says."""
    names: list[str] = []
    with suppress(*ARCHIVE_FAILURES), zipfile.ZipFile(io.BytesIO(data)) as archive:
        names = [PurePosixPath(name).name for name in archive.namelist()]
    if "data.pkl" in names or (not names and path.suffix.lower() in checkpoint.SUFFIXES):
        return "checkpoint"
    if sog.META in names or not names:
        return "sog"
    raise SceneFormatError(
        f"{path} to hold trained Gaussians ({', '.join(SUFFIXES)})",
        found=f"an archive of {name_some(names, 3)}",
        fix="Unpack it, and name the file of Gaussians in it.",
    )


def holds_gaussians(path: Path) -> bool:
    """Whether a file holds Gaussians, or claims to by its suffix; a .ply of points does not."""
    if path.suffix.lower() in _MODEL_SUFFIXES:
        return True
    data = read_bytes(path)
    if path.suffix.lower() == ".json" and b'"means"' not in data[:_HEADER]:
        return False
    if path.suffix.lower() in {".glb", ".gltf"}:
        return gltf.EXTENSION.encode() in data[:_HEADER]
    try:
        kind = detect_format(path, data)
    except SceneFormatError:
        return False
    return kind != "ply" or _SCALE_IN_PLY.search(data, 0, _HEADER) is not None
