"""Read and write Niantic's .spz: one attribute after another, in gzip or zstd (version 4).

Axes are right, up, back, unless an extension names others; ours are right, down, front: y and z
change sign. Programs that do not convert axes (Niantic's ply_to_spz, PlayCanvas's splat-transform)
store ours without a record of it: their models are read turned by 180 degrees about x, which
``model_frame`` finds out where a scene is known. Source: nianticlabs/spz (load-spz.cc,
splat-types.h, extensions).
"""

from __future__ import annotations

import gzip
import struct
import zlib
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import COPY_AGAIN, read_bytes, translate_errors
from splatseed.progress import Note, silent_note
from splatseed.requirements import require
from splatseed.runtime.memory import check_memory
from splatseed.splat.gaussians import SH_COUNTS, Gaussians
from splatseed.splat.packing import (
    Fit,
    best_fit,
    clipped_findings,
    coarse_findings,
    from_smallest_three,
    left_out_finding,
    morton_order,
    opacity_bytes,
    opacity_logits,
    rounded_bytes,
    smallest_three,
)

MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")
_VERSION = 3  # the latest that every reader accepts
_MAX_FIXED, _MAX_BITS = 2**23 - 1, 20
"""Largest position in units of 2^-f (24 bits with a sign), and the largest f."""
_ANTIALIASED, _EXTENDED = 1, 2
"""Flags of models that need antialiased rendering, and of files with extensions."""
_AXES_EXTENSION, _RIGHT_UP_BACK = 0xADBE0003, 4
"""Type of the extension with the axes (SPZ_ADOBE_coordinate_system), and the default axes. Axes
from 1 to 8 are 1 + 1 (x is right, not left) + 2 (y is up, not down) + 4 (z is front, not back)."""
_MAX_EXTENSIONS = 1 << 20
"""Maximum bytes of extensions; more is a damaged file."""
_SH_COUNTS = (*SH_COUNTS, 24)
"""Coefficients beyond the first by degree; those of degree 4 are not used."""
_LOG_SCALES = (-10.0, 255 / 16 - 10)
"""Log-scales that a byte holds."""
_MAX_LOST_SHARE = 0.1
"""Share of the image that may be lost with Gaussians beyond the largest position."""
_NINE_BITS = np.float32(511 * np.sqrt(2))
_COLOR = 0.15 * 255
"""Bytes per unit of the first coefficient: the format's scale."""


class AxisSigns(NamedTuple):
    """Signs that turn a model's axes into ours: of positions, of wxyz, and of harmonics."""

    position: Float32[np.ndarray, " 3"]
    quat: Float32[np.ndarray, " 4"]
    sh: Float32[np.ndarray, " 15"]  # of degrees 1 to 3


def axis_signs(axes: int) -> AxisSigns:
    """Return the signs that turn axes, by their number in the extension, into ours."""
    right, up, front = (bool((axes - 1) >> bit & 1) for bit in range(3))
    x, y, z = 1 if right else -1, -1 if up else 1, 1 if front else -1
    sh = [y, z, x, x * y, y * z, 1, x * z, 1, y, x * y * z, y, z, x, z, x]
    rows = [x, y, z], [1, y * z, x * z, x * y], sh
    return AxisSigns(*(np.array(row, np.float32) for row in rows))


_OWN = axis_signs(_RIGHT_UP_BACK)
_FIRST, _FURTHER = (-127.5 / _COLOR, 127.5 / _COLOR), (-1.0, 127 / 128)
"""First and further coefficients that bytes hold."""
_STEP = 4
"""Harmonics are rounded to multiples of this many 128ths, which compress better. Niantic's writer
uses 8 for degree 1 and 16 beyond it: files are a quarter smaller, but the small coefficients of a
short run vanish, and PSNR falls by up to 2.8 dB."""


