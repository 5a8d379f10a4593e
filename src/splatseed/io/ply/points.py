"""Point clouds in PLY files: reads any with x, y, z; writes the form that every 3DGS loader takes.

Notation: ``columns`` maps a vertex property to its values [N] in its own type; SH0 is the constant
of the spherical harmonic of degree 0. Promise: ascii and both binary forms give the same cloud;
counts are checked against the file before anything is allocated; rows are never looped over in
Python, save to skip lists of varying length that lie before the vertices. What follows the vertices
is not read. ``write_ply`` writes straight to ``path`` and lets ``OSError`` pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.binary import ByteReader
from splatseed.io.ply.foreign import refuse_packed
from splatseed.io.ply.header import EXPORT_PLY_AGAIN, Element, Header, parse_header
from splatseed.pointcloud import PointCloud

_XYZ = ("x", "y", "z")
_RGB_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_SH_NAMES = ("f_dc_0", "f_dc_1", "f_dc_2")
_WANTED = {*_XYZ, *_SH_NAMES, *(name for names in _RGB_NAMES for name in names)}
_SH0 = 0.28209479177387814  # 1 / (2 sqrt(pi)); colour = 0.5 + SH0 * f_dc in 3DGS
_GREY = 128

_DROP_IN = np.dtype(
    [(name, "<f4") for name in (*_XYZ, "nx", "ny", "nz")]
    + [(name, "u1") for name in ("red", "green", "blue")]
)


def read_ply(path: Path) -> PointCloud:
    """The vertices of a PLY file as a cloud.

    Colours are taken from red/green/blue, diffuse_* or r/g/b: bytes, 16-bit integers, or floats
    from 0 to 1 or to 255; else from ``f_dc_0..2`` of trained Gaussians; else they are mid grey, as
    are colours that are not a number. Coordinates may be NaN or infinite; nothing is repaired.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable, malformed or shorter than its header promises, has no
            vertices with x, y, z, or has colours out of range.
    """
    reader = ByteReader(path, EXPORT_PLY_AGAIN)
    header = parse_header(path, reader.data)
    vertex = _vertex_element(path, header)
    reader.offset = header.size
    read_columns = _binary_columns if header.byte_order else _ascii_columns
    columns = read_columns(reader, header, vertex)
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        xyz = np.stack([columns[name].astype(np.float32) for name in _XYZ], axis=1)
    return PointCloud(xyz, _colors(reader, columns, len(xyz)))


def write_ply(path: Path, points: PointCloud) -> None:
    """Write the PLY that every 3DGS loader takes.

    Binary little-endian; float32 x, y, z and zero normals, uchar red, green, blue; nothing else.

    Raises:
        OSError: The file cannot be written.
    """
    with path.open("wb") as file:
        file.write(ply_header(len(points)))
        file.write(ply_rows(points.xyz, points.rgb))


def ply_header(count: int) -> bytes:
    """The header of a PLY as ``write_ply`` writes it, of ``count`` points."""
    kinds = {"f": "float", "u": "uchar"}
    properties = "".join(
        f"property {kinds[_DROP_IN[name].kind]} {name}\n" for name in _DROP_IN.names or ()
    )
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    return f"{header}end_header\n".encode("ascii")


def ply_rows(xyz: Float32[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"]) -> memoryview:
    """The body of such a PLY: some of its points."""
    rows = np.zeros(len(xyz), _DROP_IN)
    for i, name in enumerate(_XYZ):
        rows[name] = xyz[:, i]
    for i, name in enumerate(("red", "green", "blue")):
        rows[name] = rgb[:, i]
    return rows.view(np.uint8).data


def _vertex_element(path: Path, header: Header) -> Element:
    vertex = next((element for element in header.elements if element.name == "vertex"), None)
    refuse_packed(path, [prop.name for prop in vertex.properties] if vertex else ())
    if vertex is None or not _wanted_dtypes(vertex).keys() >= set(_XYZ):
        names = ", ".join(prop.name for prop in vertex.properties) if vertex else ""
        there = f"properties {names[:200] or '(none)'}" if vertex else "no element vertex"
        raise SceneFormatError(
            f"{path} to have vertices with scalar x, y, z", found=there, fix=EXPORT_PLY_AGAIN
        )
    return vertex


def _wanted_dtypes(vertex: Element) -> dict[str, str]:
    """The scalar properties that make a cloud, with their types."""
    return {
        prop.name: prop.dtype
        for prop in vertex.properties
        if prop.name in _WANTED and prop.length_dtype is None
    }


def _binary_columns(reader: ByteReader, header: Header, vertex: Element) -> dict[str, np.ndarray]:
    for element in header.elements[: header.elements.index(vertex)]:
        reader.record = f"element {element.name}"
        _skip_rows(reader, element, header.byte_order)
    reader.record = "element vertex"
    if not vertex.num_rows:
        return {name: np.empty(0, dtype) for name, dtype in _wanted_dtypes(vertex).items()}
    rows = _equal_rows(reader, vertex, header.byte_order)
    if rows is None:
        raise reader.error("vertex lists of one length", "different lengths, or a file cut short")
    return {name: rows[name].astype(dtype) for name, dtype in _wanted_dtypes(vertex).items()}


def _skip_rows(reader: ByteReader, element: Element, byte_order: str) -> None:
    if not element.num_rows or not element.properties:
        return
    if _equal_rows(reader, element, byte_order) is not None:
        return
    for _ in range(element.num_rows):
        reader.array(_row_dtype(reader, element, byte_order), 1)


def _equal_rows(reader: ByteReader, element: Element, byte_order: str) -> np.ndarray | None:
    """All rows of an element if its lists have the lengths of its first row's, else None."""
    dtype = _row_dtype(reader, element, byte_order)
    if element.has_lists and element.num_rows * dtype.itemsize > reader.remaining:
        return None
    start = reader.offset
    rows = reader.array(dtype, element.num_rows)
    lengths = [p.name for p in element.properties if p.length_dtype is not None]
    if all((rows[_length_of(name)] == rows[_length_of(name)][0]).all() for name in lengths):
        return rows
    reader.offset = start
    return None


