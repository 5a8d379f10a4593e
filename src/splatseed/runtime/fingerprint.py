"""Fingerprints of content: 128 bits of BLAKE2b, as 32 hexadecimal digits."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from typing import TypeAlias

import numpy as np

Part: TypeAlias = bytes | np.ndarray | object


def fingerprint(*parts: Part) -> str:
    """Hash parts in their order.

    Args:
        parts: Bytes count as they are, arrays with their shape and type (so that two parts never
            pass for one), and other values by their ``repr``.
    """
    return fingerprint_all(parts)


def fingerprint_all(parts: Iterable[Part]) -> str:
    """Hash parts as they come, such as the chunks of a file, which need not fit in memory."""
    digest = hashlib.blake2b(digest_size=16)
    for part in parts:
        if isinstance(part, bytes):
            digest.update(part)
        elif isinstance(part, np.ndarray):
            digest.update(repr((part.shape, part.dtype.str)).encode())
            digest.update(part.tobytes())
        else:
            digest.update(repr(part).encode("utf-8", "backslashreplace"))
    return digest.hexdigest()
