"""Read point PLY files of any writer; write the layout that every 3DGS loader accepts.

An *element* is a table; a *property* is a column of scalars or of lists. The vertices must be the
first element and have no lists, as in practice. Counts are checked against the file before memory
is allocated; elements after the vertices are ignored.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.cloud_file import RGB, XYZ, CloudFile, LineCloud, RowCloud
from splatseed.io.files import StrPath, check_fits_memory, open_file, translate_read_errors
from splatseed.io.staging import atomic_file
from splatseed.pointcloud import PointCloud
from splatseed.text import beginning

EXPORT_PLY_AGAIN = "Copy the file again, or export it again as a binary little-endian PLY."

_TYPES = (
    {"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"}
    | {"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"}
    | {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
)
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^end_header[ \t]*(\r?\n|\Z)", re.MULTILINE)
_COUNT = re.compile("[0-9]{1,19}")
_MAX_HEADER = 1 << 20  # bytes searched for the end of the header
_GREY = 128
_ROW = np.dtype(
    [(name, "<f4") for name in (*XYZ, "nx", "ny", "nz")] + [(name, "u1") for name in RGB]
)
_MODELS = {
    ".spz": "Gaussians compressed by Niantic's spz",
    ".splat": "Gaussians in the .splat format of web viewers, 32 bytes each",
    ".ksplat": "Gaussians in the .ksplat format of GaussianSplats3D",
    ".sog": "Gaussians compressed as PlayCanvas's SOG",
}


class Element(NamedTuple):
    """A table: NumPy types of its columns by name, and whether any holds lists."""

    name: str
    num_rows: int
    types: Mapping[str, str]
    has_lists: bool = False


class Header(NamedTuple):
    """The parsed header of a PLY file."""

    byte_order: str
    """NumPy's character; empty for ascii."""
    elements: tuple[Element, ...]
    size: int
    """Bytes of the header, the offset of the body."""

    def dtype(self, element: Element) -> np.dtype[Any]:
        """Return the dtype of a row of scalars."""
        return np.dtype([(name, self.byte_order + kind) for name, kind in element.types.items()])


