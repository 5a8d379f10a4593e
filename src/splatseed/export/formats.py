"""The format of a file of Gaussians: read from its content, written by its name."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.literal import beginning, did_you_mean

CONVERTER = "npx @playcanvas/splat-transform"
"""The converter by the authors of SOG and compressed PLY."""
_HEADER = 1 << 20
_SPLAT_BYTES = 32


@dataclass(frozen=True)
class Format:
    """A format that can be read and written.

    Args:
        name: Its name here.
        suffix: The end of its file names.
        about: What it preserves, and who reads it.
    """

    name: str
    suffix: str
    about: str


FORMATS = {
    each.name: each
    for each in (
        Format("ply", ".ply", "everything, as 3DGS writes it; every tool reads it"),
        Format("compressed-ply", ".compressed.ply", "all but fine detail; PlayCanvas, SuperSplat"),
        Format("splat", ".splat", "no view-dependent colour; web viewers"),
        Format("spz", ".spz", "all but fine detail; Niantic, three.js viewers, glTF tools"),
        Format("sog", ".sog", "all but fine detail; PlayCanvas, SuperSplat"),
    )
}
"""The formats by name."""
SUFFIXES = {each.suffix: each.name for each in FORMATS.values()}
"""The formats by file name suffix."""
ELSEWHERE = {
    ".ksplat": "GaussianSplats3D's own tool (util/create-ksplat.js) makes one from a .ply",
    ".glb": f"{CONVERTER} MODEL.ply OUT.glb makes one from a .ply",
    ".gltf": f"{CONVERTER} MODEL.ply OUT.glb makes a .glb from a .ply",
    ".usdz": "NVIDIA's converter (PyPI: usd-convert-gsplat) makes one from a .ply",
}
"""Formats that splatseed does not write, and the tools that do."""


def format_of_name(path: Path) -> str:
    """The format that a file name asks for.

    Raises:
        ParameterError: The suffix belongs to no format written here.
    """
    lower = path.name.lower()
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        if lower.endswith(suffix):
            return SUFFIXES[suffix]
    known = ", ".join(SUFFIXES)
    suffix = path.suffix or "none"
    other = ELSEWHERE.get(path.suffix.lower())
    raise ParameterError(
        f"a file name that ends in one of {known}",
        found=suffix,
        fix=f"Export a .ply: {other}." if other else f"{did_you_mean(suffix, SUFFIXES)}Choose one.",
    )


def detect_format(path: Path, data: bytes) -> str:
    """The format of a file's content.

    Args:
        path: The file, for errors and for the format without a signature.
        data: Its bytes.

    Raises:
        SceneFormatError: The format cannot be read.
    """
    if data.startswith(b"ply") and data[3:4] in (b"\n", b"\r", b" ", b"\t"):
        return "compressed-ply" if b"packed_position" in data[:_HEADER] else "ply"
    if data.startswith(b"NGSP") or _begins_gzipped(data, b"NGSP"):
        return "spz"
    if data.startswith(b"PK\x03\x04") or (data[:1] == b"{" and path.suffix.lower() == ".json"):
        return "sog"
    if path.suffix.lower() == ".splat" and data and len(data) % _SPLAT_BYTES == 0:
        return "splat"
    raise _unknown(path, data)


def _begins_gzipped(data: bytes, mark: bytes) -> bool:
    if not data.startswith(b"\x1f\x8b"):
        return False
    try:
        return zlib.decompressobj(wbits=31).decompress(data[:4096], len(mark)) == mark
    except zlib.error:
        return False


def _unknown(path: Path, data: bytes) -> SceneFormatError:
    found = beginning(data)
    fix = "Name a file of trained Gaussians."
    if data.startswith(b"glTF"):
        found, fix = "a binary glTF", "Export a .ply where it came from: splatseed reads no glTF."
    elif path.suffix.lower() == ".ksplat":
        found, fix = "a .ksplat", f"Convert it: {CONVERTER} IN.ksplat OUT.ply."
    elif path.suffix.lower() == ".splat":
        found = f"{len(data):,} bytes, not a multiple of the {_SPLAT_BYTES} of a .splat's Gaussian"
        fix = "Copy the file again."
    return SceneFormatError(
        f"{path} to hold trained Gaussians ({', '.join(SUFFIXES)})", found=found, fix=fix
    )


def missing(path: Path) -> SceneNotFoundError:
    """The error that there is no such file."""
    return SceneNotFoundError(f"a file {path}", found="none", fix="Check the path.")
