"""Gaussians in a .ply of the layout that 3DGS introduced and every viewer opens.

Notation: one vertex per Gaussian, float32 x, y, z, nx, ny, nz (zero), f_dc_0..2, f_rest_* (all of
red, then green, then blue), opacity (logit), scale_0..2 (logarithms), rot_0..3 (wxyz). Promise:
what was written is read back bit for bit; properties are found by name, so order and additional
ones do not matter; a file appears whole or not at all.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from splatseed.errors import SceneFormatError
from splatseed.io.binary import ByteReader
from splatseed.io.output.staging import atomic_file
from splatseed.io.ply.foreign import refuse_packed
from splatseed.io.ply.header import EXPORT_PLY_AGAIN, Element, parse_header
from splatseed.splat.gaussians import Gaussians

XYZ = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
DC = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
REST_COUNTS = {0: 0, 9: 1, 24: 2, 45: 3}
"""Number of f_rest at each degree of spherical harmonics, 3 ((degree + 1)^2 - 1)."""


def write_gaussians(path: Path, gaussians: Gaussians) -> None:
    """Write Gaussians, replacing a file at ``path``.

    Raises:
        OutputError: The file cannot be written.
    """
    count, rest = len(gaussians), 3 * gaussians.shN.shape[1]
    names = (*XYZ, *NORMAL, *DC, *_rest_names(rest), *OPACITY, *SCALE, *ROTATION)
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
    """Read Gaussians that any 3DGS trainer wrote, binary little-endian.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no PLY, is cut short, or does not hold Gaussians.
    """
    reader = ByteReader(path, EXPORT_PLY_AGAIN)
    header = parse_header(path, reader.data)
    for element in header.elements:
        refuse_packed(path, [prop.name for prop in element.properties])
    vertex = header.elements[0] if header.elements else Element("none", 0, ())
    _check(path, header.byte_order, vertex)
    reader.offset, reader.record = header.size, "element vertex"
    dtype = np.dtype([(p.name, header.byte_order + p.dtype) for p in vertex.properties])
    rows = reader.array(dtype, vertex.num_rows)
    count, rest = len(rows), _num_rest(vertex)
    channel_major = _columns(rows, _rest_names(rest)).reshape(count, 3, rest // 3)
    gaussians = Gaussians(
        means=_columns(rows, XYZ),
        scales=_columns(rows, SCALE),
        quats=_columns(rows, ROTATION),
        opacities=_columns(rows, OPACITY)[:, 0],
        sh0=_columns(rows, DC)[:, None],
        shN=np.ascontiguousarray(channel_major.transpose(0, 2, 1)),
    )
    _check_finite(path, gaussians)
    return gaussians


def _rest_names(count: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(count))


def _num_rest(vertex: Element) -> int:
    return sum(prop.name.startswith("f_rest_") for prop in vertex.properties)


def _columns(rows: np.ndarray[Any, Any], names: tuple[str, ...]) -> Float32[np.ndarray, "N C"]:
    table = np.empty((len(rows), len(names)), np.float32)
    for i, name in enumerate(names):
        table[:, i] = rows[name]
    return table


def _check(path: Path, byte_order: str, vertex: Element) -> None:
    present = {prop.name for prop in vertex.properties if prop.length_dtype is None}
    rest = _num_rest(vertex)
    wanted = (*XYZ, *DC, *OPACITY, *SCALE, *ROTATION, *_rest_names(rest))
    missing = [name for name in wanted if name not in present]
    if vertex.name != "vertex" or missing:
        there = f"no {', '.join(missing[:5])}"
    elif not byte_order:
        there = "an ascii file"
    elif rest not in REST_COUNTS or vertex.num_rows == 0:
        there = f"{rest} f_rest properties and {vertex.num_rows} vertices"
    elif any(prop.length_dtype is not None for prop in vertex.properties):
        there = "lists among the properties"
    else:
        return
    raise SceneFormatError(
        f"{path} to hold trained Gaussians in 3DGS's layout, binary", found=there,
        fix="Name the point_cloud.ply of a training run, not the seeds or a mesh.",
    )  # fmt: skip


def _check_finite(path: Path, gaussians: Gaussians) -> None:
    # Some trainers write opacity +inf for opaque Gaussians; positions must be finite.
    bad = ~np.isfinite(gaussians.means).all(axis=1)
    if bad.any():
        raise SceneFormatError(
            f"{path} to have finite positions",
            found=f"{np.count_nonzero(bad)} that are not, the first in vertex {np.argmax(bad)}",
            fix="Train again, or remove those Gaussians.",
        )