def _row_dtype(reader: ByteReader, element: Element, byte_order: str) -> np.dtype[Any]:
    """The layout of the row at the reader's position, which does not move."""
    start = reader.offset
    fields: list[tuple[Any, ...]] = []
    for prop in element.properties:
        item = np.dtype(byte_order + prop.dtype)
        if prop.length_dtype is None:
            reader.array(item, 1)
            fields.append((prop.name, item))
            continue
        counter = np.dtype(byte_order + prop.length_dtype)
        length = int(reader.array(counter, 1)[0])
        if length < 0:
            raise reader.error("a list length of 0 or more", str(length))
        reader.array(item, length)
        fields += [(_length_of(prop.name), counter), (prop.name, item, (length,))]
    reader.offset = start
    return np.dtype(fields)


def _length_of(name: str) -> str:
    return f" {name}"  # no property's name has a space in it


def _ascii_columns(reader: ByteReader, header: Header, vertex: Element) -> dict[str, np.ndarray]:
    reader.record = "ascii body"
    body = reader.data[reader.offset :].decode("latin-1")
    lines = [stripped for line in body.split("\n") if (stripped := line.strip())]
    start = sum(
        e.num_rows for e in header.elements[: header.elements.index(vertex)] if e.properties
    )
    rows = lines[start : start + vertex.num_rows]
    if len(rows) < vertex.num_rows:
        raise reader.error(f"{vertex.num_rows} lines of vertices", str(len(rows)))
    places, lengths = _ascii_places(reader, vertex, rows[0].split() if rows else [])
    table = _ascii_table(reader, rows, [*places.values(), *lengths])
    if any((table[:, len(places) + i] != n).any() for i, n in enumerate(lengths.values())):
        raise reader.error("vertex lists of one length", "different lengths")
    dtypes = _wanted_dtypes(vertex)
    return {
        name: _as_declared(reader, name, table[:, i], np.dtype(dtypes[name]))
        for i, name in enumerate(places)
    }


