"""Read PlayCanvas's compressed PLY: 16 bytes per Gaussian, besides harmonics.

A *chunk* is 256 Gaussians with the bounds of their positions, log-scales and colours; packed values
are fractions between these bounds. Source: PlayCanvas's splat-transform and engine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt32
from numpy.lib.recfunctions import structured_to_unstructured

from splatseed.io.files import ByteReader, translate_errors
from splatseed.io.ply import parse_header
from splatseed.progress import Note, silent_note
from splatseed.splat.gaussians import SH_C0, SH_COUNTS, Gaussians, is_antialiased
from splatseed.splat.packing import from_smallest_three, opacity_logits

_CHUNK, _SH_RANGE = 256, 8.0
_BOUNDS = [
    [f"{end}_{name}" for name in names]
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
]
_FILLER = np.array([0, 0x20080200, 0, 0], "<u4")
"""Padding of chunks in older files of splatseed, dropped: opacity 0 at a corner of the bounds."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_Layout = tuple[tuple[int, int], ...]
"""Shift and number of bits of each component of a packed number."""
_VECTOR_BITS: _Layout = ((21, 11), (11, 10), (0, 11))
_THREE_BITS: _Layout = ((20, 10), (10, 10), (0, 10))
_COLOR_BITS: _Layout = ((24, 8), (16, 8), (8, 8))


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


def _unpack(packed: UInt32[np.ndarray, " N"], layout: _Layout) -> Float32[np.ndarray, "N 3"]:
    columns = [((packed >> shift) & (2**bits - 1)) / (2**bits - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)
