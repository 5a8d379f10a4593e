"""A grey image as words of four pixels, interpolated at sixteen positions at a time.

Notation: word (y, x) of a *quad image* holds the 8-bit pixels (y, x), (y, x+1), (y+1, x), (y+1,
x+1) from its lowest byte on, so that one load per lane brings all that bilinear interpolation
needs. Column and row count from the centre of the first pixel. Promise: the value is the bilinear
one, exact to float32 rounding; positions outside the image take the border's value.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call, misc"

from __future__ import annotations

import numpy as np
from jaxtyping import Int32, UInt8
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from splatseed.kernels.jit import inline
from splatseed.kernels.simd import INDEX, LANES, VECTOR, call_lanes, f32x16, in_all_lanes

BYTE = 8
LUMA = np.array([0.299, 0.587, 0.114], np.float32)
"""ITU-R BT.601."""


def grey_image(image: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    """The brightness of sRGB pixels, rounded to 8 bits."""
    out = np.empty(image.shape[:2], np.uint8)
    _grey(image, LUMA, out)
    return out


def make_quads(grey: UInt8[np.ndarray, "H W"]) -> Int32[np.ndarray, "H W"]:
    """The quad image of a grey image."""
    out = np.empty(grey.shape, np.int32)
    _pack(grey, out)
    return out


@inline
def _grey(image, luma, out):
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            pixel = image[y, x]
            value = luma[0] * pixel[0] + luma[1] * pixel[1] + luma[2] * pixel[2]
            out[y, x] = np.uint8(value + np.float32(0.5))


@inline
def _pack(grey, out):
    height, width = grey.shape
    for y in range(height):
        # The last row and column repeat themselves.
        below = min(y + 1, height - 1)
        for x in range(width):
            right = min(x + 1, width - 1)
            low = np.int32(grey[y, x]) | np.int32(grey[y, right]) << 8
            high = np.int32(grey[below, x]) | np.int32(grey[below, right]) << 8
            out[y, x] = low | high << 16


@intrinsic
def sample(typing_context, quads, width, height, column, row):
    """The interpolated image: lane i at (column i, row i); NaN reads the first pixel.

    ``quads`` is the flattened quad image, int32 [height * width]; ``width`` and ``height`` are
    int64.
    """

    def generate(context, builder, signature, arguments):
        quads, width, height, column, row = arguments
        data = context.make_array(signature.args[0])(context, builder, quads).data
        x, right = _split(builder, column, width)
        y, down = _split(builder, row, height)
        stride = in_all_lanes(builder, builder.trunc(width, ir.IntType(32)), INDEX)
        words = _gather(builder, data, builder.add(builder.mul(y, stride), x))
        a, b, c, d = (_byte(builder, words, i) for i in range(4))
        top, bottom = _lerp(builder, a, b, right), _lerp(builder, c, d, right)
        return _lerp(builder, top, bottom, down)

    wide = types.int64
    return f32x16(quads, wide, wide, f32x16, f32x16), generate


@intrinsic
def square_root(typing_context, v):
    """The square root in each lane."""

    def generate(context, builder, signature, arguments):
        return call_lanes(builder, "sqrt", arguments)

    return f32x16(f32x16), generate


def _split(builder, place, size):
    """Integer and fractional parts of coordinates, clamped to 0 and ``size - 1``."""
    last = builder.sitofp(builder.sub(size, ir.Constant(size.type, 1)), ir.FloatType())
    # maxnum and minnum return the number where the other is NaN: NaN becomes 0.
    place = call_lanes(builder, "maxnum", [place, ir.Constant(VECTOR, [0.0] * LANES)])
    place = call_lanes(builder, "minnum", [place, in_all_lanes(builder, last)])
    whole = builder.fptosi(place, INDEX)
    return whole, builder.fsub(place, builder.sitofp(whole, VECTOR))


def _gather(builder, data, index):
    """Gather sixteen words; LLVM uses the processor's own gather where that pays."""
    places = builder.gep(data, [index], source_etype=ir.IntType(32))
    places.type = ir.VectorType(ir.PointerType(), LANES)  # llvmlite takes it for one pointer
    mask = ir.VectorType(ir.IntType(1), LANES)
    kind = ir.FunctionType(INDEX, [places.type, ir.IntType(32), mask, INDEX])
    name = f"llvm.masked.gather.v{LANES}i32.v{LANES}p0"
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    every = ir.Constant(mask, [1] * LANES)
    align = ir.Constant(ir.IntType(32), 4)
    return builder.call(function, [places, align, every, ir.Constant(INDEX, ir.Undefined)])


def _byte(builder, words, i):
    """Byte i of each word as a number."""
    shifted = builder.lshr(words, ir.Constant(INDEX, [i * BYTE] * LANES)) if i else words
    # The topmost byte needs no mask: the shift has brought in zeros.
    low = builder.and_(shifted, ir.Constant(INDEX, [0xFF] * LANES)) if i < 3 else shifted
    return builder.sitofp(low, VECTOR)


def _lerp(builder, a, b, t):
    """(1 - t) a + t b."""
    return call_lanes(builder, "fma", [t, builder.fsub(b, a), a])
