"""Read-only arrays for the fields of frozen dataclasses.

A writable array is copied, so that the caller's array and its flags do not change; a read-only one
is shared.
"""

from __future__ import annotations

import mmap
from typing import Any

import numpy as np


def read_only(values: Any, dtype: Any = None) -> np.ndarray:
    """Return ``values`` as a contiguous read-only array, copied only if necessary."""
    array = np.asarray(values, dtype, order="C")
    is_own = array.base is None and array is not values  # conversion has copied it
    if not is_own and not _is_frozen(array):
        array = array.copy()
    array.flags.writeable = False
    return array


def freeze(record: object, *names: str) -> None:
    """Replace arrays of a frozen record by read-only ones."""
    for name in names:
        object.__setattr__(record, name, read_only(getattr(record, name)))


def read_only_view(array: np.ndarray) -> np.ndarray:
    """Return a read-only view of an array that may be writable.

    Numba takes read-only arrays for another type: a kernel that is given both compiles twice.
    """
    view = array.view()
    view.flags.writeable = False
    return view


def _is_frozen(array: np.ndarray) -> bool:
    """Whether neither the array nor any owner of its memory is writable."""
    owner: Any = array
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    if isinstance(owner, memoryview):
        return owner.readonly
    return owner is None or isinstance(owner, bytes | mmap.mmap)
