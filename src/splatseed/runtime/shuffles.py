"""Lanes of ``simd``'s vectors: moved in fixed patterns, and extracted.

Promise: as in ``simd``; only ``three_sums`` rounds, and its summation tree is fixed.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"

from __future__ import annotations

from collections.abc import Sequence

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

from splatseed.runtime.simd import INDEX, LANES, VECTOR, f32x16

UNDEFINED = ir.Constant(VECTOR, ir.Undefined)
I32 = ir.IntType(32)


def permutation(pattern: Sequence[int]):
    """An intrinsic: lane j of its result is lane ``pattern[j]`` of its argument.

    Args:
        pattern: ``LANES`` numbers below ``LANES``.
    """
    lanes = [int(each) for each in pattern]

    @intrinsic
    def permute(typing_context, v):
        def generate(context, builder, signature, arguments):
            return _shuffle(builder, arguments[0], arguments[0], lanes)

        return f32x16(f32x16), generate

    return permute


def lane(number: int):
    """An intrinsic: one lane of its argument, as float32."""
    index = ir.Constant(I32, number)

    @intrinsic
    def take(typing_context, v):
        def generate(context, builder, signature, arguments):
            return builder.extract_element(arguments[0], index)

        return types.float32(f32x16), generate

    return take


def _shuffle(builder, a, b, lanes):
    """Lanes of two vectors; b's are numbered from ``LANES``."""
    return builder.shuffle_vector(a, b, ir.Constant(INDEX, list(lanes)))


@intrinsic
def three_sums(typing_context, a, b, c):
    """The sums of the lanes of a, b and c, in lanes 0, 4 and 8 of the result."""

    def generate(context, builder, signature, arguments):
        a, b, c = arguments
        # Halves of a and c, then quarters of those and of b, side by side.
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
    """a, b and c in lanes 0, 1 and 2; the others hold anything."""

    def generate(context, builder, signature, arguments):
        vector = UNDEFINED
        for number, each in enumerate(arguments):
            vector = builder.insert_element(vector, each, ir.Constant(I32, number))
        return vector

    return f32x16(types.float32, types.float32, types.float32), generate
