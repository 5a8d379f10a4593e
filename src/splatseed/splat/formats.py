"""Read and write files of Gaussians.

The content decides the format on reading, the file name on writing. Writing is atomic. Gaussians
that cannot be drawn are dropped on reading (``cleaning.py``). A .ply is lossless; packed formats
lose fine detail and the order of Gaussians.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Collection, Iterable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.files import COPY_AGAIN, StrPath, read_bytes
from splatseed.io.staging import atomic_file
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.splat import compressed_ply, model_ply, sog, splat_file, spz
from splatseed.splat.cleaning import drop_unusable
from splatseed.splat.gaussians import Gaussians
from splatseed.text import beginning, did_you_mean

_HEADER = 1 << 20
_MODEL_SUFFIXES = (".spz", ".splat", ".sog", ".ksplat", ".glb")
_UNSUPPORTED = {
    ".ksplat": "GaussianSplats3D's own tool (util/create-ksplat.js) makes one from a .ply",
    ".glb": f"{sog.CONVERTER} MODEL.ply OUT.glb makes one from a .ply",
    ".gltf": f"{sog.CONVERTER} MODEL.ply OUT.glb makes a .glb from a .ply",
    ".usdz": "NVIDIA's converter (PyPI: usd-convert-gsplat) makes one from a .ply",
}
"""Unsupported formats, and tools that write them."""


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
        path: The folder of a run, or a .ply, compressed .ply, .splat, .spz, or .sog (or its
            meta.json), recognised by its content.
        note: Called with findings, such as Gaussians with NaN, which are left out.

    Returns:
        The Gaussians, in the order and frame of the file.

    Raises:
        SceneNotFoundError: The file does not exist.
        SceneFormatError: The format is unknown, the file is damaged, or no Gaussian can be drawn.
        MissingDependencyError: An .spz of version 4 needs zstandard.
    """
    path = Path(path)
    if path.is_dir():
        path /= RUN_FILE
    gaussians = FORMATS[detect_format(path, read_bytes(path))].decode(path, note)
    return drop_unusable(path, gaussians, note)


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
    found, other = path.suffix or "none", _UNSUPPORTED.get(path.suffix.lower())
    known = (*WRITTEN_SUFFIXES, *more)
    fix = f"Export a .ply: {other}." if other else f"{did_you_mean(found, known)}Choose one."
    for suffix, name in SUFFIXES.items():
        if path.name.lower().endswith(suffix):
            if suffix in known:
                return name
            found, fix = f"{suffix}, which is only read", "Write a .sog, its successor."
            break
    raise ParameterError(
        f"a file name that ends in one of {', '.join(known)}", found=found, fix=fix
    )


def detect_format(path: Path, data: bytes) -> str:
    """Return the name of the format of a file's content (of a .splat, of its name)."""
    suffix = path.suffix.lower()
    if data.startswith(b"ply") and data[3:4] in (b"\n", b"\r", b" ", b"\t"):
        return "compressed-ply" if b"packed_position" in data[:_HEADER] else "ply"
    start = data
    with suppress(zlib.error):
        start = zlib.decompressobj(wbits=31).decompress(data[:4096], 4)
    if start.startswith(spz.MAGIC):
        return "spz"
    if data.startswith(b"PK\x03\x04") or (data[:1] == b"{" and suffix == ".json"):
        return "sog"
    found, fix = beginning(data), "Name a file of trained Gaussians."
    if suffix == ".splat":
        size = splat_file.RECORD.itemsize
        if data and len(data) % size == 0:
            return "splat"
        found = f"{len(data):,} bytes, not a multiple of the {size} of a .splat's Gaussian"
        fix = COPY_AGAIN
    elif suffix in _UNSUPPORTED:
        found = f"a {suffix}"
        fix = f"Export a .ply where it came from, or try {sog.CONVERTER} IN{suffix} OUT.ply."
    expected = f"{path} to hold trained Gaussians ({', '.join(SUFFIXES)})"
    raise SceneFormatError(expected, found=found, fix=fix)


def holds_gaussians(path: Path) -> bool:
    """Whether a file holds Gaussians, or claims to by its suffix; a .ply of points does not."""
    if path.suffix.lower() in _MODEL_SUFFIXES:
        return True
    data = read_bytes(path)
    if path.suffix.lower() == ".json" and b'"means"' not in data[:_HEADER]:
        return False
    try:
        kind = detect_format(path, data)
    except SceneFormatError:
        return False
    return kind != "ply" or b" scale_0\n" in data[:_HEADER].replace(b"\r", b"")
