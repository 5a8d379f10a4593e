"""What packed formats share, and the two simple ones: .splat and PlayCanvas's compressed PLY.

Notation: quaternions are wxyz; a rotation's *largest* component, made positive, is dropped, because
the other *three*, each within 1/sqrt(2) of 0, determine it; [N] Gaussians. A record of a .splat is
float32 x, y, z and scales (standard deviations), then bytes: red, green, blue, opacity, and the
rotation wxyz as 128 q + 128; the file has no header and no view-dependent colour. A *chunk* of a
compressed PLY is 256 Gaussians with the bounds of their positions, log-scales and colours, to which
their values, 16 bytes per Gaussian, are relative; a byte per further colour coefficient follows.

Source: antimatter15/splat; the format's description in PlayCanvas's splat-transform and engine.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8, UInt32

from splatseed.io.files import ByteReader, guarded
from splatseed.io.ply import parse_header
from splatseed.splat.gaussians import SH_C0, Gaussians

SH_COUNTS = (0, 3, 8, 15)
"""Coefficients beyond the first, by the degree of the spherical harmonics."""

_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The components that remain, by the index of the largest."""
_MORTON_BITS = 16
_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_CHUNK = 256
_BOUNDS = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_MOST_LOG_SCALE = 20.0
_SH_RANGE = 8.0
_VECTOR_BITS = ((21, 11), (11, 10), (0, 11))
"""Shift and number of bits of each part of a packed number; likewise the following."""
_THREE_BITS = ((20, 10), (10, 10), (0, 10))
_COLOR_BITS = ((24, 8), (16, 8), (8, 8))


def unit_quats(quats: Float32[np.ndarray, "N 4"]) -> Float32[np.ndarray, "N 4"]:
    """Quaternions of length 1; zeros become the identity."""
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    known = np.isfinite(norms) & (norms > 0)
    unit = np.divide(quats, norms, out=np.zeros_like(quats), where=known)
    unit[~known[:, 0]] = (1, 0, 0, 0)
    return np.asarray(unit)


def smallest_three(
    quats: Float32[np.ndarray, "N 4"],
) -> tuple[Int64[np.ndarray, " N"], Float32[np.ndarray, "N 3"]]:
    """The index of the largest component, and the other three in order; see the module."""
    unit = unit_quats(quats)
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


