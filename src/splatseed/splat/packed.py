"""Packed formats: .splat, PlayCanvas's compressed PLY, Niantic's .spz, and what they share.

Notation: quaternions are wxyz; a rotation's *largest* component, made positive, is dropped, because
the other *three*, each within 1/sqrt(2) of 0, determine it. A .splat has no header and no
view-dependent colour. A *chunk* of a compressed PLY is 256 Gaussians with the bounds of their
positions, log-scales and colours, to which their values, 16 bytes per Gaussian, are relative. An
.spz holds one attribute after another, gzipped (versions 1 to 3) or in zstd (4); its axes are
right, up, back, ours right, down, front: y and z change sign. Source: antimatter15/splat;
PlayCanvas's splat-transform and engine; nianticlabs/spz (load-spz.cc, splat-types.h).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8, UInt32
from numpy.lib.recfunctions import structured_to_unstructured

from splatseed.errors import ParameterError
from splatseed.io.files import COPY_AGAIN, ByteReader, read_bytes, translate_errors
from splatseed.io.ply import parse_header
from splatseed.progress import Note, silent_note
from splatseed.requirements import require
from splatseed.runtime.memory import check_memory
from splatseed.splat.cleaning import MAX_LOG_SCALE
from splatseed.splat.extent import (
    COARSE,
    Fit,
    best_fit,
    left_out_note,
    morton_codes,
    morton_order,
    shells_of,
)
from splatseed.splat.gaussians import SH_C0, Gaussians
from splatseed.splat.ply_layout import antialiased_comment, is_antialiased
from splatseed.text import agreeing, counted

SH_COUNTS = (0, 3, 8, 15)
"""Coefficients beyond the first, by the degree of the spherical harmonics."""
RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
"""A Gaussian of a .splat: scales are standard deviations, the rotation is 128 q + 128."""
SPZ_MAGIC = b"NGSP"

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The components that remain, by the index of the largest."""
_CHUNK, _SH_RANGE = 256, 8.0
_BOUNDS = [
    [f"{end}_{name}" for name in names]
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
]
_GLARING = 2.5
"""Colours farther from mid grey, 0.5, are apart: a byte is too coarse for them and all others."""
_FILLER = np.array([0, 0x20080200, 0, 0], "<u4")
"""The least of all that its chunk holds, not turned, opacity 0; left out on reading."""
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_Layout = tuple[tuple[int, int], ...]
"""Shift and number of bits of each part of a packed number."""
_VECTOR_BITS: _Layout = ((21, 11), (11, 10), (0, 11))
_THREE_BITS: _Layout = ((20, 10), (10, 10), (0, 10))
_COLOR_BITS: _Layout = ((24, 8), (16, 8), (8, 8))

