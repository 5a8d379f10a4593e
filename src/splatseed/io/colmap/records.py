"""Kernels over the variable-length records of a COLMAP ``points3D.bin``.

Notation: N records, T observations in all. A record is a head of 51 bytes (u64 id, 3 f64 position,
3 u8 colour, f64 error, u64 track length L), then L pairs of u32 (image id, feature index), all
little-endian and unaligned. ``starts`` [N + 1] are byte offsets of the records, ended by the end of
the last. Promise: no byte outside the buffers is touched whatever the track lengths say. Importing
this module imports Numba, so readers do it only when they hold such a file.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Int64, UInt8

from splatseed.kernels.jit import inline

__all__ = ["HEAD_BYTES", "PAIR_BYTES", "join_records", "scan_records", "split_records"]

HEAD_BYTES = 51
PAIR_BYTES = 8
_LENGTH_AT = 43  # of the track length within a head


@inline
def scan_records(
    buffer: UInt8[np.ndarray, " B"], first: int, starts: Int64[np.ndarray, " N+1"]
) -> int:
    """Fill ``starts`` with the offsets of the records that begin at ``first``.

    Returns:
        The number of records that lie whole inside the buffer; less than N if the buffer ends
        within record ``starts[returned value]``.
    """
    at = np.int64(first)
    for i in range(len(starts) - 1):
        starts[i] = at
        room = len(buffer) - at - HEAD_BYTES
        if room < 0:
            return i
        length = np.uint64(0)
        for k in range(8):
            length |= np.uint64(buffer[at + _LENGTH_AT + k]) << np.uint64(8 * k)
        # Compared as uint64: a length of 2^63 or more would turn negative as int64.
        if length > np.uint64(room // PAIR_BYTES):
            return i
        at += HEAD_BYTES + PAIR_BYTES * np.int64(length)
    starts[-1] = at
    return len(starts) - 1


@inline
def split_records(
    buffer: UInt8[np.ndarray, " B"],
    starts: Int64[np.ndarray, " N+1"],
    heads: UInt8[np.ndarray, "N 51"],
    pairs: UInt8[np.ndarray, " 8*T"],
) -> None:
    """Copy the heads and the tracks of scanned records apart; the inverse of ``join_records``."""
    out = 0
    for i in range(len(heads)):
        at = starts[i]
        for k in range(HEAD_BYTES):
            heads[i, k] = buffer[at + k]
        for k in range(at + HEAD_BYTES, starts[i + 1]):
            pairs[out] = buffer[k]
            out += 1


@inline
def join_records(
    heads: UInt8[np.ndarray, "N 51"],
    pairs: UInt8[np.ndarray, " 8*T"],
    starts: Int64[np.ndarray, " N+1"],
    buffer: UInt8[np.ndarray, " B"],
) -> None:
    """Interleave heads and tracks into ``buffer``, record i at ``starts[i]``."""
    taken = 0
    for i in range(len(heads)):
        at = starts[i]
        for k in range(HEAD_BYTES):
            buffer[at + k] = heads[i, k]
        for k in range(at + HEAD_BYTES, starts[i + 1]):
            buffer[k] = pairs[taken]
            taken += 1
