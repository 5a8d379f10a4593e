"""Permute, extract and sum lanes of ``simd``'s vectors.

Promise: as in ``simd``; only ``three_sums`` rounds, in a fixed summation tree.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from splatseed.runtime.simd import INDEX, LANES, VECTOR, f32x16

UNDEFINED = ir.Constant(VECTOR, ir.Undefined)
I32 = ir.IntType(32)


def permutation(pattern: Sequence[int]) -> Any:
    """Make an intrinsic whose result has lane ``pattern[j]`` of its argument in lane j.

    ``pattern`` is ``LANES`` numbers below ``LANES``.
    """
    lanes = [int(number) for number in pattern]

    @intrinsic
    def permute(typing_context, v):
        def generate(context, builder, signature, arguments):
            return _shuffle(builder, arguments[0], arguments[0], lanes)

        return f32x16(f32x16), generate

    return permute


def lane(number: int) -> Any:
    """Make an intrinsic that returns a lane of its argument as float32."""
    index = ir.Constant(I32, number)

    @intrinsic
    def take(typing_context, v):
        def generate(context, builder, signature, arguments):
            return builder.extract_element(arguments[0], index)

        return types.float32(f32x16), generate

    return take


def _shuffle(builder, a, b, lanes):
    """Select lanes of two vectors; those of b are numbered from ``LANES``."""
    return builder.shuffle_vector(a, b, ir.Constant(INDEX, list(lanes)))


@intrinsic
def three_sums(typing_context, a, b, c):
    """Return the sums of the lanes of a, b and c, in lanes 0, 4 and 8."""

    def generate(context, builder, signature, arguments):
        a, b, c = arguments
        # Add halves of a and c, then quarters of these and of b, in parallel.
        low, high = [*range(8), *range(16, 24)], [*range(8, 16), *range(24, 32)]
        ac = builder.fadd(_shuffle(builder, a, c, low), _shuffle(builder, a, c, high))
        bb = builder.fadd(b, _shuffle(builder, b, b, [(j + 8) % LANES for j in range(LANES)]))
        # ac holds a in 0-7, c in 8-15; bb holds b twice.
        low = [0, 1, 2, 3, 16, 17, 18, 19, 8, 9, 10, 11, 24, 25, 26, 27]
        total = builder.fadd(
            _shuffle(builder, ac, bb, low), _shuffle(builder, ac, bb, [j + 4 for j in low])
        )
        for step in (2, 1):
            moved = [j ^ step for j in range(LANES)]
            total = builder.fadd(total, _shuffle(builder, total, total, moved))
        return total

    return f32x16(f32x16, f32x16, f32x16), generate


@intrinsic
def triple(typing_context, a, b, c):
    """Return a vector with a, b, c in lanes 0, 1, 2; the other lanes are undefined."""

    def generate(context, builder, signature, arguments):
        vector = UNDEFINED
        for number, value in enumerate(arguments):
            vector = builder.insert_element(vector, value, ir.Constant(I32, number))
        return vector

    return f32x16(types.float32, types.float32, types.float32), generate
