"""Read point PLY files of any writer; write the layout that every 3DGS loader accepts.

An *element* is a table; a *property* is a column of scalars or of lists (OpenMVS lists the views of
each vertex). Lists and other elements are skipped; elements before the vertices have no lists, as
in practice. Names are read in lower case and without CloudCompare's ``scalar_``. Counts are checked
against the file before memory is allocated.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.errors import SceneFormatError
from splatseed.io.cloud_file import (
    RGB,
    SAMPLE_ROWS,
    SAMPLES,
    XYZ,
    Block,
    CloudFile,
    LineCloud,
    RowCloud,
    check_min_size,
)
from splatseed.io.files import StrPath, check_fits_memory, open_file, translate_read_errors
from splatseed.io.staging import atomic_file
from splatseed.pointcloud import PointCloud
from splatseed.text import beginning

EXPORT_PLY_AGAIN = "Copy the file again, or export it again, if need be with another program."

_TYPES = (
    {"char": "i1", "short": "i2", "int": "i4", "uchar": "u1", "ushort": "u2", "uint": "u4"}
    | {"int8": "i1", "int16": "i2", "int32": "i4", "uint8": "u1", "uint16": "u2", "uint32": "u4"}
    | {"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"}
    | {"int64": "i8", "uint64": "u8"}  # not in the format, but written
)
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^end_header[ \t]*(\r?\n|\Z)", re.MULTILINE)
_COUNT = re.compile("[0-9]{1,19}")
_MAX_HEADER = 1 << 20  # bytes searched for the end of the header
_READ_BYTES = 1 << 24  # at a time, of rows with lists
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
    """A table: NumPy types of its columns by name, and those of the lengths of lists."""

    name: str
    num_rows: int
    types: Mapping[str, str]
    lengths: Mapping[str, str] = {}

    @property
    def has_lists(self) -> bool:
        """Whether any column holds lists."""
        return bool(self.lengths)


_NOTHING = Element("no element", 0, {})


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
                    lengths = {name: _TYPES[kind[1]]} if lists else {}
                    elements[-1] = Element(*last[:2], types, {**last.lengths, **lengths})
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
    names = [each.name for each in header.elements]
    first = names.index("vertex") if "vertex" in names else 0
    before, (vertex, *_) = header.elements[:first], (*header.elements[first:], _NOTHING)
    vertex = _with_known_names(vertex)
    if vertex.name != "vertex" or not set(XYZ) <= vertex.types.keys() - vertex.lengths.keys():
        raise SceneFormatError(
            f"{path} to have vertices with x, y, z",
            found=f"{vertex.name} with {', '.join(vertex.types)[:200] or 'no properties'}",
            fix="Export it again with positions.",
        )
    if any(each.has_lists for each in before):
        raise SceneFormatError(
            f"{path} to begin with vertices",
            found=f"{before[0].name} before them",
            fix="Save it again with a program that writes vertices first, such as CloudCompare.",
        )
    offset = _start(path, header, before)
    if header.byte_order:
        if vertex.has_lists:
            return _ListCloud(path, header, vertex, offset)
        return RowCloud(path, header.dtype(vertex), offset, vertex.num_rows)
    # Keep bytes; wider integer types may hold any range.
    integers = {
        name: np.dtype(kind if kind == "u1" else np.int64)
        for name, kind in vertex.types.items()
        if kind[0] in "iu" and name not in XYZ
    }
    if vertex.has_lists:
        return _ListLines(path, vertex, offset, integers)
    return LineCloud(path, list(vertex.types), offset, vertex.num_rows, types=integers)


def _with_known_names(element: Element) -> Element:
    """Return an element with its names in lower case and without ``scalar_``, if still unique."""
    known = [name.lower().removeprefix("scalar_") for name in element.types]
    new = {
        old: name if known.count(name) == 1 else old
        for old, name in zip(element.types, known, strict=True)
    }
    types = {new[name]: kind for name, kind in element.types.items()}
    lengths = {new[name]: kind for name, kind in element.lengths.items()}
    return Element(element.name, element.num_rows, types, lengths)


def _start(path: Path, header: Header, before: Sequence[Element]) -> int:
    """Return the offset of the rows that follow elements without lists."""
    if header.byte_order:
        return header.size + sum(each.num_rows * header.dtype(each).itemsize for each in before)
    with open_file(path) as file:
        file.seek(header.size)
        for _ in range(sum(each.num_rows for each in before)):
            if not file.readline():
                break
        return file.tell()


class _ListCloud(CloudFile):
    """Binary rows of scalars and lists, which are skipped."""

    def __init__(self, path: Path, header: Header, vertex: Element, offset: int) -> None:
        scalars = [name for name in vertex.types if name not in vertex.lengths]
        super().__init__(path, scalars, vertex.num_rows)
        self._offset, self._is_big = offset, header.byte_order == ">"
        self._num_rows = vertex.num_rows
        # Where each used column is: the run of scalars, between lists, and the place there.
        runs: list[list[int]] = [[0, 0, 0]]  # bytes, then those of the list's length and items
        self._columns: dict[str, tuple[int, int, np.dtype[Any]]] = {}
        for name, kind in vertex.types.items():
            dtype = np.dtype(header.byte_order + kind)
            if name in vertex.lengths:
                runs[-1][1:] = np.dtype(vertex.lengths[name]).itemsize, dtype.itemsize
                runs.append([0, 0, 0])
            else:
                self._columns[name] = len(runs) - 1, runs[-1][0], dtype
                runs[-1][0] += dtype.itemsize
        self._runs = np.array(runs, np.int64)
        least = int(self._runs[:, :2].sum())
        check_min_size(path, offset + vertex.num_rows * least)

    def _sample(self) -> Block:
        """Read the first rows: where others are is known only after those before them."""
        none = {name: np.empty(0, self._columns[name][2]) for name in self.used}
        return next(self._blocks(SAMPLES * SAMPLE_ROWS), none)

    def _blocks(self, size: int) -> Iterator[Block]:
        from splatseed.io._kernels import find_rows  # noqa: PLC0415  (Numba)

        data, end, given = np.empty(0, np.uint8), 0, 0
        with open_file(self.path) as file:
            file.seek(self._offset)
            while given < self._num_rows:
                data = data[end:]
                starts = np.empty((min(size, self._num_rows - given), len(self._runs)), np.int64)
                num, end = find_rows(data, 0, self._runs, self._is_big, starts)
                while num < len(starts):
                    more = file.read(max(_READ_BYTES, len(data)))
                    if not more:
                        check_min_size(self.path, file.tell() + 1)  # raises: a row is cut
                    data = np.concatenate([data, np.frombuffer(more, np.uint8)])
                    added, end = find_rows(data, end, self._runs, self._is_big, starts[num:])
                    num += added
                yield {name: self._column(name, data, starts) for name in self.used}
                given += num

    def _column(self, name: str, data: np.ndarray, starts: np.ndarray) -> np.ndarray:
        run, place, dtype = self._columns[name]
        where = starts[:, run, None] + (place + np.arange(dtype.itemsize))
        return np.ascontiguousarray(data[where]).view(dtype)[:, 0]


class _ListLines(LineCloud):
    """Lines of numbers and lists, which are removed."""

    def __init__(
        self, path: Path, vertex: Element, offset: int, types: Mapping[str, np.dtype[Any]]
    ) -> None:
        self._are_lists = [name in vertex.lengths for name in vertex.types]
        scalars = [name for name in vertex.types if name not in vertex.lengths]
        super().__init__(path, scalars, offset, vertex.num_rows, types=types)

    def _block(self, lines: Sequence[str], num_before: int) -> Block:
        return super()._block([self._without_lists(line) for line in lines], num_before)

    def _without_lists(self, line: str) -> str:
        fields, kept, at = line.split(), list[str](), 0
        for is_list in self._are_lists:
            if at >= len(fields) or (is_list and not _COUNT.fullmatch(fields[at])):
                return f"? {line}"  # reported as no row of numbers
            if is_list:
                at += int(fields[at])
            else:
                kept.append(fields[at])
            at += 1
        return " ".join(kept)


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