def parse_header(path: Path, data: bytes) -> Header:
    """Parse the header in a file's first bytes; raise ``SceneFormatError`` if malformed."""
    end = _END.search(data, 0, _MAX_HEADER)
    if not re.match(rb"ply[ \t]*\r?\n", data) or end is None:
        raise SceneFormatError(
            f"{path} to be a PLY file: a line 'ply', a header, a line 'end_header'",
            found=beginning(data, 20),
            fix=EXPORT_PLY_AGAIN,
        )
    byte_order: str | None = None
    elements: list[Element] = []
    # Comments may be in any encoding.
    for number, line in enumerate(data[: end.start()].decode("latin-1").split("\n")[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", form, "1.0"] if form in _BYTE_ORDERS and byte_order is None:
                byte_order = _BYTE_ORDERS[form]
                continue
            case ["element", name, count] if byte_order is not None and _COUNT.fullmatch(count):
                elements.append(Element(name, int(count), {}))
                continue
            case ["property", *kind, of, name] if elements and of in _TYPES:
                last = elements[-1]
                lists = kind[:1] == ["list"] and _TYPES.get(kind[-1], "f")[0] in "iu"
                if name not in last.types and (not kind or (lists and len(kind) == 2)):
                    types = {**last.types, name: _TYPES[of]}
                    elements[-1] = Element(*last[:2], types, last.has_lists or lists)
                    continue
        raise SceneFormatError(
            f"a format, an element or one of its properties in the header of {path}, line {number}",
            found=repr(line.strip()[:80]),
            fix=EXPORT_PLY_AGAIN,
        )
    if byte_order is None:
        raise SceneFormatError(f"a format in {path}", found="none", fix=EXPORT_PLY_AGAIN)
    return Header(byte_order, tuple(elements), end.end())


def open_ply(path: Path) -> CloudFile:
    """Open a PLY file of points."""
    with open_file(path) as file:
        header = parse_header(path, file.read(_MAX_HEADER))
    if any("packed_position" in each.types for each in header.elements):
        refuse_gaussians(path, "Gaussians compressed as PlayCanvas's .compressed.ply")
    vertex = header.elements[0] if header.elements else Element("no element", 0, {})
    names = list(vertex.types)
    if vertex.name != "vertex" or not set(XYZ) <= set(names) or vertex.has_lists:
        raise SceneFormatError(
            f"{path} to begin with vertices that have x, y, z and no lists",
            found=f"{vertex.name} with {', '.join(names)[:200] or 'no properties'}",
            fix=EXPORT_PLY_AGAIN,
        )
    dtype = header.dtype(vertex)
    if header.byte_order:
        return RowCloud(path, dtype, header.size, vertex.num_rows)
    # Keep bytes; wider integer types may hold any range.
    integers = {
        n: dtype[n] if dtype[n] == np.uint8 else np.dtype(np.int64)
        for n in names
        if dtype[n].kind in "iu" and n not in XYZ
    }
    return LineCloud(path, names, header.size, vertex.num_rows, types=integers)


def read_ply(path: StrPath) -> PointCloud:
    """Read the vertices of a PLY file; nothing is repaired.

    Missing or NaN colours become mid grey.

    Raises:
        SceneNotFoundError: No such file.
        SceneFormatError: Malformed, truncated, larger than free memory, or without x, y, z.
    """
    return read_ply_float64(path)[0]


def read_ply_float64(path: StrPath) -> tuple[PointCloud, Float64[np.ndarray, "N 3"]]:
    """Read a PLY file as ``read_ply`` does, and its positions in float64."""
    path = Path(path)
    with translate_read_errors(path):
        cloud = open_ply(path)
        check_fits_memory(path, path.stat().st_size)
        chunk = cloud.read_all()
    with np.errstate(over="ignore"):  # beyond float32's range: infinite, dropped later
        xyz = chunk.xyz.astype(np.float32)
    rgb = np.full(xyz.shape, _GREY, np.uint8) if chunk.rgb is None else chunk.rgb
    return PointCloud(xyz, rgb), chunk.xyz


def write_ply(path: StrPath, points: PointCloud) -> None:
    """Write a binary PLY: float32 x, y, z and zero normals, uchar red, green, blue."""
    path = Path(path)
    with path.open("wb") as file:
        file.write(ply_header(len(points)))
        file.write(ply_rows(points.xyz, points.rgb))


def write_ply_file(path: StrPath, points: PointCloud) -> None:
    """As ``write_ply``, but the file appears whole or not at all (``OutputError``)."""
    with atomic_file(Path(path)) as partial:
        write_ply(partial, points)


def ply_header(count: int) -> bytes:
    """Return the header that ``write_ply`` writes for ``count`` points."""
    kinds = {"f": "float", "u": "uchar"}
    properties = "".join(f"property {kinds[_ROW[name].kind]} {name}\n" for name in _ROW.names or ())
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {count}\n{properties}"
    return f"{header}end_header\n".encode("ascii")


def ply_rows(xyz: Float32[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"]) -> memoryview:
    """Return the rows that ``write_ply`` writes."""
    rows = np.zeros(len(xyz), _ROW)
    for i, (axis, channel) in enumerate(zip(XYZ, RGB, strict=True)):
        rows[axis], rows[channel] = xyz[:, i], rgb[:, i]
    return rows.view(np.uint8).data


def refuse_gaussians(path: Path, packed: str = "") -> None:
    """Raise ``SceneFormatError`` for a file of Gaussians, by suffix or as ``packed`` describes."""
    kind = packed or _MODELS.get(path.suffix.lower())
    if kind and path.is_file():
        raise SceneFormatError(
            f"{path} to be a scene, or a .ply of points",
            found=f"{kind}: a trained model",
            fix="Score it with splatseed evaluate MODEL --scene SCENE, view it with splatseed view "
            "MODEL, or make a .ply of it with splatseed export MODEL -o OUT.ply.",
        )
