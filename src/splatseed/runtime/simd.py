"""Vectors of sixteen float32 lanes for kernels: a Numba type held in vector registers.

Auto-vectorisation fails on the rasteriser's loops, which branch, carry state over Gaussians and end
early; scalar code is five to eight times slower. These vectors are LLVM's ``<16 x float>``: one
AVX-512 register, which LLVM splits in two on AVX2 and in four on NEON.
Promise: every operation is the exact float32 operation in each lane, in the order written; sums
over lanes use a fixed tree. Nothing is ``fastmath``, so results do not depend on how a kernel was
compiled or cached. Indices into arrays must not be negative: counting from the end, as NumPy does,
takes several instructions even if it never happens.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, register_model

from splatseed.runtime.jit import inline

LANES = 16
QUARTER = LANES // 4
"""Vectors per call of ``load_columns``."""
VECTOR = ir.VectorType(ir.FloatType(), LANES)
PIECE = ir.VectorType(ir.FloatType(), QUARTER)
I32 = ir.IntType(32)
INDEX = ir.VectorType(I32, LANES)
UNDEFINED = ir.Constant(VECTOR, ir.Undefined)


class _F32x16(types.Type):
    def __init__(self):
        super().__init__(name="f32x16")


f32x16 = _F32x16()


@register_model(_F32x16)
class _F32x16Model(models.PrimitiveModel):
    def __init__(self, manager, front_end_type):
        super().__init__(manager, front_end_type, VECTOR)


def _binary(instruction):
    """Make an intrinsic of two vectors from an LLVM instruction."""

    @intrinsic
    def operation(typing_context, a, b):
        def generate(context, builder, signature, arguments):
            return getattr(builder, instruction)(*arguments)

        return f32x16(f32x16, f32x16), generate

    return operation


add, subtract, multiply = _binary("fadd"), _binary("fsub"), _binary("fmul")
divide = _binary("fdiv")


def call_lanes(builder, name, arguments):
    """Call an LLVM intrinsic, such as ``sqrt``, on vectors of sixteen float32."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * len(arguments))
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, arguments)


@intrinsic
def fma(typing_context, a, b, c):
    """Return a b + c, rounded once."""

    def generate(context, builder, signature, arguments):
        return call_lanes(builder, "fma", arguments)

    return f32x16(f32x16, f32x16, f32x16), generate


@intrinsic
def fnma(typing_context, a, b, c):
    """Return c - a b, rounded once."""

    def generate(context, builder, signature, arguments):
        a, b, c = arguments
        return call_lanes(builder, "fma", [builder.fneg(a), b, c])

    return f32x16(f32x16, f32x16, f32x16), generate


@intrinsic
def minimum(typing_context, a, b):
    """Return the minimum per lane; of a NaN and a number, the number."""

    def generate(context, builder, signature, arguments):
        return call_lanes(builder, "minnum", arguments)

    return f32x16(f32x16, f32x16), generate


@intrinsic
def select_greater(typing_context, a, b, yes, no):
    """Return ``yes`` where a > b, else ``no`` (also if a or b is NaN)."""

    def generate(context, builder, signature, arguments):
        left, right, if_true, if_false = arguments
        return builder.select(builder.fcmp_ordered(">", left, right), if_true, if_false)

    return f32x16(f32x16, f32x16, f32x16, f32x16), generate


@intrinsic
def broadcast(typing_context, x):
    """Return a vector of the same float32 in every lane."""

    def generate(context, builder, signature, arguments):
        return in_all_lanes(builder, arguments[0])

    return f32x16(types.float32), generate


def in_all_lanes(builder, x, kind=VECTOR):
    """Build a vector of a type with the scalar ``x`` in every lane."""
    undefined = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(undefined, x, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INDEX, [0] * LANES))


@intrinsic
def broadcast_element(typing_context, array, index):
    """Load element ``index`` of a contiguous float32 array into every lane."""

    def generate(context, builder, signature, arguments):
        return in_all_lanes(builder, _element(context, builder, signature.args[0], *arguments))

    return f32x16(array, types.intp), generate


@intrinsic
def element(typing_context, array, index):
    """Load element ``index`` of a contiguous array."""

    def generate(context, builder, signature, arguments):
        return _element(context, builder, signature.args[0], *arguments)

    return array.dtype(array, types.intp), generate


def _element(context, builder, array_type, array, index):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.load(builder.gep(data, [index]))


def _address(context, builder, array_type, array, index):
    """Return a pointer to sixteen consecutive elements of a contiguous array."""
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), VECTOR.as_pointer())


@intrinsic
def load(typing_context, array, index):
    """Load elements ``index`` to ``index + 15`` of a contiguous float32 array."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments)
        return builder.load(pointer, align=4)

    return f32x16(array, types.intp), generate


@intrinsic
def store(typing_context, array, index, v):
    """Store ``v`` in elements ``index`` to ``index + 15`` of a contiguous float32 array."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, f32x16), generate


