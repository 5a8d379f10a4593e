"""Reading and writing trained Gaussians in any of the formats.

Promise: a file's content decides its format; a file appears whole or not at all; positions read are
finite; Gaussians keep their values but, in packed formats, not their order.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.export import compressed_ply, sog, splat, spz
from splatseed.export.formats import detect_format, format_of_name
from splatseed.io.files import read_bytes
from splatseed.io.staging import atomic_file
from splatseed.progress import Progress, silent
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.ply import read_gaussians, write_gaussians

_DECODERS: dict[str, Callable[[Path], Gaussians]] = {
    "ply": read_gaussians,
    "compressed-ply": compressed_ply.decode,
    "splat": splat.decode,
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
        "compressed-ply": lambda: compressed_ply.encode(gaussians),
        "splat": lambda: splat.encode(gaussians),
        "spz": lambda: spz.encode(gaussians),
        "sog": lambda: sog.encode(gaussians, progress),
    }
    data = encoders[name]()
    progress("encode", 1.0)
    with atomic_file(path) as partial:
        partial.write_bytes(data)
