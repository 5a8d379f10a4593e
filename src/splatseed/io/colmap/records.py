"""The variable-length records of a COLMAP ``points3D.bin``, taken apart and put together.

Notation: N records, T observations in all. A record is a head of 51 bytes (u64 id, 3 f64 position,
3 u8 colour, f64 error, u64 track length L), then L pairs of u32 (image id, feature index), all
little-endian and unaligned. ``starts`` [N + 1] are byte offsets of the records, ended by the end of
the last. Promise: no byte outside the buffers is touched whatever the track lengths say; a million
records take some tenths of a second, without Numba, which takes longer to load.
"""

from __future__ import annotations

import struct

import numpy as np
from jaxtyping import Int64, UInt8

__all__ = ["HEAD_BYTES", "PAIR_BYTES", "join_records", "scan_records", "split_records"]

HEAD_BYTES = 51
PAIR_BYTES = 8
_LENGTH_AT = 43  # of the track length within a head
_LENGTH = struct.Struct("<Q")


def scan_records(data: bytes, first: int, count: int) -> Int64[np.ndarray, " K+1"]:
    """The offsets of ``count`` records that begin at ``first``, then the end of the last.

    Returns:
        Offsets of the K records that lie whole inside the data, and where the next one begins; K is
        less than ``count`` if the data ends within that one.
    """
    at, last = first, len(data) - HEAD_BYTES
    starts = [at]
    length_at = _LENGTH.unpack_from
    for _ in range(count):  # a record's place is known only from the one before it
        if at > last:
            break
        at += HEAD_BYTES + PAIR_BYTES * length_at(data, at + _LENGTH_AT)[0]
        if at > len(data):
            break
        starts.append(at)
    return np.array(starts, np.int64)


def split_records(
    buffer: UInt8[np.ndarray, " B"], starts: Int64[np.ndarray, " N+1"]
) -> tuple[UInt8[np.ndarray, " 51*N"], UInt8[np.ndarray, " 8*T"]]:
    """The heads and the tracks of scanned records, apart; the inverse of ``join_records``."""
    heads = _anywhere(buffer, HEAD_BYTES)[starts[:-1]]
    pairs = _anywhere(buffer, PAIR_BYTES)[_pair_offsets(starts)]
    return heads.view(np.uint8), pairs.view(np.uint8)


def join_records(
    heads: UInt8[np.ndarray, " 51*N"],
    pairs: UInt8[np.ndarray, " 8*T"],
    starts: Int64[np.ndarray, " N+1"],
) -> UInt8[np.ndarray, " B"]:
    """Heads and tracks interleaved, record i at ``starts[i]``."""
    buffer = np.empty(starts[-1], np.uint8)
    _anywhere(buffer, HEAD_BYTES)[starts[:-1]] = heads.view(f"V{HEAD_BYTES}")
    _anywhere(buffer, PAIR_BYTES)[_pair_offsets(starts)] = pairs.view(f"V{PAIR_BYTES}")
    return buffer


def _anywhere(buffer: UInt8[np.ndarray, " B"], size: int) -> np.ndarray:
    """The ``size`` bytes from each byte of a buffer on, as one element: a view."""
    return np.ndarray(max(len(buffer) - size + 1, 0), f"V{size}", buffer, strides=(1,))


def _pair_offsets(starts: Int64[np.ndarray, " N+1"]) -> Int64[np.ndarray, " T"]:
    """Where each observation stands."""
    lengths = (np.diff(starts) - HEAD_BYTES) // PAIR_BYTES
    before = np.cumsum(lengths) - lengths
    offsets = np.repeat(starts[:-1] + HEAD_BYTES - PAIR_BYTES * before, lengths)
    offsets += PAIR_BYTES * np.arange(len(offsets))
    return offsets
