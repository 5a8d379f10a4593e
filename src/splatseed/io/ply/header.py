"""The header of a PLY file: which elements it holds and how their rows are laid out.

Notation: an element is a table of rows; a property is a column, a scalar or a list with
its length in front. Types are NumPy codes without byte order ("f4"). Promise: a returned header
has known types, unique property names and counts of zero or more; the reader of the body must
check that the file holds that many rows.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from splatseed.errors import SceneFormatError
from splatseed.literal import beginning

EXPORT_PLY_AGAIN = "Copy the file again, or export it again as a binary little-endian PLY."

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_END = re.compile(rb"^end_header[ \t]*(\r?\n|\Z)", re.MULTILINE)
_MAX_HEADER = 1 << 20  # a longer search would only crawl through a body


class Property(NamedTuple):
    """One column of an element."""

    name: str
    dtype: str
    length_dtype: str | None
    """The type of a list's length; None for a scalar."""


class Element(NamedTuple):
    """One table of the file."""

    name: str
    num_rows: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether its rows may differ in length."""
        return any(prop.length_dtype is not None for prop in self.properties)


class Header(NamedTuple):
    """What a PLY file promises to hold."""

    byte_order: str
    """NumPy's byte-order character; empty for an ascii body."""
    elements: tuple[Element, ...]
    size: int
    """Length of the header in bytes: the offset of the body."""


def parse_header(path: Path, data: bytes) -> Header:
    """The header at the start of a PLY file.

    Args:
        path: The file, for errors.
        data: Its bytes.

    Raises:
        SceneFormatError: It is not a PLY header, or one of its lines makes no sense.
    """
    end = _END.search(data, 0, _MAX_HEADER)
    if not re.match(rb"ply[ \t]*\r?\n", data) or end is None:
        raise SceneFormatError(
            f"{path} to be a PLY file: a line 'ply', a header, a line 'end_header'",
            found=beginning(data, 20),
            fix=EXPORT_PLY_AGAIN,
        )
    lines = _lines(path, data[: end.start()])
    byte_order = _parse_format(path, lines)
    return Header(byte_order, tuple(_parse_elements(lines)), end.end())


class _Line(NamedTuple):
    """A header line, with its place for errors."""

    path: Path
    number: int
    words: list[str]

    def error(self, expected: str) -> SceneFormatError:
        where = f"the header of {self.path}, line {self.number}"
        words = repr(" ".join(self.words)[:80])
        return SceneFormatError(f"{expected} in {where}", found=words, fix=EXPORT_PLY_AGAIN)


def _lines(path: Path, header: bytes) -> list[_Line]:
    """The non-empty lines after the first; comments may be in any encoding."""
    text = header.decode("latin-1").split("\n")
    lines = [_Line(path, number, line.split()) for number, line in enumerate(text, start=1)]
    return [ln for ln in lines[1:] if ln.words and ln.words[0] not in {"comment", "obj_info"}]


def _parse_format(path: Path, lines: list[_Line]) -> str:
    """The byte order; consumes the format line, which comes first."""
    first = lines.pop(0) if lines else _Line(path, 2, [])
    match first.words:
        case ["format", form, "1.0"] if form in _BYTE_ORDERS:
            return _BYTE_ORDERS[form]
    raise first.error(f"format {'|'.join(_BYTE_ORDERS)} 1.0")


def _parse_elements(lines: list[_Line]) -> Iterator[Element]:
    """Each element with the properties that follow it."""
    starts = [i for i, line in enumerate(lines) if line.words[0] == "element"]
    if lines and (not starts or starts[0] > 0):
        raise lines[0].error("an element before any property")
    for start, stop in zip(starts, [*starts[1:], len(lines)], strict=True):
        name, count = _parse_element(lines[start])
        properties = tuple(map(_parse_property, lines[start + 1 : stop]))
        names = [prop.name for prop in properties]
        if len(set(names)) < len(names):
            raise lines[start].error("an element whose properties differ in name")
        yield Element(name, count, properties)


def _parse_element(line: _Line) -> tuple[str, int]:
    match line.words:
        case ["element", name, count] if count.isascii() and count.isdigit() and len(count) < 20:
            return name, int(count)
    raise line.error("element NAME COUNT")


def _parse_property(line: _Line) -> Property:
    match line.words:
        case ["property", "list", length, kind, name] if kind in _TYPES:
            if _TYPES.get(length, "f")[0] in "iu":
                return Property(name, _TYPES[kind], _TYPES[length])
        case ["property", kind, name] if kind in _TYPES:
            return Property(name, _TYPES[kind], None)
    raise line.error(f"property TYPE NAME or property list TYPE TYPE NAME, types {list(_TYPES)}")