@inline
def aligned(size):
    """Allocate a float32 array aligned to the size of a vector register."""
    array = np.empty(size + LANES, np.float32)
    first = -(array.ctypes.data // 4) % LANES
    return array[first : first + size]


@intrinsic
def load_columns(typing_context, array, index):
    """Load four columns of a 16 x 16 matrix: lane i of vector j is element ``index + 16 i + j``.

    Four vectors fit the registers of AVX2; sixteen would spill to memory.
    """

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments)
        pointer = builder.bitcast(pointer, PIECE.as_pointer())
        pieces = [builder.load(_row(builder, pointer, 4 * i), align=4) for i in range(LANES)]
        rows = [_joined(builder, pieces[i::QUARTER]) for i in range(QUARTER)]
        for width in (1, 2):
            rows = _exchange(builder, rows, width)
        return cgutils.pack_array(builder, rows)

    return types.UniTuple(f32x16, QUARTER)(array, types.intp), generate


def _joined(builder, pieces):
    """Concatenate vectors of the same size, halves first."""
    if len(pieces) == 1:
        return pieces[0]
    half = len(pieces) // 2
    first, second = _joined(builder, pieces[:half]), _joined(builder, pieces[half:])
    size = 2 * first.type.count
    order = ir.Constant(ir.VectorType(ir.IntType(32), size), list(range(size)))
    return builder.shuffle_vector(first, second, order)


@intrinsic
def store_transposed(typing_context, array, index, vectors):
    """Store lane i of vector j, of a tuple of sixteen, in element ``index + 16 i + j``."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments[:2])
        rows = cgutils.unpack_tuple(builder, arguments[2])
        for i, row in enumerate(_transposed(builder, rows)):
            builder.store(row, _row(builder, pointer, i), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.UniTuple(f32x16, LANES)), generate


def _row(builder, pointer, i):
    return builder.gep(pointer, [ir.Constant(ir.IntType(64), i)])


def _transposed(builder, rows):
    """Transpose: lane i of row j becomes lane j of row i, one bit of both indices at a time."""
    for width in (1, 2, 4, 8):
        rows = _exchange(builder, rows, width)
    return rows


def _exchange(builder, rows, width):
    """Swap the off-diagonal pair in every square of 2 x 2 blocks of ``width`` rows and lanes."""
    out = list(rows)
    low = [k if not k & width else k - width + LANES for k in range(LANES)]
    high = [k + width if not k & width else k + LANES for k in range(LANES)]
    for i in range(len(rows)):
        if not i & width:
            pair = rows[i], rows[i + width]
            out[i] = builder.shuffle_vector(*pair, ir.Constant(INDEX, low))
            out[i + width] = builder.shuffle_vector(*pair, ir.Constant(INDEX, high))
    return out


@intrinsic
def prefetch(typing_context, array, index):
    """Prefetch the cache line of element ``index`` of a contiguous array."""

    def generate(context, builder, signature, arguments):
        pointer = _address(context, builder, signature.args[0], *arguments)
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        number = ir.IntType(32)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, number, number, number])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, number(0), number(3), number(1)])  # read, keep, data
        return context.get_dummy_value()

    return types.void(array, types.intp), generate


def _fold(builder, vector, combine):
    """Combine the lanes in a tree: 8 with 8, 4 with 4, 2 with 2, 1 with 1."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    half = LANES // 2
    while half:
        lanes = [(lane + half) % LANES for lane in range(LANES)]
        shifted = builder.shuffle_vector(vector, undefined, ir.Constant(INDEX, lanes))
        vector = combine(vector, shifted)
        half //= 2
    return builder.extract_element(vector, ir.Constant(ir.IntType(32), 0))


@intrinsic
def lane_sum(typing_context, v):
    """Sum the lanes, float32, in a fixed tree."""

    def generate(context, builder, signature, arguments):
        return _fold(builder, arguments[0], builder.fadd)

    return types.float32(f32x16), generate


@intrinsic
def any_greater(typing_context, a, b):
    """Test whether a > b in at least one lane."""

    def generate(context, builder, signature, arguments):
        mask = builder.bitcast(builder.fcmp_ordered(">", *arguments), ir.IntType(LANES))
        return builder.icmp_unsigned("!=", mask, ir.Constant(mask.type, 0))

    return types.boolean(f32x16, f32x16), generate


# exp(x) on [-0.7, 0] to 8e-8 relative (minimax, degree 5).
_EXP = [
    np.float32(c) for c in (0.99999992, 0.99999255, 0.49988271, 0.16597434, 0.03977302, 0.00584696)
]


@intrinsic
def exp_of_eighth(typing_context, x):
    """Approximate exp(8 x) for x in [-0.7, 0] to 3e-6 relative; undefined elsewhere.

    The domain suffices: alphas below 1/255 = exp(-5.54) are cut off, and 8 x reaches -5.6.
    """

    def generate(context, builder, signature, arguments):
        value = ir.Constant(VECTOR, [float(_EXP[-1])] * LANES)
        for coefficient in reversed(_EXP[:-1]):
            constant = ir.Constant(VECTOR, [float(coefficient)] * LANES)
            value = call_lanes(builder, "fma", [value, arguments[0], constant])
        # (exp(x))^8 by squaring three times
        for _ in range(3):
            value = builder.fmul(value, value)
        return value

    return f32x16(f32x16), generate


@intrinsic
def negative_magnitude(typing_context, v):
    """Return -|v|, by setting the sign bit."""

    def generate(context, builder, signature, arguments):
        bits = builder.bitcast(arguments[0], INDEX)
        signs = ir.Constant(INDEX, [1 << 31] * LANES)
        return builder.bitcast(builder.or_(bits, signs), VECTOR)

    return f32x16(f32x16), generate


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