def morton_order(xyz: Float32[np.ndarray, "N 3"]) -> Int64[np.ndarray, " N"]:
    """The order of points along a Z curve through their bounding box."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    extent = np.where(high > low, high - low, 1).astype(np.float64)
    cells = ((xyz - low) / extent * (2**_MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(xyz), np.uint64)
    for bit in range(_MORTON_BITS):
        for axis in range(3):
            digit = (cells[:, axis] >> np.uint64(bit)) & np.uint64(1)
            code |= digit << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def encode_splat(gaussians: Gaussians) -> bytes:
    """A .splat: by size times opacity, so that a viewer can draw the most important ones first."""
    log_opacity = -np.logaddexp(0, -gaussians.opacities.astype(np.float64))
    size = gaussians.scales.astype(np.float64).sum(axis=1) + log_opacity
    order = np.argsort(-size, kind="stable")
    rows = np.empty(len(order), _RECORD)
    rows["mean"] = gaussians.means[order]
    with np.errstate(over="ignore"):
        rows["scale"] = np.exp(gaussians.scales[order])
    color = 0.5 + SH_C0 * gaussians.sh0[order, 0]
    rows["rgba"][:, :3] = np.rint(np.clip(color, 0, 1) * 255)
    rows["rgba"][:, 3] = opacity_bytes(gaussians.opacities[order])
    rows["quat"] = np.clip(np.rint(unit_quats(gaussians.quats[order]) * 128 + 128), 0, 255)
    return rows.tobytes()


def decode_splat(path: Path) -> Gaussians:
    """The Gaussians in a .splat.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is not a whole number of records, or a scale is below 0.
    """
    reader = ByteReader(path)
    reader.record = "Gaussians"
    rows = reader.array(_RECORD, len(reader.data) // _RECORD.itemsize)
    reader.finish()
    good = np.isfinite(rows["scale"]).all(axis=1) & (rows["scale"] >= 0).all(axis=1)
    if not len(rows) or not good.all():
        raise reader.error("scales of 0 or more", f"others in {np.count_nonzero(~good)} Gaussians")
    least = np.finfo(np.float32).tiny
    return Gaussians(
        means=np.ascontiguousarray(rows["mean"], np.float32),
        scales=np.log(np.maximum(rows["scale"], least)).astype(np.float32),
        quats=unit_quats((rows["quat"].astype(np.float32) - 128) / 128),
        opacities=opacity_logits(rows["rgba"][:, 3]),
        sh0=((rows["rgba"][:, None, :3] / 255 - 0.5) / SH_C0).astype(np.float32),
        shN=np.zeros((len(rows), 0, 3), np.float32),
    )


def encode_compressed_ply(gaussians: Gaussians) -> bytes:
    """A compressed PLY, in Z-curve order."""
    order = morton_order(gaussians.means)
    count, rest = len(order), 3 * gaussians.shN.shape[1]
    scales = np.clip(gaussians.scales[order], -_MOST_LOG_SCALE, _MOST_LOG_SCALE)
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
    coefficients = gaussians.shN[order].transpose(0, 2, 1).reshape(count, rest)
    # A coefficient c in [-4, 4] is the byte (c / 8 + 1/2) 256.
    sh = np.clip((coefficients / _SH_RANGE + 0.5) * 256, 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {len(starts)}"]
    lines += [f"property float {name}" for name in _BOUNDS]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")
    bounds = np.hstack(tables).astype("<f4")
    return b"".join([header, bounds.tobytes(), packed.tobytes(), sh.tobytes()])


def decode_compressed_ply(path: Path) -> Gaussians:
    """The Gaussians in a compressed PLY.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is cut short, or does not hold what the format promises.
    """
    reader = ByteReader(path)
    header = parse_header(path, reader.data)
    reader.offset = header.size
    tables: dict[str, np.ndarray[Any, Any]] = {}
    with guarded(path, "a whole compressed PLY"):
        for element in header.elements:
            reader.record = f"element {element.name}"
            tables[element.name] = reader.array(header.dtype(element), element.num_rows)
        vertices, chunks = tables["vertex"], tables["chunk"]
        if not len(vertices) or len(chunks) != -(-len(vertices) // _CHUNK):
            raise ValueError(f"{len(chunks)} chunks for {len(vertices)} Gaussians")
        if any(vertices.dtype[name] != np.dtype("<u4") for name in _PACKED):
            raise ValueError("packed properties of another type than uint")
        chunk = np.arange(len(vertices)) // _CHUNK

        def within(name: str, layout: tuple[tuple[int, int], ...], first: int) -> np.ndarray:
            ends = _BOUNDS[first : first + 3], _BOUNDS[first + 3 : first + 6]
            low, high = (np.stack([chunks[each] for each in end], axis=1)[chunk] for end in ends)
            return np.asarray(low + _unpack(vertices[name], layout) * (high - low), np.float32)

        colors = _unpack(vertices[_PACKED[3]], _COLOR_BITS)
        # Files from before 2024 have no colour bounds at all.
        if set(_BOUNDS[12:]) & set(chunks.dtype.names or ()):
            colors = within(_PACKED[3], _COLOR_BITS, 12)
        turn = vertices[_PACKED[1]]
        three = (_unpack(turn, _THREE_BITS) - np.float32(0.5)) * np.float32(np.sqrt(2))
        return Gaussians(
            means=within(_PACKED[0], _VECTOR_BITS, 0),
            scales=within(_PACKED[2], _VECTOR_BITS, 6),
            quats=from_smallest_three((turn >> 30).astype(np.int64), three),
            opacities=opacity_logits((vertices[_PACKED[3]] & 255).astype(np.uint8)),
            sh0=((colors - np.float32(0.5)) / np.float32(SH_C0))[:, None],
            shN=_coefficients(tables.get("sh"), len(vertices)),
        )


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


def _coefficients(table: np.ndarray[Any, Any] | None, count: int) -> Float32[np.ndarray, "N K 3"]:
    """Colour coefficients beyond the first; the file stores all of red, then green, then blue."""
    names = [] if table is None else [n for n in table.dtype.names or () if n.startswith("f_rest_")]
    if table is None or not names:
        return np.zeros((count, 0, 3), np.float32)
    if len(table) != count or len(names) not in {3 * each for each in SH_COUNTS}:
        raise ValueError(f"{len(table)} rows of {len(names)} f_rest for {count} Gaussians")
    values = np.stack([table[f"f_rest_{i}"] for i in range(len(names))], axis=1)
    centers = (values.astype(np.float32) + np.float32(0.5)) / 256
    centers = np.where(values == 0, 0, np.where(values == 255, 1, centers)).astype(np.float32)
    rows = ((centers - np.float32(0.5)) * np.float32(_SH_RANGE)).reshape(count, 3, -1)
    return np.ascontiguousarray(rows.transpose(0, 2, 1))
