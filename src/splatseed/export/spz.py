"""Niantic's .spz: quantised attributes one after another, gzipped (versions 1 to 3) or in zstd (4).

Notation: the file's axes are right, up, back (RUB), ours right, down, front: y and z change sign. f
is the number of *fractional_bits*. The form of each attribute stands beside the line that encodes
it. Source: nianticlabs/spz (load-spz.cc, splat-types.h).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from splatseed.export.packing import (
    SH_COUNTS,
    from_smallest_three,
    morton_order,
    opacity_bytes,
    opacity_logits,
    rounded_bytes,
    smallest_three,
)
from splatseed.io.files import COPY_AGAIN, guarded, read_bytes
from splatseed.requirements import require
from splatseed.runtime.memory import check_memory
from splatseed.splat.gaussians import Gaussians

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_STREAMS = struct.Struct("<I12x")
"""Follows the header in version 4: the offset of the stream table."""
_SIZES = struct.Struct("<QQ")
_WRITTEN = 3
"""The version that is written: the latest that every reader accepts."""
_MOST_FRACTIONAL_BITS = 20
_MOST = 2**23 - 1
"""Largest position in units of 2^-f: 24 bits with a sign."""
_NINE_BITS = 511
_COLOR = 0.15 * 255
"""Bytes per unit of the first coefficient: the format's scale."""
_AXES = np.array([1, -1, -1], np.float32)
_SH_AXES = np.array([-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1], np.float32)
"""Signs of the spherical harmonics of degrees 1 to 3 when y and z are flipped."""
_XYZW = [1, 2, 3, 0]
"""Order of the file's quaternion components in ours."""
_STEP = 4
"""Further coefficients are rounded to this many 128ths, so that gzip saves more. Niantic's writer
takes 8 for the first degree and 16 for the others: files are a quarter smaller, but coefficients of
a short run vanish, and with them up to 2.8 dB (docs/formats.md)."""


@dataclass(frozen=True)
class _Header:
    version: int
    count: int
    degree: int
    fractional_bits: int

    @property
    def sizes(self) -> list[int]:
        """Bytes per Gaussian for position, opacity, colour, scale, rotation, harmonics."""
        position = 6 if self.version == 1 else 9
        rotation = 3 if self.version < 3 else 4
        return [position, 1, 3, 3, rotation, 3 * SH_COUNTS[self.degree]]


