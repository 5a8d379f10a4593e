"""Read and write PlayCanvas's compressed PLY: 16 bytes per Gaussian, besides harmonics.

A *chunk* is 256 Gaussians with the bounds of their positions, log-scales and colours; packed values
are fractions between these bounds. Source: PlayCanvas's splat-transform and engine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt32
from numpy.lib.recfunctions import structured_to_unstructured

from splatseed.io.files import ByteReader, translate_errors
from splatseed.io.ply import parse_header
from splatseed.progress import Note, silent_note
from splatseed.splat.cleaning import MAX_LOG_SCALE
from splatseed.splat.extent import morton_codes, shells_of
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.ply_layout import antialiased_comment, is_antialiased
from splatseed.splat.quantization import (
    SH_COUNTS,
    from_smallest_three,
    opacity_bytes,
    opacity_logits,
    smallest_three,
)

_CHUNK, _SH_RANGE = 256, 8.0
_BOUNDS = [
    [f"{end}_{name}" for name in names]
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
]
_MAX_COLOR_OFFSET = 2.5
"""Distance from mid grey, 0.5, beyond which colours get chunks of their own: bytes cannot resolve
them together with usual colours."""
_FILLER = np.array([0, 0x20080200, 0, 0], "<u4")
"""The minimum of each bound, no rotation, opacity 0; dropped on reading."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_Layout = tuple[tuple[int, int], ...]
"""Shift and number of bits of each component of a packed number."""
_VECTOR_BITS: _Layout = ((21, 11), (11, 10), (0, 11))
_THREE_BITS: _Layout = ((20, 10), (10, 10), (0, 10))
_COLOR_BITS: _Layout = ((24, 8), (16, 8), (8, 8))


