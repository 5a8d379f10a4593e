"""Read and write Gaussians in .ply files: 3DGS's layout, and its variants by other trainers.

``encode_layout`` has the layout. Properties are found by name, in any order and type, and with the
prefixes of CloudCompare; unknown ones are reported or refused (``parameters``). 3DGS's layout
survives writing and reading bit for bit.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32
from numpy.lib.recfunctions import structured_to_unstructured

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import ByteReader, translate_errors
from splatseed.io.ply import EXPORT_PLY_AGAIN, Element, Header, parse_header
from splatseed.progress import Note, silent_note
from splatseed.splat.gaussians import (
    DC,
    ROTATION,
    SCALES,
    SH_C0,
    SH_COUNTS,
    XYZ,
    Gaussians,
    encode_layout,
    is_antialiased,
    rest_names,
)
from splatseed.splat.parameters import check_parameters, in_standard_units

_COLORS = ("red", "green", "blue")
_NORMALS = ("nx", "ny", "nz")
_FILTER = "filter_3D"
_SCALAR_FIELD = "scalar_"
"""CloudCompare writes it before the names of all but positions, normals and colours."""
FLATNESS = 1e-3
"""Thickness of a flat Gaussian, relative to its smaller size: far below a pixel."""
_UNUSED = (24, 35)  # coefficients beyond the first of degrees 4 and 5
_MAX_UNIT_COLOR = 2.0  # float colours above it range to 255, not to 1
_LIST = re.compile(rb"^property[ \t]+list[ \t]+\S+[ \t]+\S+[ \t]+(\S+)", re.MULTILINE)


def encode(gaussians: Gaussians, _: Note = silent_note) -> list[bytes | memoryview]:
    """Encode Gaussians as 3DGS does."""
    return encode_layout(gaussians.arrays(), gaussians.antialiased)


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode the .ply of any trainer."""
    reader = ByteReader(path, EXPORT_PLY_AGAIN)
    header = _without_prefixes(parse_header(path, reader.data))
    names = {name for element in _up_to_vertices(header)[-1:] for name in element.types}
    if names:
        check_parameters(path, names, _known(names), note)
    _check(path, header, names, reader.data)
    rows = _rows(reader, header)
    arrays: dict[str, Any] = {
        "means": _columns(rows, XYZ),
        "opacities": _columns(rows, ["opacity"])[:, 0],
        "sh0": _first_colors(rows, names)[:, None],
        "shN": _harmonics(rows, names, note),
    }
    scales = _columns(rows, [name for name in SCALES if name in names])
    scales, arrays["opacities"] = in_standard_units(
        path, arrays["means"], scales, arrays["opacities"], note
    )
    arrays["scales"], arrays["quats"] = _shape(rows, scales, note)
    if _FILTER in names:
        sizes = _columns(rows, [_FILTER])[:, 0]
        arrays["scales"], arrays["opacities"] = filtered(
            arrays["scales"], arrays["opacities"], sizes
        )
        note(
            Finding(
                "other-renderer",
                f"{path} has filter_3D (Mip-Splatting and related methods), which was applied to "
                "sizes and opacities. Their renderers also blur less than 3DGS's and splatseed's, "
                "so scores may differ.",
                subjects=(str(path),),
            )
        )
    return Gaussians(**arrays, antialiased=is_antialiased(reader.data[: header.size]))


def filtered(
    scales: Float32[np.ndarray, "N 3"], opacities: Float32[np.ndarray, " N"], size: np.ndarray
) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, " N"]]:
    """Apply Mip-Splatting's 3D smoothing filter (Yu et al., 2024) to log-scales and logits.

    Convolution with a Gaussian of size f that preserves the integral: sizes become s_i' =
    sqrt(s_i^2 + f^2), and the opacity is multiplied by sqrt(det / det'), the product of s_i / s_i'.
    """
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        logs, others = scales.astype(np.float64), np.log(np.abs(size.astype(np.float64)))
        wide = np.logaddexp(2 * logs, 2 * others[:, None]) / 2
        logits = opacities.astype(np.float64)
        # log opacity = -log(1 + exp(-x)), and back x = log o - log(1 - o)
        log_opacity = -np.logaddexp(0, -logits) + (logs - wide).sum(axis=1)
        thinned = log_opacity - np.log(-np.expm1(log_opacity))
    unchanged = size == 0
    return (
        np.where(unchanged[:, None], scales, wide).astype(np.float32),
        np.where(unchanged, opacities, thinned).astype(np.float32),
    )


def _check(path: Path, header: Header, names: set[str], data: bytes) -> None:
    """Raise unless the file has Gaussians that need nothing else to be rendered."""
    rest = sum(name.startswith("f_rest_") for name in names)
    needed = [*XYZ, *(() if set(_COLORS) <= names else DC), *rest_names(rest), "opacity"]
    needed += ["scale_0", *(ROTATION if "scale_1" in names else ())]
    missing = [name for name in needed if name not in names]
    before = _up_to_vertices(header)
    count = before[-1].num_rows if before else 0
    found, fix = "", "Name the point_cloud.ply of a training run, not the seeds or a mesh."
    if missing:
        found = f"no {', '.join(missing[:5])}"
    elif any(element.has_lists for element in before):
        found = f"the list property {b', '.join(_LIST.findall(data, 0, header.size)).decode()}"
        fix = "Export it again without the list."
    elif rest not in {3 * k for k in (*SH_COUNTS, *_UNUSED)} or not count:
        found = f"{rest} f_rest properties and {count} vertices"
    if found:
        raise SceneFormatError(
            f"{path} to hold trained Gaussians in 3DGS's layout", found=found, fix=fix
        )


