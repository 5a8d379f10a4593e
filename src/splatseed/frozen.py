"""Arrays that nobody can change, for the fields of frozen data types.

Promise: an array that someone can still write to is copied, so neither the caller's array nor its
flags change; one that is read-only to everybody is shared.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np


def read_only(values: Any, dtype: Any = None) -> np.ndarray:
    """``values`` as a contiguous array that is read-only; a copy only if it must be one."""
    array = np.asarray(values, dtype, order="C")
    is_own = array.base is None and array is not values  # conversion has copied it
    if not is_own and not _is_frozen(array):
        array = array.copy()
    array.flags.writeable = False
    return array


def _is_frozen(array: np.ndarray) -> bool:
    """Whether neither the array nor one whose memory it shares can be written to."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    if isinstance(owner, memoryview):
        return owner.readonly
    return owner is None or isinstance(owner, bytes | mmap.mmap)