def _ascii_places(
    reader: ByteReader, vertex: Element, first_row: list[str]
) -> tuple[dict[str, int], dict[int, int]]:
    """Where the wanted properties stand in a line, and which list lengths stand where.

    Lists are taken to be as long as in the first row.
    """
    places: dict[str, int] = {}
    lengths: dict[int, int] = {}
    wanted = _wanted_dtypes(vertex)
    at = 0
    for prop in vertex.properties:
        if len(places) == len(wanted):  # lists after the last wanted property may vary
            break
        if prop.length_dtype is None:
            if prop.name in wanted:
                places[prop.name] = at
            at += 1
        elif first_row:
            lengths[at] = _ascii_length(reader, prop.name, first_row[at : at + 1])
            at += 1 + lengths[at]
    return places, lengths


def _ascii_length(reader: ByteReader, name: str, field: list[str]) -> int:
    if field and field[0].isascii() and field[0].isdigit() and len(field[0]) < 10:
        return int(field[0])
    raise reader.error(f"the length of list {name} in the first row", repr(" ".join(field)))


def _ascii_table(reader: ByteReader, rows: list[str], places: list[int]) -> np.ndarray:
    if not rows:
        return np.empty((0, len(places)))
    try:
        return np.loadtxt(rows, np.float64, comments=None, usecols=places, ndmin=2)
    except ValueError as error:  # NumPy's message names the row and the column
        raise reader.error("a number for each vertex property", str(error)) from None


def _as_declared(
    reader: ByteReader, name: str, values: np.ndarray, dtype: np.dtype[Any]
) -> np.ndarray:
    """An ascii column in the type that the header gives it."""
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        fits = (values >= info.min) & (values <= info.max) & (values == np.rint(values))
        if not fits.all():
            wrong = f"{values[fits.argmin()]} in row {fits.argmin() + 1}"
            raise reader.error(f"{name} as integers from {info.min} to {info.max}", wrong)
    with np.errstate(over="ignore"):
        return np.asarray(values.astype(dtype))


def _colors(
    reader: ByteReader, columns: Mapping[str, np.ndarray], count: int
) -> UInt8[np.ndarray, "N 3"]:
    names = next((names for names in _RGB_NAMES if columns.keys() >= set(names)), None)
    if names is not None:
        reader.record = f"properties {', '.join(names)}"
        return _to_bytes(reader, np.stack([columns[name] for name in names], axis=1))
    if columns.keys() >= set(_SH_NAMES):
        sh0 = np.stack([columns[name].astype(np.float64) for name in _SH_NAMES], axis=1)
        rgb = np.clip(0.5 + _SH0 * np.nan_to_num(sh0), 0.0, 1.0)
        return np.asarray(np.rint(255.0 * rgb).astype(np.uint8))
    return np.full((count, 3), _GREY, np.uint8)


def _to_bytes(reader: ByteReader, values: Shaped[np.ndarray, "N 3"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours of any numeric type as bytes; the largest tells whether 1, 255 or 65535 is full."""
    if values.dtype == np.uint8 or not values.size:
        return values.astype(np.uint8)
    known = np.where(np.isnan(values), np.nan, values.astype(np.float64))
    low, high = np.nanmin(known, initial=0.0), np.nanmax(known, initial=0.0)
    full = 255.0
    if values.dtype.kind == "f" and high <= 1.0:
        full = 1.0
    elif values.dtype == np.uint16 and high > full:
        full = 65535.0
    if low < 0.0 or high > full:
        raise reader.error(f"colours from 0 to {full:g}", f"values from {low:g} to {high:g}")
    return np.asarray(np.rint(np.nan_to_num(known * (255.0 / full), nan=_GREY)).astype(np.uint8))
