"""Writes PlayCanvas's compressed PLY, which splatseed only reads: chunks of 256 in given order."""

from __future__ import annotations

import numpy as np

from splatseed.splat.compressed_ply import _BOUNDS, _PACKED
from splatseed.splat.formats import write_gaussians
from splatseed.splat.gaussians import SH_C0, antialiased_comment
from splatseed.splat.packing import opacity_bytes, smallest_three


def write_any(path, gaussians):
    """Write any format that is read."""
    if path.name.endswith(".compressed.ply"):
        path.write_bytes(encode(gaussians))
    else:
        write_gaussians(path, gaussians)


def encode(gaussians):
    count, rest = len(gaussians), 3 * gaussians.shN.shape[1]
    starts = np.arange(0, count, 256)
    tables, packed = [], np.zeros((count, 4), "<u4")
    columns = (
        (0, (21, 11, 0), gaussians.means),
        (2, (21, 11, 0), np.clip(gaussians.scales, -20, 20)),
    )
    columns += ((3, (24, 16, 8), gaussians.sh0[:, 0] * SH_C0 + 0.5),)
    for column, shifts, values in columns:
        low, high = (end.reduceat(values, starts, axis=0) for end in (np.minimum, np.maximum))
        tables += [low, high]
        extent = np.where(high > low, high - low, 1)
        chunk = np.arange(count) // 256
        bits = (8, 8, 8) if column == 3 else (11, 10, 11)
        packed[:, column] = _pack((values - low[chunk]) / extent[chunk], shifts, bits)
    packed[:, 3] |= opacity_bytes(gaussians.opacities)
    largest, three = smallest_three(gaussians.quats)
    packed[:, 1] = _pack(three * np.sqrt(0.5) + 0.5, (20, 10, 0), (10, 10, 10))
    packed[:, 1] |= largest.astype(np.uint32) << 30
    coefficients = gaussians.shN.transpose(0, 2, 1).reshape(count, rest)
    sh = np.clip((coefficients / 8 + 0.5) * 256, 0, 255).astype(np.uint8)
    lines = ["ply", "format binary_little_endian 1.0", *antialiased_comment(gaussians.antialiased)]
    lines += [f"element chunk {len(starts)}"]
    lines += [f"property float {name}" for names in _BOUNDS for name in names]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    header = "\n".join([*lines, "end_header\n"]).encode()
    return header + np.hstack(tables).astype("<f4").tobytes() + packed.tobytes() + sh.tobytes()


def _pack(units, shifts, bits):
    packed = np.zeros(len(units), np.uint32)
    for unit, shift, each in zip(units.T, shifts, bits, strict=True):
        packed |= np.rint(np.clip(unit, 0, 1) * (2**each - 1)).astype(np.uint32) << np.uint32(shift)
    return packed
