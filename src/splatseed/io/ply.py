"""PLY files: reading points of any writer, and the form of them that every 3DGS loader takes.

An *element* is a table of rows; a *property* is a column, a scalar or a list with its length in
front. Files with lists in their vertices, or another element before them, are refused: nobody
writes them. Counts are checked against the file before anything is allocated; what follows the
vertices is not read.
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
_MAX_HEADER = 1 << 20  # a longer search would only crawl through a body
_GREY = 128
_DROP_IN = np.dtype(
    [(name, "<f4") for name in (*XYZ, "nx", "ny", "nz")] + [(name, "u1") for name in RGB]
)
_MODELS = {
    ".spz": "Gaussians compressed by Niantic's spz",
    ".splat": "Gaussians in the .splat format of web viewers, 32 bytes each",
    ".ksplat": "Gaussians in the .ksplat format of GaussianSplats3D",
    ".sog": "Gaussians compressed as PlayCanvas's SOG",
}


class Element(NamedTuple):
    """One table of a file: NumPy's types of its columns by name, and whether one is of lists."""

    name: str
    num_rows: int
    types: Mapping[str, str]
    has_lists: bool = False


class Header(NamedTuple):
    """What a PLY file promises to hold."""

    byte_order: str
    """NumPy's character for it; empty for an ascii body."""
    elements: tuple[Element, ...]
    size: int
    """Length of the header in bytes: the offset of the body."""

    def dtype(self, element: Element) -> np.dtype[Any]:
        """The layout of a row of scalars."""
        return np.dtype([(name, self.byte_order + kind) for name, kind in element.types.items()])


def parse_header(path: Path, data: bytes) -> Header:
    """The header in a file's first bytes: known types, unique names, counts of zero or more."""
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
    """Open a PLY file of points, of any size."""
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
    # Bytes stay so; what is declared wider may hold any range.
    whole = {
        n: dtype[n] if dtype[n] == np.uint8 else np.dtype(np.int64)
        for n in names
        if dtype[n].kind in "iu" and n not in XYZ
    }
    return LineCloud(path, names, header.size, vertex.num_rows, types=whole)


def read_ply(path: StrPath) -> PointCloud:
    """The vertices of a PLY file as a cloud; nothing is repaired.

    Colours that are not a number are mid grey, and so are all without colours.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is malformed, shorter than its header promises or larger than the free
            memory, or has no vertices with x, y, z.
    """
    return read_ply_float64(path)[0]


def read_ply_float64(path: StrPath) -> tuple[PointCloud, Float64[np.ndarray, "N 3"]]:
    """As ``read_ply``, and the positions in double precision."""
    path = Path(path)
    with translate_read_errors(path):
        cloud = open_ply(path)
        check_fits_memory(path, path.stat().st_size)
        whole = cloud.read_all()
    with np.errstate(over="ignore"):  # beyond float32 is infinite, to be seen and dropped
        xyz = whole.xyz.astype(np.float32)
    rgb = np.full(xyz.shape, _GREY, np.uint8) if whole.rgb is None else whole.rgb
    return PointCloud(xyz, rgb), whole.xyz


def write_ply(path: StrPath, points: PointCloud) -> None:
    """Write binary float32 x, y, z and zero normals, uchar red, green, blue; nothing else."""
    path = Path(path)
    with path.open("wb") as file:
        file.write(ply_header(len(points)))
        file.write(ply_rows(points.xyz, points.rgb))


def write_ply_file(path: StrPath, points: PointCloud) -> None:
    """As ``write_ply``, but the file appears whole or not at all (``OutputError``)."""
    with atomic_file(Path(path)) as partial:
        write_ply(partial, points)


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
    for i, (axis, channel) in enumerate(zip(XYZ, RGB, strict=True)):
        rows[axis], rows[channel] = xyz[:, i], rgb[:, i]
    return rows.view(np.uint8).data


def refuse_gaussians(path: Path, packed: str = "") -> None:
    """Raise a ``SceneFormatError`` for trained Gaussians, by the file's name or as ``packed``."""
    kind = packed or _MODELS.get(path.suffix.lower())
    if kind and path.is_file():
        raise SceneFormatError(
            f"{path} to be a scene, or a .ply of points",
            found=f"{kind}: a trained model",
            fix="Score it with splatseed evaluate MODEL --scene SCENE, look at it with splatseed "
            "view MODEL; a .ply, which splatseed export MODEL -o OUT.ply makes, is read as points.",
        )
