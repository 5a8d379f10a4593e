"""Search for rows of variable length in binary PLY files."""

import numpy as np

from splatseed.runtime.jit import inline


@inline
def find_rows(
    data: np.ndarray,  # uint8 [B]
    at: int,
    runs: np.ndarray,  # int64 [K, 3]
    is_big: bool,
    starts: np.ndarray,  # int64 [R, K]
) -> tuple[int, int]:
    """Fill where each run of scalars starts, in up to R rows from ``at`` on.

    ``runs`` has the bytes of each run, of the length of the list after it (0: none), and of a value
    of the list. Returns the number of complete rows, and where the next one starts.
    """
    for row in range(len(starts)):
        place = at
        for k in range(len(runs)):
            starts[row, k] = place
            place += runs[k, 0]
            width, count = runs[k, 1], np.int64(0)
            if place + width > len(data):
                return row, at
            for i in range(width):
                byte = data[place + i] if is_big else data[place + width - 1 - i]
                count = count * 256 + np.int64(byte)
            if count < 0 or count > len(data):
                return row, at
            place += width + count * runs[k, 2]
        if place > len(data):
            return row, at
        at = place
    return len(starts), at