_SPZ_HEADER = struct.Struct("<4sIIBBBB")
_SPZ_VERSION = 3  # the latest that every reader accepts
_SPZ_MOST, _SPZ_FRACTION = 2**23 - 1, 20
"""Largest position in units of 2^-f, 24 bits with a sign; largest f."""
_SPZ_ANTIALIASED = 1
"""The flag of models that are to be rendered with antialiasing."""
_SPZ_DEGREES = (*SH_COUNTS, 24)
"""Coefficients beyond the first by degree; those of degree 4 are not used."""
_SPZ_SCALES = (-10.0, 255 / 16 - 10)
"""Log-scales that a byte holds."""
_MAX_LOST = 0.1
"""Share of the picture that far Gaussians may take with them, where no bits would hold them."""
_SPZ_NINE_BITS = np.float32(511 * np.sqrt(2))
_SPZ_COLOR = 0.15 * 255
"""Bytes per unit of the first coefficient: the format's scale."""
_SPZ_AXES = np.array([1, -1, -1], np.float32)
_SPZ_QUAT = np.array([1, 1, -1, -1], np.float32)
_SPZ_SH = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs of the spherical harmonics of degrees 1 to 3 when y and z are flipped."""
_SPZ_STEP = 4
"""Further coefficients are rounded to this many 128ths, so that gzip saves more. Niantic's writer
takes 8 for the first degree and 16 for the others: files are a quarter smaller, but coefficients of
a short run vanish, and with them up to 2.8 dB (docs/formats.md)."""


# What formats share -------------------------------------------------------------------------------


def smallest_three(
    quats: Float32[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N 3"]]:
    """The index of the largest component, and the other three in order; see the module."""
    unit = _unit_quats(quats)
    largest = np.argmax(np.abs(unit), axis=1)
    rows = np.arange(len(unit))
    unit *= np.where(unit[rows, largest] < 0, -1, 1).astype(np.float32)[:, None]
    return largest, unit[rows[:, None], _OTHERS[largest]]


def from_smallest_three(
    largest: Int64[np.ndarray, " N"], three: Float32[np.ndarray, "N 3"]
) -> Float32[np.ndarray, "N 4"]:
    """The unit quaternions that ``smallest_three`` encoded."""
    rows = np.arange(len(three))
    quats = np.empty((len(three), 4), np.float32)
    quats[rows[:, None], _OTHERS[largest]] = three
    # A unit quaternion: the fourth square is 1 minus the other three.
    quats[rows, largest] = np.sqrt(np.maximum(1 - (three**2).sum(axis=1), 0))
    return quats


def opacity_bytes(logits: Float32[np.ndarray, " N"]) -> UInt8[np.ndarray, " N"]:
    """Opacities in [0, 1] in steps of 1/255."""
    with np.errstate(over="ignore"):
        return np.rint(255 / (1 + np.exp(-logits.astype(np.float64)))).astype(np.uint8)


def opacity_logits(values: UInt8[np.ndarray, " N"]) -> Float32[np.ndarray, " N"]:
    """Logits of opacities in steps of 1/255; 0 and 1 move a quarter step inward to stay finite."""
    opacity = np.clip(values / 255, 0.25 / 255, 1 - 0.25 / 255)
    return np.log(opacity / (1 - opacity)).astype(np.float32)


def rounded_bytes(values: np.ndarray) -> UInt8[np.ndarray, "..."]:
    """Values from 0 to 255 as bytes; others are clipped."""
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def _unit_quats(quats: Float32[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Quaternions of length 1; zeros become the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    known = np.isfinite(norms) & (norms > 0)
    unit = np.divide(quats, norms, out=np.zeros_like(quats), where=known)
    unit[~known[:, 0]] = (1, 0, 0, 0)
    return np.asarray(unit)


# .splat -------------------------------------------------------------------------------------------


def encode_splat(gaussians: Gaussians, note: Note = silent_note) -> list[bytes]:
    """By size times opacity, so that a viewer can draw the most important ones first."""
    if gaussians.antialiased:
        note(
            "The model is to be rendered with antialiasing, which a .splat cannot say: small "
            "Gaussians will be too opaque."
        )
    log_opacity = -np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    size = gaussians.scales.astype(np.float64).sum(axis=1) + log_opacity
    order = np.argsort(-size, kind="stable")
    rows = np.empty(len(order), RECORD)
    rows["mean"] = gaussians.means[order]
    with np.errstate(over="ignore"):
        rows["scale"] = np.exp(gaussians.scales[order])
    color = 0.5 + SH_C0 * gaussians.sh0[order, 0]
    rows["rgba"][:, :3] = np.rint(np.clip(color, 0, 1) * 255)
    rows["rgba"][:, 3] = opacity_bytes(gaussians.opacities[order])
    rows["quat"] = rounded_bytes(_unit_quats(gaussians.quats[order]) * 128 + 128)
    return [rows.tobytes()]


def decode_splat(path: Path, _: Note = silent_note) -> Gaussians:
    """A whole number of records; scales that are negative become NaN.

    As a .splat has no signature, one without usable scales and means in half of its Gaussians is
    no .splat.
    """
    reader = ByteReader(path)
    reader.record = "Gaussians"
    rows = reader.array(RECORD, len(reader.data) // RECORD.itemsize)
    reader.finish()
    usable = (np.isfinite(rows["scale"]) & (rows["scale"] >= 0)).all(axis=1)
    bad = np.count_nonzero(~(usable & np.isfinite(rows["mean"]).all(axis=1)))
    if 2 * bad >= len(rows):
        raise reader.error("finite positions and scales", f"others in {bad} Gaussians")
    with np.errstate(divide="ignore", invalid="ignore"):
        scales = np.log(rows["scale"])
    return Gaussians(
        means=np.ascontiguousarray(rows["mean"], np.float32),
        scales=scales.astype(np.float32),
        quats=_unit_quats((rows["quat"].astype(np.float32) - 128) / 128),
        opacities=opacity_logits(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(rows), 0, 3), np.float32),
    )


# Compressed PLY -----------------------------------------------------------------------------------


def encode_compressed_ply(gaussians: Gaussians, _: Note = silent_note) -> list[bytes]:
    """In Z-curve order, far Gaussians and colours beyond any display's in chunks of their own."""
    order, fillers = _in_chunks(gaussians)
    count, rest = len(order), 3 * gaussians.shN.shape[1]
    scales = np.clip(gaussians.scales[order], -MAX_LOG_SCALE, MAX_LOG_SCALE)
    colors = gaussians.sh0[order, 0] * np.float32(SH_C0) + np.float32(0.5)
    chunk, starts = np.arange(count) // _CHUNK, np.arange(0, count, _CHUNK)
    tables, units = [], []
    for values in (gaussians.means[order], scales, colors):
        # The bounds of each chunk, and each value as a fraction between them.
        low = np.minimum.reduceat(values, starts, axis=0)
        high = np.maximum.reduceat(values, starts, axis=0)
        extent = np.where(high > low, high - low, 1)
        tables += [low, high]
        units.append((values - low[chunk]) / extent[chunk])
    largest, three = smallest_three(gaussians.quats[order])
    packed = np.empty((count, 4), "<u4")
    packed[:, 0] = _pack(units[0], _VECTOR_BITS)
    # 2 bits for the index of the largest component, 10 for each other one.
    turn = _pack(three * np.float32(np.sqrt(0.5)) + np.float32(0.5), _THREE_BITS)
    packed[:, 1] = (largest.astype(np.uint32) << 30) | turn
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
    """The Gaussians by chunk, and which places only fill one up.

    Bounds of a chunk are its members'; so Gaussians of different shells, and those of colours far
    beyond black or white, share none: each group but the last ends with fillers, invisible
    Gaussians that repeat the place of one of it.
    """
    colors = gaussians.sh0[:, 0] * np.float32(SH_C0) + np.float32(0.5)
    glaring = (np.abs(colors - np.float32(0.5)) > _GLARING).any(axis=1)
    groups = 2 * shells_of(gaussians.means) + glaring
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


