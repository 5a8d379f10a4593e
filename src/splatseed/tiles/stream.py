"""The part of a generator's stream that belongs to some of the new points.

In memory, a method draws ``rng.random((M, c), dtype=float32)``: a row for each of the M new points,
from PCG64 (M. O'Neill, PCG, 2014; NumPy's default), whose 128-bit state s goes to a s + b and gives
64 bits, two float32. After d steps it is a^d s + b (a^(d-1) + ... + 1), which takes log d products,
so that a tile finds the rows of its own points. Promise: the numbers are NumPy's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from splatseed.kernels.jit import inline, kernel, parallel_range

MULTIPLIER = 0x2360ED051FC65DA44385DF649FCCF645
"""PCG64's a."""
WORD = 1 << 64
JUMPS = 64
"""Powers of two that a jump is made of."""


def stream_state(rng: np.random.Generator) -> dict[str, str]:
    """Where a generator is, as JSON can hold it.

    Args:
        rng: A generator of PCG64 that stands between two of its 64-bit numbers.
    """
    state: Mapping[str, Any] = rng.bit_generator.state
    assert state["bit_generator"] == "PCG64"  # noqa: S101  (we made it)
    assert not state["has_uint32"]  # noqa: S101  (drawing bases takes whole numbers)
    return {name: str(state["state"][name]) for name in ("state", "inc")}


class TileDraws:
    """Draws for a tile's new points; stands in for a generator in ``place``.

    Args:
        state: Where the stream is when the first new point of all draws.
        total: New points of all tiles, M.
        start: First new point of each base, ascending, int64 [b].
        count: New points of each base, int64 [b].
    """

    def __init__(
        self,
        state: Mapping[str, str],
        total: int,
        start: Int64[np.ndarray, " b"],
        count: Int64[np.ndarray, " b"],
    ) -> None:
        self._state, self._step = int(state["state"]), int(state["inc"])
        self._total, self._start, self._count = total, start, count
        self._drawn = 0

    def random(self, size: Any, dtype: Any) -> Float32[np.ndarray, "..."]:
        """What the whole draw gives the tile's new points, float32 [m] or [m, c]."""
        assert dtype == np.float32  # noqa: S101  (other types take another number of bits)
        shape = (size,) if isinstance(size, (int, np.integer)) else tuple(size)
        columns = int(np.prod(shape[1:], dtype=np.int64))
        out = np.empty((shape[0], columns), np.float32)
        local = np.cumsum(self._count) - self._count
        first = self._drawn + self._start * columns
        powers = _powers(self._step)
        state = _words([self._state])[0]
        _fill(first, self._count * columns, local * columns, state, powers, out.reshape(-1))
        self._drawn += self._total * columns
        return out.reshape(shape)


def _powers(step: int) -> np.ndarray:
    """Factor and summand of 2^j steps for every j, uint64 [JUMPS, 2, 2], high words first."""
    factor, summand, rows = MULTIPLIER, step, []
    for _ in range(JUMPS):
        rows.append(_words([factor, summand]))
        factor, summand = factor * factor % WORD**2, (factor + 1) * summand % WORD**2
    return np.stack(rows)


def _words(numbers: list[int]) -> np.ndarray:
    return np.array([[number // WORD, number % WORD] for number in numbers], np.uint64)


@kernel
def _fill(first, count, local, state, powers, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Floats ``first[i] : first[i] + count[i]`` of the stream to ``out[local[i] :]``, for all i."""
    pieces = 64
    each = (len(first) + pieces - 1) // pieces
    for piece in parallel_range(pieces):
        # A generator steps before it answers: word w of the stream is the state after w + 1 steps.
        high, low = state[0], state[1]
        at = np.int64(-1)
        for i in range(piece * each, min((piece + 1) * each, len(first))):
            for f in range(count[i]):
                word = (first[i] + f) >> 1
                if word != at:
                    high, low = _advance(high, low, word - at, powers)
                    at = word
                bits = _output(high, low)
                if (first[i] + f) & 1:
                    bits = bits >> np.uint64(32)
                bits = (bits & np.uint64(0xFFFFFFFF)) >> np.uint64(8)
                out[local[i] + f] = np.float32(bits) * np.float32(1.0 / 16777216.0)


@inline
def _advance(high, low, steps, powers):  # type: ignore[no-untyped-def]  # Numba's types
    power = 0
    while steps > 0:
        if steps & 1:
            a, b = powers[power, 0], powers[power, 1]
            high, low = _multiply(high, low, a[0], a[1])
            high, low = _add(high, low, b[0], b[1])
        steps >>= 1
        power += 1
    return high, low


@inline
def _multiply(a_high, a_low, b_high, b_low):  # type: ignore[no-untyped-def]  # Numba's types
    """The low 128 bits of a product."""
    half, mask = np.uint64(32), np.uint64(0xFFFFFFFF)
    a0, a1, b0, b1 = a_low & mask, a_low >> half, b_low & mask, b_low >> half
    low, cross, other, high = a0 * b0, a1 * b0, a0 * b1, a1 * b1
    middle = (low >> half) + (cross & mask) + (other & mask)
    carried = high + (cross >> half) + (other >> half) + (middle >> half)
    return carried + a_high * b_low + a_low * b_high, a_low * b_low


@inline
def _add(a_high, a_low, b_high, b_low):  # type: ignore[no-untyped-def]  # Numba's types
    low = a_low + b_low
    carry = np.uint64(1) if low < a_low else np.uint64(0)
    return a_high + b_high + carry, low


@inline
def _output(high, low):  # type: ignore[no-untyped-def]  # Numba's types
    """PCG's XSL-RR: both words mixed, turned by the topmost six bits."""
    mixed, turn = high ^ low, high >> np.uint64(58)
    return (mixed >> turn) | (mixed << ((np.uint64(64) - turn) & np.uint64(63)))
