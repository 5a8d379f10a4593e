"""Reading and writing trained Gaussians in any format, and choosing which to keep.

Promise: a file's content decides its format when it is read, its name when it is written; a file
appears whole or not at all; positions read are finite; Gaussians keep their values but, in packed
formats, not their order.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.export import packing, sog, spz
from splatseed.io.files import COPY_AGAIN, read_bytes
from splatseed.io.staging import atomic_file
from splatseed.literal import beginning, did_you_mean
from splatseed.progress import Progress, silent
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.ply import read_gaussians, write_gaussians

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
_ELSEWHERE = {
    ".ksplat": "GaussianSplats3D's own tool (util/create-ksplat.js) makes one from a .ply",
    ".glb": f"{sog.CONVERTER} MODEL.ply OUT.glb makes one from a .ply",
    ".gltf": f"{sog.CONVERTER} MODEL.ply OUT.glb makes a .glb from a .ply",
    ".usdz": "NVIDIA's converter (PyPI: usd-convert-gsplat) makes one from a .ply",
}
"""Formats that splatseed does not write, and the tools that do."""
_DECODERS: dict[str, Callable[[Path], Gaussians]] = {
    "ply": read_gaussians,
    "compressed-ply": packing.decode_compressed_ply,
    "splat": packing.decode_splat,
    "spz": spz.decode,
    "sog": sog.decode,
}


def read_model(path: Path) -> Gaussians:
    """Read trained Gaussians: .ply, compressed .ply, .splat, .spz, .sog (or its meta.json).

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no Gaussians in a known format, or is damaged.
        MissingDependencyError: It is an .spz of version 4, which needs zstandard.
    """
    gaussians = _DECODERS[detect_format(path, read_bytes(path))](path)
    bad = ~np.isfinite(gaussians.means).all(axis=1)
    if bad.any():
        raise SceneFormatError(
            f"{path} to have finite positions",
            found=f"{np.count_nonzero(bad)} that are not, the first in Gaussian {np.argmax(bad)}",
            fix="Export it again, or remove those Gaussians.",
        )
    return gaussians


def write_model(path: Path, gaussians: Gaussians, progress: Progress = silent) -> None:
    """Write Gaussians in the format that the file name asks for, replacing a file at ``path``.

    Args:
        path: The file.
        gaussians: At least one, with finite positions.
        progress: Called with the stage and the fraction done.

    Raises:
        ParameterError: The suffix belongs to no format written here.
        OutputError: The file cannot be written.
    """
    name = format_of_name(path)
    if name == "ply":
        write_gaussians(path, gaussians)
        return
    progress("encode", 0.0)
    encoders: dict[str, Callable[[], bytes]] = {
        "compressed-ply": lambda: packing.encode_compressed_ply(gaussians),
        "splat": lambda: packing.encode_splat(gaussians),
        "spz": lambda: spz.encode(gaussians),
        "sog": lambda: sog.encode(gaussians, progress),
    }
    data = encoders[name]()
    progress("encode", 1.0)
    with atomic_file(path) as partial:
        partial.write_bytes(data)


def format_of_name(path: Path) -> str:
    """The format that a file name asks for.

    Raises:
        ParameterError: The suffix belongs to no format written here.
    """
    for suffix in sorted(SUFFIXES, key=len, reverse=True):
        if path.name.lower().endswith(suffix):
            return SUFFIXES[suffix]
    suffix, other = path.suffix or "none", _ELSEWHERE.get(path.suffix.lower())
    raise ParameterError(
        f"a file name that ends in one of {', '.join(SUFFIXES)}",
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
    suffix = path.suffix.lower()
    if data.startswith(b"ply") and data[3:4] in (b"\n", b"\r", b" ", b"\t"):
        return "compressed-ply" if b"packed_position" in data[:_HEADER] else "ply"
    if data.startswith(b"NGSP") or _begins_gzipped(data, b"NGSP"):
        return "spz"
    if data.startswith(b"PK\x03\x04") or (data[:1] == b"{" and suffix == ".json"):
        return "sog"
    found, fix = beginning(data), "Name a file of trained Gaussians."
    if suffix == ".splat":
        if data and len(data) % _SPLAT_BYTES == 0:
            return "splat"
        found = f"{len(data):,} bytes, not a multiple of the {_SPLAT_BYTES} of a .splat's Gaussian"
        fix = COPY_AGAIN
    elif data.startswith(b"glTF"):
        found, fix = "a binary glTF", "Export a .ply where it came from: splatseed reads no glTF."
    elif suffix == ".ksplat":
        found, fix = "a .ksplat", f"Convert it: {sog.CONVERTER} IN.ksplat OUT.ply."
    expected = f"{path} to hold trained Gaussians ({', '.join(SUFFIXES)})"
    raise SceneFormatError(expected, found=found, fix=fix)


def _begins_gzipped(data: bytes, mark: bytes) -> bool:
    if not data.startswith(b"\x1f\x8b"):
        return False
    try:
        return zlib.decompressobj(wbits=31).decompress(data[:4096], len(mark)) == mark
    except zlib.error:
        return False


@dataclass(frozen=True, eq=False)
class Crop:
    """A box in the model's world.

    Args:
        low: Minimum corner, [3].
        high: Maximum corner, [3].
    """

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]


def parse_crop(text: str) -> Crop:
    """The box given by six comma-separated numbers: minimum x, y, z, then maximum x, y, z.

    Raises:
        ParameterError: There are not six, or they make no box.

    Example:
        >>> parse_crop("-1,-1,-1,1,1,2").high.tolist()
        [1.0, 1.0, 2.0]
    """
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (6,) or not (numbers[:3] < numbers[3:]).all():
        raise ParameterError(
            "--crop x0,y0,z0,x1,y1,z1, the minimum and maximum corners of a box",
            found=repr(text),
            fix="splatseed info SCENE prints the bounding box of the points.",
        )
    return Crop(numbers[:3], numbers[3:])


def check_opacity(min_opacity: float) -> None:
    """Refuse a lowest opacity that is not from 0 to 1.

    Raises:
        ParameterError: It is not.
    """
    if not 0 <= min_opacity < 1:
        raise ParameterError(
            "--min-opacity of 0 or more, less than 1", found=f"{min_opacity}", fix="Try 0.05."
        )


def keep_gaussians(
    gaussians: Gaussians, crop: Crop | None = None, min_opacity: float = 0.0
) -> Gaussians:
    """The Gaussians whose centres lie in a box and that are opaque enough, in their order.

    Args:
        gaussians: The model's.
        crop: The box; no limit when left out.
        min_opacity: Lowest opacity kept, 0 to 1.

    Raises:
        ParameterError: The opacity is out of range, or no Gaussian is left.
    """
    check_opacity(min_opacity)
    keep = np.ones(len(gaussians), bool)
    if min_opacity:
        keep &= gaussians.opacities >= np.log(min_opacity / (1 - min_opacity))
    if crop is not None:
        keep &= ((gaussians.means >= crop.low) & (gaussians.means <= crop.high)).all(axis=1)
    if keep.all():
        return gaussians
    if not keep.any():
        ends = (end(gaussians.means, axis=0) for end in (np.min, np.max))
        low, high = (" ".join(f"{value:.4g}" for value in end) for end in ends)
        raise ParameterError(
            "--crop and --min-opacity to leave some Gaussians",
            found=f"none of {len(gaussians):,}, whose centres lie from {low} to {high}",
            fix="Choose a larger box or a smaller opacity.",
        )
    return Gaussians(**{name: array[keep] for name, array in gaussians.arrays().items()})
