"""Gaussians in a .ply of the layout that 3DGS introduced and every viewer opens.

Notation: one vertex per Gaussian, float32 x, y, z, nx, ny, nz (zero), f_dc_0..2, f_rest_* (all of
red, then green, then blue), opacity (logit), scale_0..2 (logarithms), rot_0..3 (wxyz). Promise:
what was written is read back bit for bit; properties are found by name, so order and additional
ones do not matter; a file appears whole or not at all.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.files import ByteReader
from splatseed.io.ply import EXPORT_PLY_AGAIN, Element, parse_header, refuse_packed
from splatseed.io.staging import atomic_file
from splatseed.splat.gaussians import Gaussians

_MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
_OPACITY = ("opacity",)
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_REST_COUNTS = (0, 9, 24, 45)
"""Number of f_rest by the degree of spherical harmonics, 3 ((degree + 1)^2 - 1)."""


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians, replacing a file at ``path``.

    Raises:
        OutputError: The file cannot be written.
    """
    count, rest = len(gaussians), 3 * gaussians.shN.shape[1]
    names = (*_MEANS, *_NORMALS, *_SH0, *_rest_names(rest), *_OPACITY, *_SCALES, *_QUATS)
    table = np.concatenate(
        [
            gaussians.means,
            np.zeros((count, 3), np.float32),
            gaussians.sh0.reshape(count, 3),
            gaussians.shN.transpose(0, 2, 1).reshape(count, rest),
            gaussians.opacities[:, None],
            gaussians.scales,
            gaussians.quats,
        ],
        axis=1,
        dtype="<f4",
    )
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    with atomic_file(path) as partial, partial.open("wb") as file:
        file.write(f"{header}end_header\n".encode("ascii"))
        file.write(table.data)


def read_gaussians(path: Path) -> Gaussians:
    """Read Gaussians that any 3DGS trainer wrote, binary.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no PLY, is cut short, or does not hold Gaussians at finite places.
    """
    reader = ByteReader(path, EXPORT_PLY_AGAIN)
    header = parse_header(path, reader.data)
    for element in header.elements:
        refuse_packed(path, [prop.name for prop in element.properties])
    vertex = header.elements[0] if header.elements else Element("none", 0, ())
    names = {prop.name for prop in vertex.properties}
    rest = sum(name.startswith("f_rest_") for name in names)
    wanted = (*_MEANS, *_SH0, *_OPACITY, *_SCALES, *_QUATS, *_rest_names(rest))
    missing = [name for name in wanted if name not in names]
    if missing or not header.byte_order or vertex.has_lists:
        found = f"no {', '.join(missing[:5])}" if missing else "an ascii file, or lists"
    elif rest not in _REST_COUNTS or not vertex.num_rows:
        found = f"{rest} f_rest properties and {vertex.num_rows} vertices"
    else:
        found = ""
    if found:
        raise SceneFormatError(
            f"{path} to hold trained Gaussians in 3DGS's layout, binary",
            found=found,
            fix="Name the point_cloud.ply of a training run, not the seeds or a mesh.",
        )
    reader.offset, reader.record = header.size, "element vertex"
    rows = reader.array(header.dtype(vertex), vertex.num_rows)

    def columns(names: tuple[str, ...]) -> np.ndarray:
        table = np.empty((len(rows), len(names)), np.float32)
        for i, name in enumerate(names):
            table[:, i] = rows[name]
        return table

    channel_major = columns(_rest_names(rest)).reshape(len(rows), 3, rest // 3)
    means = columns(_MEANS)
    # Some trainers write opacity +inf for opaque Gaussians; positions must be finite.
    bad = ~np.isfinite(means).all(axis=1)
    if bad.any():
        raise SceneFormatError(
            f"{path} to have finite positions",
            found=f"{np.count_nonzero(bad)} that are not, the first in vertex {np.argmax(bad)}",
            fix="Train again, or remove those Gaussians.",
        )
    return Gaussians(
        means=means,
        scales=columns(_SCALES),
        quats=columns(_QUATS),
        opacities=columns(_OPACITY)[:, 0],
        sh0=columns(_SH0)[:, None],
        shN=np.ascontiguousarray(channel_major.transpose(0, 2, 1)),
    )


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))