def decode_compressed_ply(path: Path, _: Note = silent_note) -> Gaussians:
    """Chunks, vertices, and coefficients if there are some."""
    reader = ByteReader(path)
    header = parse_header(path, reader.data)
    reader.offset = header.size
    tables: dict[str, np.ndarray[Any, Any]] = {}
    with translate_errors(path, "a whole compressed PLY"):
        for element in header.elements:
            reader.record = f"element {element.name}"
            tables[element.name] = reader.array(header.dtype(element), element.num_rows)
        vertices, chunks = tables["vertex"], tables["chunk"]
        if not len(vertices) or len(chunks) != -(-len(vertices) // _CHUNK):
            raise ValueError(f"{len(chunks)} chunks for {len(vertices)} Gaussians")
        if any(vertices.dtype[name] != np.dtype("<u4") for name in _PACKED):
            raise ValueError("packed properties of another type than uint")
        position, turn, scale, color = (vertices[name] for name in _PACKED)
        chunk = np.arange(len(vertices)) // _CHUNK

        def within(units: Float32[np.ndarray, "N 3"], kind: int) -> Float32[np.ndarray, "N 3"]:
            ends = (chunks[names] for names in _BOUNDS[2 * kind : 2 * kind + 2])
            low, high = (structured_to_unstructured(end)[chunk] for end in ends)
            return np.asarray(low + units * (high - low), np.float32)

        colors = _unpack(color, _COLOR_BITS)
        # Files from before 2024 have no colour bounds at all.
        if {*_BOUNDS[4], *_BOUNDS[5]} & set(chunks.dtype.names or ()):
            colors = within(colors, 2)
        table, shN = tables.get("sh", vertices), np.zeros((len(vertices), 0, 3), np.float32)
        rest = [name for name in table.dtype.names or () if name.startswith("f_rest_")]
        if rest:  # all of red, then green, then blue
            if len(table) != len(vertices) or len(rest) not in {3 * k for k in SH_COUNTS}:
                raise ValueError(f"{len(table)} rows of {len(rest)} f_rest")
            values = structured_to_unstructured(table[[f"f_rest_{i}" for i in range(len(rest))]])
            centers = (values.astype(np.float32) + np.float32(0.5)) / 256
            centers = np.where(values == 0, 0, np.where(values == 255, 1, centers))
            rows = (centers.astype(np.float32) - np.float32(0.5)) * np.float32(_SH_RANGE)
            shN = np.ascontiguousarray(rows.reshape(len(rows), 3, -1).transpose(0, 2, 1))
        three = (_unpack(turn, _THREE_BITS) - np.float32(0.5)) * np.float32(np.sqrt(2))
        packed = np.stack([position, turn, scale, color], axis=1)
        kept = (packed != _FILLER).any(axis=1)
        gaussians = Gaussians(
            means=within(_unpack(position, _VECTOR_BITS), 0),
            scales=within(_unpack(scale, _VECTOR_BITS), 1),
            quats=from_smallest_three((turn >> 30).astype(np.int64), three),
            opacities=opacity_logits((color & 255).astype(np.uint8)),
            sh0=((colors - np.float32(0.5)) / np.float32(SH_C0))[:, None],
            shN=shN,
            antialiased=is_antialiased(reader.data[: header.size]),
        )
        return gaussians if kept.all() or not kept.any() else gaussians.select(kept)


def _pack(units: Float32[np.ndarray, "N 3"], layout: _Layout) -> UInt32[np.ndarray, " N"]:
    """Values in [0, 1] quantised to the given numbers of bits, shifted into one integer."""
    packed = np.zeros(len(units), np.uint32)
    for i, (shift, bits) in enumerate(layout):
        most = 2**bits - 1
        packed |= np.rint(np.clip(units[:, i], 0, 1) * most).astype(np.uint32) << np.uint32(shift)
    return packed


def _unpack(packed: UInt32[np.ndarray, " N"], layout: _Layout) -> Float32[np.ndarray, "N 3"]:
    columns = [((packed >> shift) & (2**bits - 1)) / (2**bits - 1) for shift, bits in layout]
    return np.stack(columns, axis=1).astype(np.float32)


# .spz ---------------------------------------------------------------------------------------------


def encode_spz(gaussians: Gaussians, note: Note = silent_note) -> list[bytes]:
    """In Z-curve order, of degree 3 at most.

    Raises:
        ParameterError: Positions are beyond what the format can hold.
    """
    gaussians, bits = _fixed_point(gaussians, note)
    order = morton_order(gaussians.means)
    rest = gaussians.shN.shape[1]
    # A position in units of 2^-f; a coefficient c beyond the first as 128 c + 128.
    fixed = np.rint(gaussians.means[order] * _SPZ_AXES * np.float64(2**bits)).astype("<i4")
    sh = np.rint(gaussians.shN[order] * _SPZ_SH[:rest, None] * 128 + 128)
    # From the highest bits: the index of the largest of xyzw, then signs and sizes of the others.
    quats = gaussians.quats[order] * _SPZ_QUAT
    largest, three = smallest_three(np.roll(quats, -1, axis=1))
    turn = largest.astype(np.uint32)
    for i in range(3):
        part = np.minimum(np.rint(np.abs(three[:, i]) * _SPZ_NINE_BITS), 511).astype(np.uint32)
        turn = (turn << 10) | ((three[:, i] < 0).astype(np.uint32) << 9) | part
    parts = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],  # 24 bits a component
        opacity_bytes(gaussians.opacities[order]),
        rounded_bytes(gaussians.sh0[order, 0] * _SPZ_COLOR + 127.5),  # 255 (0.15 c + 1/2)
        rounded_bytes((gaussians.scales[order] + 10) * 16),  # of log-scales
        turn.astype("<u4"),
        rounded_bytes(np.floor((sh + _SPZ_STEP // 2) / _SPZ_STEP) * _SPZ_STEP),
    ]
    degree = SH_COUNTS.index(rest)
    flags = _SPZ_ANTIALIASED * gaussians.antialiased
    header = _SPZ_HEADER.pack(SPZ_MAGIC, _SPZ_VERSION, len(order), degree, bits, flags, 0)
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    return [gzip.compress(header + body, 6, mtime=0)]


def _fixed_point(gaussians: Gaussians, note: Note) -> tuple[Gaussians, int]:
    """The Gaussians that the format holds, and the fractional bits of their positions.

    All have the same bits: the most that hold every position, unless a few far ones would cost the
    others their place.
    """
    farthest = np.abs(gaussians.means.astype(np.float64)).max(axis=1)
    fits = [Fit(farthest <= _SPZ_MOST / 2.0**bits, 2.0**-bits) for bits in range(_SPZ_FRACTION + 1)]
    whole = [bits for bits, fit in enumerate(fits) if fit.kept.all()]
    first = max(whole, default=0)
    chosen, lost, error = best_fit(gaussians, fits[first:])
    bits = first + chosen
    kept, most = fits[bits].kept, _SPZ_MOST / 2.0**bits
    if not kept.any() or (not whole and lost > _MAX_LOST):
        raise ParameterError(
            f"positions within {_SPZ_MOST:,} of the origin, which is all that .spz can hold",
            found=f"one at {farthest.max():.3g}",
            fix="Export another format, or crop the model.",
        )
    if not kept.all():
        note(left_out_note(".spz", kept, f"more than {most:,.4g} units from the origin"))
    if error > COARSE:
        steps = f"up to {most:,.4g} units from the origin in steps of {2.0**-bits:.3g}"
        note(
            f"A .spz holds positions {steps}, too coarse for this model: export another format, or "
            "move the model to the origin."
        )
    scales = np.sort(gaussians.scales[kept], axis=1)  # of a flat Gaussian the least does not count
    beyond = (scales[:, 2] > _SPZ_SCALES[1]) | (scales[:, 1] < _SPZ_SCALES[0])
    if number := int(np.count_nonzero(beyond)):
        least, largest = np.exp(_SPZ_SCALES)
        note(
            f"A .spz holds sizes from {least:.2g} to {largest:.0f} units: "
            f"{counted(number, 'Gaussian')} {agreeing(number, 'has', 'have')} the nearest."
        )
    return gaussians if kept.all() else gaussians.select(kept), bits


def decode_spz(path: Path, note: Note = silent_note) -> Gaussians:
    """Of any version; 4 needs zstandard."""
    data = read_bytes(path)
    with translate_errors(path, "a whole .spz"):
        stream = zlib.decompressobj(wbits=31)
        in_zstd = data.startswith(SPZ_MAGIC)
        header = data if in_zstd else stream.decompress(data, _SPZ_HEADER.size)
        _, version, count, degree, bits, flags, _ = _SPZ_HEADER.unpack_from(header)
        if not 1 <= version <= 4:
            raise ValueError(f"version {version}; versions 1 to 4 are known")
        if degree >= len(_SPZ_DEGREES) or count == 0 or bits > 24:
            raise ValueError(f"{count} Gaussians of degree {degree}, {bits} fractional bits")
        rest = _SPZ_DEGREES[degree]
        # Position, opacity, colour, scale, rotation, harmonics: bytes per Gaussian.
        sizes = [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * rest]
        check_memory(count, sum(sizes), "Gaussians", fix=COPY_AGAIN)
        wanted = count * sum(sizes)
        if in_zstd:
            body = _zstd_body(data, count, [size for size in sizes if size])
        else:  # up to the size in the header: no zip bomb is unpacked
            body = stream.decompress(stream.unconsumed_tail, wanted)
        if not (in_zstd or stream.eof):  # to its checksum, and past what a newer version may add
            stream.decompress(stream.unconsumed_tail, wanted)
        if len(body) != wanted or not (in_zstd or stream.eof):
            raise ValueError(f"a stream that ends after {len(body):,} of {wanted:,} bytes")
        parts = np.split(np.frombuffer(body, np.uint8), count * np.cumsum(sizes)[:-1])
        position, opacity, color, scale, turn, sh = (part.reshape(count, -1) for part in parts)
        harmonics = (sh.reshape(count, rest, 3).astype(np.float32) - 128) / 128
        if rest > len(_SPZ_SH):
            note(
                f"Of {rest} coefficients beyond the first, the {len(_SPZ_SH)} of degree 3 are used."
            )
            rest, harmonics = len(_SPZ_SH), harmonics[:, : len(_SPZ_SH)]
        if version == 1:  # half floats
            means = np.ascontiguousarray(position).view("<f2").astype(np.float32)
        else:
            digits = position.reshape(-1, 3, 3).astype(np.int32)
            fixed = digits[..., 0] | digits[..., 1] << 8 | digits[..., 2] << 16
            fixed = np.where(fixed > _SPZ_MOST, fixed - 2**24, fixed)
            means = (fixed / 2.0**bits).astype(np.float32)
        return Gaussians(
            means=means * _SPZ_AXES,
            scales=(scale / 16 - 10).astype(np.float32),
            quats=_quats(turn) * _SPZ_QUAT,
            opacities=opacity_logits(opacity[:, 0]),
            sh0=((color - 127.5) / _SPZ_COLOR).astype(np.float32)[:, None],
            shN=np.asarray(harmonics * _SPZ_SH[:rest, None], np.float32),
            antialiased=bool(flags & _SPZ_ANTIALIASED),
        )


def _zstd_body(data: bytes, count: int, sizes: list[int]) -> bytes:
    """The attributes of version 4, whose header ends in the offset of a table of their streams."""
    require("zstandard")
    import zstandard  # noqa: PLC0415  (of the extra view)

    (table,) = struct.unpack_from("<I", data, _SPZ_HEADER.size)
    at, body = table + 16 * len(sizes), b""
    for i, size in enumerate(sizes):
        length, _ = struct.unpack_from("<QQ", data, table + 16 * i)
        body += zstandard.ZstdDecompressor().decompress(
            data[at : at + length], max_output_size=count * size
        )
        at += length
    return body


def _quats(raw: UInt8[np.ndarray, "N B"]) -> Float32[np.ndarray, "N 4"]:
    if raw.shape[1] == 3:  # a byte for each of x, y, z; w >= 0 follows
        xyz = raw / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
        return np.hstack([w, xyz]).astype(np.float32)
    packed = np.ascontiguousarray(raw).view("<u4")[:, 0]
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    size = (fields & 511) / _SPZ_NINE_BITS
    three = np.where(fields >> 9, -size, size).astype(np.float32)
    return np.roll(from_smallest_three((packed >> 30).astype(np.int64), three), 1, axis=1)