def encode(gaussians: Gaussians) -> bytes:
    """The bytes of a file with the Gaussians, in Z-curve order, of degree 3 at most."""
    order = morton_order(gaussians.means)
    rest = gaussians.shN.shape[1]
    farthest = float(np.abs(gaussians.means).max())
    bits = int(np.clip(np.floor(np.log2(_MOST / max(farthest, 1e-9))), 0, _MOST_FRACTIONAL_BITS))
    # A position in units of 2^-f; a coefficient c beyond the first as 128 c + 128.
    fixed = np.rint(gaussians.means[order] * _AXES * np.float64(2**bits)).astype("<i4")
    sh = np.rint(gaussians.shN[order] * _SH_AXES[:rest, None] * 128 + 128)
    parts = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],  # 24 bits a component
        opacity_bytes(gaussians.opacities[order]),
        rounded_bytes(gaussians.sh0[order, 0] * _COLOR + 127.5),  # 255 (0.15 c + 1/2)
        rounded_bytes((gaussians.scales[order] + 10) * 16),  # of log-scales
        _packed_quats(gaussians.quats[order] * np.append(np.float32(1), _AXES)).view(np.uint8),
        rounded_bytes(np.floor((sh + _STEP // 2) / _STEP) * _STEP),
    ]
    degree = SH_COUNTS.index(rest)
    header = _HEADER.pack(_MAGIC, _WRITTEN, len(order), degree, bits, 0, 0)
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    return gzip.compress(header + body, 6, mtime=0)


def decode(path: Path) -> Gaussians:
    """The Gaussians in a file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is damaged, or its version is unknown.
        MissingDependencyError: It is of version 4, and zstandard is absent.
    """
    data = read_bytes(path)
    with guarded(path, "a whole .spz"):
        header, parts = _zstd_parts(data) if data.startswith(_MAGIC) else _gzip_parts(data)
        position, opacity, color, scale, rotation, sh = parts
        rest = SH_COUNTS[header.degree]
        harmonics = (sh.reshape(header.count, rest, 3).astype(np.float32) - 128) / 128
        return Gaussians(
            means=_positions(position, header) * _AXES,
            scales=(scale / 16 - 10).astype(np.float32),
            quats=_quats(rotation, header.version) * np.append(np.float32(1), _AXES),
            opacities=opacity_logits(opacity[:, 0]),
            sh0=((color - 127.5) / _COLOR).astype(np.float32)[:, None],
            shN=np.asarray(harmonics * _SH_AXES[:rest, None], np.float32),
        )


def _packed_quats(quats: Float32[np.ndarray, "N 4"]) -> np.ndarray:
    """From the highest bits: the index of the largest component, then signs and sizes of others."""
    largest, three = smallest_three(quats[:, _XYZW])
    packed = largest.astype(np.uint32)
    for i in range(3):
        size = np.rint(np.abs(three[:, i]) * np.float32(_NINE_BITS * np.sqrt(2)))
        part = np.minimum(size, _NINE_BITS).astype(np.uint32)
        packed = (packed << 10) | ((three[:, i] < 0).astype(np.uint32) << 9) | part
    return np.asarray(packed, "<u4")


def _quats(raw: UInt8[np.ndarray, "N B"], version: int) -> Float32[np.ndarray, "N 4"]:
    if version < 3:  # a byte for each of x, y, z; w >= 0 follows
        xyz = raw / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
        return np.hstack([w, xyz]).astype(np.float32)
    # 2 bits for the index of the largest component; a sign and 9 bits for each other one.
    packed = np.ascontiguousarray(raw).view("<u4")[:, 0]
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    size = (fields & _NINE_BITS) / np.float32(_NINE_BITS * np.sqrt(2))
    three = np.where(fields >> 9, -size, size).astype(np.float32)
    xyzw = from_smallest_three((packed >> 30).astype(np.int64), three)
    return xyzw[:, [3, 0, 1, 2]]


def _positions(raw: UInt8[np.ndarray, "N B"], header: _Header) -> Float32[np.ndarray, "N 3"]:
    if header.version == 1:  # half floats
        return np.ascontiguousarray(raw).view("<f2").astype(np.float32)
    digits = raw.reshape(-1, 3, 3).astype(np.int32)
    fixed: Int64[np.ndarray, "N 3"] = digits[..., 0] | digits[..., 1] << 8 | digits[..., 2] << 16
    fixed = np.where(fixed > _MOST, fixed - 2**24, fixed)
    return (fixed / 2.0**header.fractional_bits).astype(np.float32)


def _header(data: bytes) -> _Header:
    _, version, count, degree, fractional_bits, _, _ = _HEADER.unpack_from(data)
    if not 1 <= version <= 4:
        raise ValueError(f"version {version}; versions 1 to 4 are known")
    if degree >= len(SH_COUNTS) or count == 0 or fractional_bits > 24:
        raise ValueError(f"{count} Gaussians of degree {degree}, {fractional_bits} fractional bits")
    header = _Header(version, count, degree, fractional_bits)
    check_memory(count, sum(header.sizes), "Gaussians", fix=COPY_AGAIN)
    return header


def _gzip_parts(data: bytes) -> tuple[_Header, list[UInt8[np.ndarray, "N B"]]]:
    """The parts of versions 1 to 3, up to the size in the header: no zip bomb is unpacked."""
    stream = zlib.decompressobj(wbits=31)
    header = _header(stream.decompress(data, _HEADER.size))
    wanted = header.count * sum(header.sizes)
    body = stream.decompress(stream.unconsumed_tail, wanted)
    more = stream.decompress(stream.unconsumed_tail, 1)
    if len(body) < wanted or not (stream.eof or more):
        raise ValueError(f"a stream that ends after {len(body):,} of {wanted:,} bytes")
    ends = header.count * np.cumsum(header.sizes)[:-1]
    parts = np.split(np.frombuffer(body, np.uint8), ends)
    return header, [part.reshape(header.count, -1) for part in parts]


def _zstd_parts(data: bytes) -> tuple[_Header, list[UInt8[np.ndarray, "N B"]]]:
    """The parts of version 4; empty parts have no stream."""
    require("zstandard")
    import zstandard  # noqa: PLC0415  (of the extra view)

    header = _header(data)
    (table,) = _STREAMS.unpack_from(data, _HEADER.size)
    at = table + _SIZES.size * sum(size > 0 for size in header.sizes)
    parts: list[UInt8[np.ndarray, "N B"]] = []
    for size in header.sizes:
        content = b""
        if size:
            packed, _ = _SIZES.unpack_from(data, table + _SIZES.size * len(parts))
            content = zstandard.ZstdDecompressor().decompress(
                data[at : at + packed], max_output_size=header.count * size
            )
            at += packed
        parts.append(np.frombuffer(content, np.uint8).reshape(header.count, size))
    return header, parts