def encode(gaussians: Gaussians, _: Note = silent_note) -> list[bytes]:
    """Encode Gaussians in Z-curve order; outliers in position or colour get separate chunks."""
    order, fillers = _in_chunks(gaussians)
    count, rest = len(order), 3 * gaussians.shN.shape[1]
    scales = np.clip(gaussians.scales[order], -MAX_LOG_SCALE, MAX_LOG_SCALE)
    colors = gaussians.sh0[order, 0] * np.float32(SH_C0) + np.float32(0.5)
    chunk, starts = np.arange(count) // _CHUNK, np.arange(0, count, _CHUNK)
    tables, units = [], []
    for values in (gaussians.means[order], scales, colors):
        # Bounds per chunk; values become fractions between them.
        low = np.minimum.reduceat(values, starts, axis=0)
        high = np.maximum.reduceat(values, starts, axis=0)
        extent = np.where(high > low, high - low, 1)
        tables += [low, high]
        units.append((values - low[chunk]) / extent[chunk])
    largest, three = smallest_three(gaussians.quats[order])
    packed = np.empty((count, 4), "<u4")
    packed[:, 0] = _pack(units[0], _VECTOR_BITS)
    # 2 bits for the index of the largest component, 10 for each of the others.
    rotation = _pack(three * np.float32(np.sqrt(0.5)) + np.float32(0.5), _THREE_BITS)
    packed[:, 1] = (largest.astype(np.uint32) << 30) | rotation
    packed[:, 2] = _pack(units[1], _VECTOR_BITS)
    packed[:, 3] = _pack(units[2], _COLOR_BITS) | opacity_bytes(gaussians.opacities[order])
    packed[fillers] = _FILLER
    coefficients = gaussians.shN[order].transpose(0, 2, 1).reshape(count, rest)
    # A coefficient c in [-4, 4] is the byte (c / 8 + 1/2) 256.
    sh = np.clip((coefficients / _SH_RANGE + 0.5) * 256, 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", *antialiased_comment(gaussians.antialiased)]
    lines += [f"element chunk {len(starts)}"]
    lines += [f"property float {name}" for names in _BOUNDS for name in names]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
    return [header, np.hstack(tables).astype("<f4").tobytes(), packed.tobytes(), sh.tobytes()]


def _in_chunks(gaussians: Gaussians) -> tuple[Int64[np.ndarray, " M"], Bool[np.ndarray, " M"]]:
    """Return the index of each encoded Gaussian, chunk by chunk, and a mask of fillers.

    The members of a chunk set its bounds, so Gaussians of different shells or with extreme colours
    must not share one. Each group but the last is padded to full chunks with fillers: invisible
    copies of its last Gaussian.
    """
    colors = gaussians.sh0[:, 0] * np.float32(SH_C0) + np.float32(0.5)
    extreme = (np.abs(colors - np.float32(0.5)) > _MAX_COLOR_OFFSET).any(axis=1)
    groups = 2 * shells_of(gaussians.means) + extreme
    order = np.lexsort((morton_codes(gaussians.means), groups))
    ends = np.append(np.flatnonzero(np.diff(groups[order])) + 1, len(order))
    parts = [np.arange(0, ends[0]), *map(np.arange, ends[:-1], ends[1:])]
    missing = [-len(part) % _CHUNK for part in parts[:-1]] + [0]
    index = [
        np.append(part, np.full(more, part[-1])) for part, more in zip(parts, missing, strict=True)
    ]
    filled = [
        np.arange(len(part) + more) >= len(part) for part, more in zip(parts, missing, strict=True)
    ]
    return order[np.concatenate(index)], np.concatenate(filled)


def decode(path: Path, _: Note = silent_note) -> Gaussians:
    """Decode a compressed PLY."""
    reader = ByteReader(path)
    header = parse_header(path, reader.data)
    reader.offset = header.size
    tables: dict[str, np.ndarray[Any, Any]] = {}
    with translate_errors(path, "a complete compressed PLY"):
        for element in header.elements:
            reader.record = f"element {element.name}"
            tables[element.name] = reader.array(header.dtype(element), element.num_rows)
        vertices, chunks = tables["vertex"], tables["chunk"]
        if not len(vertices) or len(chunks) != -(-len(vertices) // _CHUNK):
            raise ValueError(f"{len(chunks)} chunks for {len(vertices)} Gaussians")
        if any(vertices.dtype[name] != np.dtype("<u4") for name in _PACKED):
            raise ValueError("packed properties of another type than uint")
        position, rotation, scale, color = (vertices[name] for name in _PACKED)
        chunk = np.arange(len(vertices)) // _CHUNK

        def in_bounds(units: Float32[np.ndarray, "N 3"], kind: int) -> Float32[np.ndarray, "N 3"]:
            ends = (chunks[names] for names in _BOUNDS[2 * kind : 2 * kind + 2])
            low, high = (structured_to_unstructured(end)[chunk] for end in ends)
            return np.asarray(low + units * (high - low), np.float32)

        colors = _unpack(color, _COLOR_BITS)
        # Files from before 2024 have no colour bounds.
        if {*_BOUNDS[4], *_BOUNDS[5]} & set(chunks.dtype.names or ()):
            colors = in_bounds(colors, 2)
        table, shN = tables.get("sh", vertices), np.zeros((len(vertices), 0, 3), np.float32)
        rest = [name for name in table.dtype.names or () if name.startswith("f_rest_")]
        if rest:  # red coefficients, then green, then blue
            if len(table) != len(vertices) or len(rest) not in {3 * k for k in SH_COUNTS}:
                raise ValueError(f"{len(table)} rows of {len(rest)} f_rest")
            values = structured_to_unstructured(table[[f"f_rest_{i}" for i in range(len(rest))]])
            centers = (values.astype(np.float32) + np.float32(0.5)) / 256
            centers = np.where(values == 0, 0, np.where(values == 255, 1, centers))
            rows = (centers.astype(np.float32) - np.float32(0.5)) * np.float32(_SH_RANGE)
            shN = np.ascontiguousarray(rows.reshape(len(rows), 3, -1).transpose(0, 2, 1))
        three = (_unpack(rotation, _THREE_BITS) - np.float32(0.5)) * np.float32(np.sqrt(2))
        packed = np.stack([position, rotation, scale, color], axis=1)
        kept = (packed != _FILLER).any(axis=1)
        gaussians = Gaussians(
            means=in_bounds(_unpack(position, _VECTOR_BITS), 0),
            scales=in_bounds(_unpack(scale, _VECTOR_BITS), 1),
            quats=from_smallest_three((rotation >> 30).astype(np.int64), three),
            opacities=opacity_logits((color & 255).astype(np.uint8)),
            sh0=((colors - np.float32(0.5)) / np.float32(SH_C0))[:, None],
            shN=shN,
            antialiased=is_antialiased(reader.data[: header.size]),
        )
        return gaussians if kept.all() or not kept.any() else gaussians.select(kept)


def _pack(units: Float32[np.ndarray, "N 3"], layout: _Layout) -> UInt32[np.ndarray, " N"]:
    """Quantise values in [0, 1] and pack them into one integer."""
    packed = np.zeros(len(units), np.uint32)
    for i, (shift, bits) in enumerate(layout):
        levels = 2**bits - 1
        packed |= np.rint(np.clip(units[:, i], 0, 1) * levels).astype(np.uint32) << np.uint32(shift)
    return packed


def _unpack(packed: UInt32[np.ndarray, " N"], layout: _Layout) -> Float32[np.ndarray, "N 3"]:
    columns = [((packed >> shift) & (2**bits - 1)) / (2**bits - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)
