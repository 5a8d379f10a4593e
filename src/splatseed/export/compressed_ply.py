"""PlayCanvas's compressed PLY: 16 bytes per Gaussian, and one per further colour coefficient.

Notation: a *chunk* is 256 Gaussians with the bounds of their positions, log-scales and colours, to
which their values are relative.
Source: the format's description in PlayCanvas's splat-transform and engine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt32

from splatseed.export.packing import (
    SH_COUNTS,
    from_smallest_three,
    morton_order,
    opacity_bytes,
    opacity_logits,
    smallest_three,
)
from splatseed.io.files import ByteReader
from splatseed.io.ply import EXPORT_PLY_AGAIN, Element, parse_header
from splatseed.splat.gaussians import SH_C0, Gaussians

CHUNK = 256
"""Gaussians per chunk."""
AXES = ("x", "y", "z")
BOUNDS = tuple(
    f"{end}_{name}"
    for names in (AXES, ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
MOST_LOG_SCALE = 20.0
SH_RANGE = 8.0
VECTOR_BITS = ((21, 11), (11, 10), (0, 11))
"""Shift and number of bits of each part of a packed number; likewise the following."""
THREE_BITS = ((20, 10), (10, 10), (0, 10))
COLOR_BITS = ((24, 8), (16, 8), (8, 8))


def encode(gaussians: Gaussians) -> bytes:
    """The bytes of a file with the Gaussians, in Z-curve order."""
    order = morton_order(gaussians.means)
    count, rest = len(order), 3 * gaussians.shN.shape[1]
    chunk = np.arange(count) // CHUNK
    scales = np.clip(gaussians.scales[order], -MOST_LOG_SCALE, MOST_LOG_SCALE)
    colors = gaussians.sh0[order, 0] * np.float32(SH_C0) + np.float32(0.5)
    tables, units = zip(
        *(_in_chunks(v, chunk) for v in (gaussians.means[order], scales, colors)), strict=True
    )
    largest, three = smallest_three(gaussians.quats[order])
    packed = np.empty((count, 4), "<u4")
    packed[:, 0] = _pack(units[0], VECTOR_BITS)  # positions: 11, 10 and 11 bits
    # Rotations: 2 bits for the index of the largest component, 10 for each other one.
    turn = _pack(three * np.float32(np.sqrt(0.5)) + np.float32(0.5), THREE_BITS)
    packed[:, 1] = (largest.astype(np.uint32) << 30) | turn
    packed[:, 2] = _pack(units[1], VECTOR_BITS)
    # 8 bits for each of red, green, blue and the opacity.
    packed[:, 3] = _pack(units[2], COLOR_BITS) | opacity_bytes(gaussians.opacities[order])
    coefficients = gaussians.shN[order].transpose(0, 2, 1).reshape(count, rest)
    # A coefficient c in [-4, 4] is the byte (c / 8 + 1/2) 256.
    sh = np.clip((coefficients / SH_RANGE + 0.5) * 256, 0, 255).astype(np.uint8)
    bounds = np.hstack(tables).astype("<f4")
    return b"".join(
        [_header(len(bounds), count, rest), bounds.tobytes(), packed.tobytes(), sh.tobytes()]
    )


def decode(path: Path) -> Gaussians:
    """The Gaussians in a file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is cut short, or does not hold what the format promises.
    """
    reader = ByteReader(path, EXPORT_PLY_AGAIN)
    header = parse_header(path, reader.data)
    reader.offset = header.size
    tables = {}
    for element in header.elements:
        reader.record = f"element {element.name}"
        tables[element.name] = reader.array(_dtype(reader, element), element.num_rows)
    chunks, vertices = _checked(reader, tables)
    chunk = np.arange(len(vertices)) // CHUNK
    means = _from_chunks(_unpack(vertices[PACKED[0]], VECTOR_BITS), chunks, BOUNDS[0:6], chunk)
    scales = _from_chunks(_unpack(vertices[PACKED[2]], VECTOR_BITS), chunks, BOUNDS[6:12], chunk)
    colors = _unpack(vertices[PACKED[3]], COLOR_BITS)
    if BOUNDS[-1] in (chunks.dtype.names or ()):
        colors = _from_chunks(colors, chunks, BOUNDS[12:18], chunk)
    turn = vertices[PACKED[1]]
    three = (_unpack(turn, THREE_BITS) - np.float32(0.5)) * np.float32(np.sqrt(2))
    return Gaussians(
        means=means,
        scales=scales,
        quats=from_smallest_three((turn >> 30).astype(np.int64), three),
        opacities=opacity_logits((vertices[PACKED[3]] & 255).astype(np.uint8)),
        sh0=((colors - np.float32(0.5)) / np.float32(SH_C0))[:, None],
        shN=_coefficients(reader, tables.get("sh"), len(vertices)),
    )


def _header(num_chunks: int, count: int, rest: int) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {num_chunks}"]
    lines += [f"property float {name}" for name in BOUNDS]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _in_chunks(
    values: Float32[np.ndarray, "N 3"], chunk: np.ndarray
) -> tuple[Float32[np.ndarray, "C 6"], Float32[np.ndarray, "N 3"]]:
    """The bounds of each chunk, and each value as a fraction between them."""
    starts = np.arange(0, len(values), CHUNK)
    low = np.minimum.reduceat(values, starts, axis=0)
    high = np.maximum.reduceat(values, starts, axis=0)
    extent = np.where(high > low, high - low, 1)
    return np.hstack([low, high]), (values - low[chunk]) / extent[chunk]


def _from_chunks(
    units: Float32[np.ndarray, "N 3"],
    chunks: np.ndarray[Any, Any],
    names: tuple[str, ...],
    chunk: np.ndarray,
) -> Float32[np.ndarray, "N 3"]:
    low = np.stack([chunks[name] for name in names[:3]], axis=1)[chunk]
    high = np.stack([chunks[name] for name in names[3:]], axis=1)[chunk]
    return np.asarray(low + units * (high - low), np.float32)


def _pack(
    units: Float32[np.ndarray, "N 3"], layout: tuple[tuple[int, int], ...]
) -> UInt32[np.ndarray, " N"]:
    """Values in [0, 1] quantised to the given numbers of bits, shifted into one integer."""
    packed = np.zeros(len(units), np.uint32)
    for i, (shift, bits) in enumerate(layout):
        most = 2**bits - 1
        packed |= np.rint(np.clip(units[:, i], 0, 1) * most).astype(np.uint32) << np.uint32(shift)
    return packed


def _unpack(
    packed: UInt32[np.ndarray, " N"], layout: tuple[tuple[int, int], ...]
) -> Float32[np.ndarray, "N 3"]:
    columns = [((packed >> shift) & (2**bits - 1)) / (2**bits - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)


def _dtype(reader: ByteReader, element: Element) -> np.dtype[Any]:
    if element.has_lists:
        raise reader.error("scalar properties", "lists")
    return np.dtype([(prop.name, "<" + prop.dtype) for prop in element.properties])


def _checked(
    reader: ByteReader, tables: dict[str, np.ndarray[Any, Any]]
) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
    """The tables of chunks and vertices, checked for every property that is read."""
    empty = np.empty(0, [])
    chunks, vertices = tables.get("chunk", empty), tables.get("vertex", empty)
    bounds = {*(chunks.dtype.names or ())}
    # Files from before 2024 have no colour bounds at all.
    missing = {*(BOUNDS if bounds & {*BOUNDS[12:]} else BOUNDS[:12])} - bounds
    missing |= {*PACKED} - {*(vertices.dtype.names or ())}
    if missing:
        raise reader.error("the properties of a compressed PLY", f"no {', '.join(sorted(missing))}")
    if len(vertices) == 0 or len(chunks) != -(-len(vertices) // CHUNK):
        counts = f"{len(chunks)} chunks and {len(vertices)} Gaussians"
        raise reader.error(f"a chunk for every {CHUNK} Gaussians", counts)
    if any(vertices.dtype[name] != np.dtype("<u4") for name in PACKED):
        raise reader.error("packed properties of type uint", "another type")
    return chunks, vertices


def _coefficients(
    reader: ByteReader, table: np.ndarray[Any, Any] | None, count: int
) -> Float32[np.ndarray, "N K 3"]:
    """Colour coefficients beyond the first; the file stores all of red, then green, then blue."""
    names = [] if table is None else [n for n in table.dtype.names or () if n.startswith("f_rest_")]
    if table is None or not names:
        return np.zeros((count, 0, 3), np.float32)
    if len(table) != count or len(names) // 3 not in SH_COUNTS or len(names) % 3:
        raise reader.error(f"{count} rows of 9, 24 or 45 f_rest", f"{len(table)} of {len(names)}")
    wanted = [f"f_rest_{i}" for i in range(len(names))]
    if missing := set(wanted) - set(names):
        raise reader.error("f_rest of every number", f"no {', '.join(sorted(missing))}")
    values = np.stack([table[name] for name in wanted], axis=1)
    centers = (values.astype(np.float32) + np.float32(0.5)) / 256
    centers = np.where(values == 0, 0, np.where(values == 255, 1, centers)).astype(np.float32)
    rows = ((centers - np.float32(0.5)) * np.float32(SH_RANGE)).reshape(count, 3, -1)
    return np.ascontiguousarray(rows.transpose(0, 2, 1))