def encode(gaussians: Gaussians, note: Note = silent_note) -> list[bytes]:
    """Encode Gaussians in Z-curve order."""
    gaussians, bits = _fixed_point(gaussians, note)
    order = morton_order(gaussians.means)
    rest = gaussians.shN.shape[1]
    # Positions in units of 2^-f; a harmonic c as 128 c + 128.
    fixed = np.rint(gaussians.means[order] * _OWN.position * np.float64(2**bits)).astype("<i4")
    sh = np.rint(gaussians.shN[order] * _OWN.sh[:rest, None] * 128 + 128)
    # From the highest bits: index of the largest of xyzw, then sign and size of each other one.
    quats = gaussians.quats[order] * _OWN.quat
    largest, three = smallest_three(np.roll(quats, -1, axis=1))
    rotation = largest.astype(np.uint32)
    for i in range(3):
        part = np.minimum(np.rint(np.abs(three[:, i]) * _NINE_BITS), 511).astype(np.uint32)
        rotation = (rotation << 10) | ((three[:, i] < 0).astype(np.uint32) << 9) | part
    parts = [
        fixed.view(np.uint8).reshape(-1, 4)[:, :3],  # 24 bits per component
        opacity_bytes(gaussians.opacities[order]),
        rounded_bytes(gaussians.sh0[order, 0] * _COLOR + 127.5),  # 255 (0.15 c + 1/2)
        rounded_bytes((gaussians.scales[order] + 10) * 16),
        rotation.astype("<u4"),
        rounded_bytes(np.floor((sh + _STEP // 2) / _STEP) * _STEP),
    ]
    degree = SH_COUNTS.index(rest)
    flags = _ANTIALIASED * gaussians.antialiased
    header = _HEADER.pack(MAGIC, _VERSION, len(order), degree, bits, flags, 0)
    body = b"".join(np.ascontiguousarray(part).tobytes() for part in parts)
    return [gzip.compress(header + body, 6, mtime=0)]


def _fixed_point(gaussians: Gaussians, note: Note) -> tuple[Gaussians, int]:
    """Return the Gaussians within the format's range, and the fractional bits of positions.

    The bits are the most that can represent every position; distant Gaussians are dropped where
    keeping them would cost the others more.
    """
    farthest = np.abs(gaussians.means.astype(np.float64)).max(axis=1)
    fits = [Fit(farthest <= _MAX_FIXED / 2.0**bits, 2.0**-bits) for bits in range(_MAX_BITS + 1)]
    complete = [bits for bits, fit in enumerate(fits) if fit.kept.all()]
    first = max(complete, default=0)
    chosen, lost, coarse = best_fit(gaussians, fits[first:])
    bits = first + chosen
    kept, limit = fits[bits].kept, _MAX_FIXED / 2.0**bits
    if not kept.any() or (not complete and lost > _MAX_LOST_SHARE):
        raise ParameterError(
            f"positions within {_MAX_FIXED:,} units of the origin, the range of .spz",
            found=f"one at {farthest.max():.3g}",
            fix="Export another format, or crop the model.",
        )
    if not kept.all():
        note(left_out_finding(".spz", kept, f"more than {limit:,.4g} units from the origin"))
    steps = f"up to {limit:,.4g} units from the origin in steps of {2.0**-bits:.3g}, "
    findings = coarse_findings(".spz", coarse, kept, steps)
    kept_ones = gaussians if kept.all() else gaussians.select(kept)
    findings += clipped_findings(
        ".spz", kept_ones, sizes=_LOG_SCALES, first=_FIRST, further=_FURTHER
    )
    for finding in findings:
        note(finding)
    return kept_ones, bits


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode an .spz of version 1 to 4; version 4 needs zstandard."""
    data = read_bytes(path)
    with translate_errors(path, "a complete .spz"):
        stream = zlib.decompressobj(wbits=31)
        in_zstd = data.startswith(MAGIC)
        header = data if in_zstd else stream.decompress(data, _HEADER.size)
        _, version, count, degree, bits, flags, _ = _HEADER.unpack_from(header)
        if not 1 <= version <= 4:
            raise ValueError(f"version {version}; versions 1 to 4 are known")
        if degree >= len(_SH_COUNTS) or count == 0 or bits > 24:
            raise ValueError(f"{count} Gaussians of degree {degree}, {bits} fractional bits")
        rest = _SH_COUNTS[degree]
        # Position, opacity, colour, scale, rotation, harmonics: bytes per Gaussian.
        sizes = [6 if version == 1 else 9, 1, 3, 3, 3 if version < 3 else 4, 3 * rest]
        check_memory(count, sum(sizes), "Gaussians", fix=COPY_AGAIN)
        num_bytes = count * sum(sizes)
        if in_zstd:
            body, extensions = _zstd_parts(data, count, [size for size in sizes if size])
        else:  # limited to the header's size: no zip bomb is unpacked
            body, extensions = stream.decompress(stream.unconsumed_tail, num_bytes), b""
        if not (in_zstd or stream.eof):  # also reads the checksum
            extensions = stream.decompress(stream.unconsumed_tail, _MAX_EXTENSIONS)
        if len(body) != num_bytes or not (in_zstd or stream.eof):
            raise ValueError(f"a stream that ends after {len(body):,} of {num_bytes:,} bytes")
        signs = axis_signs(_axes_in(path, extensions) if flags & _EXTENDED else _RIGHT_UP_BACK)
        parts = np.split(np.frombuffer(body, np.uint8), count * np.cumsum(sizes)[:-1])
        position, opacity, color, scale, rotation, sh = (part.reshape(count, -1) for part in parts)
        harmonics = (sh.reshape(count, rest, 3).astype(np.float32) - 128) / 128
        if rest > (limit := SH_COUNTS[-1]):
            text = f"Of {rest} coefficients beyond the first, {limit} (degree 3) are used."
            note(Finding("unused-harmonics", text))
            rest, harmonics = limit, harmonics[:, :limit]
        if version == 1:  # half floats
            means = np.ascontiguousarray(position).view("<f2").astype(np.float32)
        else:
            digits = position.reshape(-1, 3, 3).astype(np.int32)
            fixed = digits[..., 0] | digits[..., 1] << 8 | digits[..., 2] << 16
            fixed = np.where(fixed > _MAX_FIXED, fixed - 2**24, fixed)
            means = (fixed / 2.0**bits).astype(np.float32)
        return Gaussians(
            means=means * signs.position,
            scales=(scale / 16 - 10).astype(np.float32),
            quats=_quats(rotation) * signs.quat,
            opacities=opacity_logits(opacity[:, 0]),
            sh0=((color - 127.5) / _COLOR).astype(np.float32)[:, None],
            shN=np.asarray(harmonics * signs.sh[:rest, None], np.float32),
            antialiased=bool(flags & _ANTIALIASED),
        )


def _axes_in(path: Path, extensions: bytes) -> int:
    """Return the axes that extensions name; each has its type, its length and its content."""
    at, axes = 0, _RIGHT_UP_BACK
    while at + 8 <= len(extensions):
        kind, length = struct.unpack_from("<II", extensions, at)
        if kind == _AXES_EXTENSION:
            (axes,) = struct.unpack_from("<I", extensions, at + 8)
        at += 8 + length
    if axes > 8:
        raise SceneFormatError(
            f"{path} with y up or down, and z front or back",
            found=f"other axes, of number {axes}, in SPZ_ADOBE_coordinate_system",
            fix="Export it with the axes right, up, back.",
        )
    return axes or _RIGHT_UP_BACK  # 0: unspecified


def _zstd_parts(data: bytes, count: int, sizes: list[int]) -> tuple[bytes, bytes]:
    """Decompress the attributes of version 4; also return its extensions.

    Its header of 32 bytes, with the offset of the attributes' table, precedes the extensions.
    """
    require("zstandard")
    import zstandard  # noqa: PLC0415  (optional: extra `view`)

    (table,) = struct.unpack_from("<I", data, _HEADER.size)
    at, body = table + 16 * len(sizes), b""
    for i, size in enumerate(sizes):
        length, _ = struct.unpack_from("<QQ", data, table + 16 * i)
        body += zstandard.ZstdDecompressor().decompress(
            data[at : at + length], max_output_size=count * size
        )
        at += length
    return body, data[2 * _HEADER.size : table]


def _quats(raw: UInt8[np.ndarray, "N B"]) -> Float32[np.ndarray, "N 4"]:
    if raw.shape[1] == 3:  # a byte for each of x, y, z; w >= 0 follows
        xyz = raw / np.float32(127.5) - 1
        w = np.sqrt(np.maximum(1 - (xyz**2).sum(axis=1, keepdims=True), 0))
        return np.hstack([w, xyz]).astype(np.float32)
    packed = np.ascontiguousarray(raw).view("<u4")[:, 0]
    fields = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    size = (fields & 511) / _NINE_BITS
    three = np.where(fields >> 9, -size, size).astype(np.float32)
    return np.roll(from_smallest_three((packed >> 30).astype(np.int64), three), 1, axis=1)