def _known(names: set[str]) -> Iterator[str]:
    """Yield the properties that are read, and those that neither colour nor shape depends on."""
    yield from (*XYZ, *_NORMALS, *DC, *_COLORS, "alpha", "opacity", *SCALES, *ROTATION, _FILTER)
    yield from rest_names(sum(name.startswith("f_rest_") for name in names))


def _without_prefixes(header: Header) -> Header:
    """Remove CloudCompare's prefixes, which it repeats each time that it writes a file."""
    elements = []
    for element in header.elements:
        own = dict.fromkeys(_own_name(name) for name in element.types)
        if len(own) == len(element.types):
            types = dict(zip(own, element.types.values(), strict=True))
            element = element._replace(types=types)  # noqa: PLW2901  (the same, with other names)
        elements.append(element)
    return header._replace(elements=tuple(elements))


def _own_name(name: str) -> str:
    while name.startswith(_SCALAR_FIELD):
        name = name.removeprefix(_SCALAR_FIELD)
    return name


def _up_to_vertices(header: Header) -> list[Element]:
    names = [element.name for element in header.elements]
    last = names.index("vertex") if "vertex" in names else len(names)
    return list(header.elements[: last + 1])


def _rows(reader: ByteReader, header: Header) -> np.ndarray:
    reader.offset = header.size
    *others, vertex = _up_to_vertices(header)
    if not header.byte_order:
        return _ascii_rows(reader, sum(element.num_rows for element in others), vertex)
    for element in others:
        reader.record = f"element {element.name}"
        reader.array(header.dtype(element), element.num_rows)
    reader.record = "element vertex"
    return reader.array(header.dtype(vertex), vertex.num_rows)


def _ascii_rows(reader: ByteReader, skipped: int, element: Element) -> np.ndarray:
    """Read the vertices of an ascii file, after ``skipped`` lines of other elements."""
    # Numbers but bytes become float64, whatever the declaration: exact for a float32 as text.
    dtype = np.dtype([(n, kind if kind == "u1" else "f8") for n, kind in element.types.items()])
    with translate_errors(reader.path, "rows of numbers after its header", fix=EXPORT_PLY_AGAIN):
        text = reader.data[reader.offset :].replace(b"nan(ind)", b"nan")  # as Windows writes it
        table = np.loadtxt(
            io.BytesIO(text),
            comments=None, skiprows=skipped, max_rows=element.num_rows, ndmin=2,
        )  # fmt: skip
        if table.shape != (element.num_rows, len(element.types)):
            raise ValueError(
                f"{len(table)} rows of {table.shape[1]} numbers, of "
                f"{element.num_rows} of {len(element.types)}"
            )
        rows = np.empty(len(table), dtype)
        for i, name in enumerate(element.types):
            rows[name] = table[:, i]
    return rows


def _columns(rows: np.ndarray, names: Sequence[str]) -> Float32[np.ndarray, "N K"]:
    """Return properties as float32; numbers beyond its range become infinite."""
    with np.errstate(over="ignore"):
        return np.array(structured_to_unstructured(rows[list(names)]), np.float32, order="C")


def _first_colors(rows: np.ndarray, names: set[str]) -> Float32[np.ndarray, "N 3"]:
    """Return f_dc_*, if necessary from red, green and blue (integers, or floats to 1 or 255)."""
    if set(DC) <= names:
        return _columns(rows, DC)
    kinds = [rows.dtype[name] for name in _COLORS]
    colors = _columns(rows, _COLORS).astype(np.float64)
    maximum = 255.0
    if all(kind.kind in "iu" for kind in kinds):
        maximum = float(np.iinfo(kinds[0]).max)
    elif (colors[np.isfinite(colors)] <= _MAX_UNIT_COLOR).all():
        maximum = 1.0
    return ((colors / maximum - 0.5) / SH_C0).astype(np.float32)


def _harmonics(rows: np.ndarray, names: set[str], note: Note) -> Float32[np.ndarray, "N K 3"]:
    """Return coefficients beyond the first, up to degree 3."""
    rest = sum(name.startswith("f_rest_") for name in names)
    if not rest:
        return np.zeros((len(rows), 0, 3), np.float32)
    count, limit = rest // 3, SH_COUNTS[-1]
    if count > limit:
        text = (
            f"Of {count} coefficients beyond the first, only the {limit} up to degree 3 are used."
        )
        note(Finding("unused-harmonics", text))
    every = rest_names(rest)
    used = [name for color in range(3) for name in every[color * count :][: min(count, limit)]]
    planes = _columns(rows, used).reshape(len(rows), 3, -1)
    return np.array(planes.transpose(0, 2, 1), np.float32, order="C")


def _shape(
    rows: np.ndarray, scales: Float32[np.ndarray, "N S"], note: Note
) -> tuple[Float32[np.ndarray, "N 3"], Float32[np.ndarray, "N 4"]]:
    """Return log-scales and rotations: spheres for one size, discs for two (as of 2DGS)."""
    if scales.shape[1] == 1:
        text = "Gaussians have one size, scale_0: they are read as spheres."
        note(Finding("spheres-or-discs", text, "info"))
        quats = np.tile(np.array([1, 0, 0, 0], np.float32), (len(rows), 1))
        return np.repeat(scales, 3, axis=1), quats
    if scales.shape[1] == 2:
        note(
            Finding(
                "spheres-or-discs",
                "Gaussians have two sizes, as of 2D Gaussian Splatting: they are read as discs. "
                "Its renderer intersects rays with discs, so scores may differ.",
            )
        )
        thin = scales.min(axis=1, keepdims=True) + np.float32(np.log(FLATNESS))
        scales = np.concatenate([scales, thin], axis=1)
    return scales, _columns(rows, ROTATION)
