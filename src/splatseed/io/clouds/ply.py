"""PLY files of any size: binary rows by offset, ascii lines as they come.

Properties may stand in any order and beside any others. Colours are red/green/blue, diffuse_*,
r/g/b or the ``f_dc`` of trained Gaussians; without them, intensity. Promise: what lies after the
vertices is not read. Files with lists in or before their vertices, which no scanner writes, are
read whole (``io.ply.points``).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.rows import (
    COPY_AGAIN,
    XYZ,
    Columns,
    Painter,
    check_size,
    chunk_of,
    read_rows,
    sample_rows,
)
from splatseed.io.clouds.tables import TextTable
from splatseed.io.files import open_file
from splatseed.io.ply.foreign import refuse_packed
from splatseed.io.ply.header import Element, Header, parse_header
from splatseed.io.ply.points import read_ply
from splatseed.pointcloud import PointCloud

_HEADER_BYTES = 1 << 20


class PlyCloud(CloudFile):
    """A PLY file.

    Raises:
        SceneFormatError: It is not a PLY, has no vertices with x, y, z, or is cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_file(path) as file:
            header = parse_header(path, file.read(_HEADER_BYTES))
        self._vertex = _vertex_of(path, header)
        before = header.elements[: header.elements.index(self._vertex)]
        self.count = self._vertex.num_rows
        self._whole: PointCloud | None = None
        self._table: TextTable | None = None
        columns = Columns.among([each.name for each in self._vertex.properties])
        self.colors = columns.colors
        if any(each.has_lists for each in (*before, self._vertex)):
            self._whole = read_ply(path)
        elif not header.byte_order:
            lines = sum(each.num_rows for each in before if each.properties)
            names = [each.name for each in self._vertex.properties]
            self._table = TextTable(path, names, columns, header.size, lines, self.count)
        else:
            self._open_binary(header, before, columns)

    def _open_binary(self, header: Header, before: tuple[Element, ...], columns: Columns) -> None:
        skipped = sum(_dtype(each, header.byte_order).itemsize * each.num_rows for each in before)
        self._dtype = _dtype(self._vertex, header.byte_order)
        self._offset = header.size + skipped
        check_size(self.path, self._offset + self._vertex.num_rows * self._dtype.itemsize)
        sample = sample_rows(self.path, self._dtype, self._offset, self._vertex.num_rows)
        self._painter = Painter(columns, sample.__getitem__)

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        if self._whole is not None:
            for start in range(0, len(self._whole), size):
                part = self._whole.select(slice(start, start + size))
                yield CloudChunk(
                    part.xyz.astype(np.float64), part.rgb if self.colors != "none" else None
                )
        elif self._table is not None:
            yield from self._table.chunks(size)
        else:
            rows = read_rows(self.path, self._dtype, self._offset, self._vertex.num_rows, size)
            for each in rows:
                yield chunk_of(self._painter, each.__getitem__)


def _vertex_of(path: Path, header: Header) -> Element:
    vertex = next((each for each in header.elements if each.name == "vertex"), None)
    names = [each.name for each in vertex.properties] if vertex else []
    refuse_packed(path, names)
    if vertex is None or not set(XYZ) <= set(names):
        there = (
            f"properties {', '.join(names)[:200] or '(none)'}" if vertex else "no element vertex"
        )
        raise SceneFormatError(f"{path} to have vertices with x, y, z", found=there, fix=COPY_AGAIN)
    return vertex


def _dtype(element: Element, byte_order: str) -> np.dtype[np.void]:
    return np.dtype([(each.name, byte_order + each.dtype) for each in element.properties])
