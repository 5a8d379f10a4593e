"""Photometric cost of planes: how much two photographs differ around a pixel on a plane.

Images: word (y, x) of a *quad image* packs the 8-bit pixels (y, x), (y, x+1), (y+1, x) and
(y+1, x+1) of a grey image, lowest byte first, so that one load per lane fetches all the pixels that
bilinear interpolation needs. Columns and rows count from the centre of the first pixel.
Interpolation is exact to float32 rounding; positions outside the image take the border's value.

Notation: sixteen pixels at a time, one per lane. A plane is its inverse depth over the reference
view's pixels, w(u, v) = w0 + gx (u - u0) + gy (v - v0), which is exact for planes in space. The
point at pixel (u, v) projects into a source view at P / P_z with

    P = A (u, v, 1) + b w(u, v),    A = K_s R K_r^-1,    b = K_s t,

R, t from reference to source. A window has 5 x 5 samples, ``STRIDE`` pixels apart. With weights c_i
(sum 1) by grey level and distance to the window's centre, reference samples r_i and source samples
s_i, the cost in one source is

    1 - sum a_i s_i / sqrt(var_s + NOISE),    a_i = c_i (r_i - mean_r) / sqrt(var_r + NOISE),

one minus the weighted normalised cross-correlation (ZNCC). NOISE pulls the cost of untextured
windows to 1. Promise: float32 arithmetic in a fixed order, so results do not depend on threads.
Source: bilaterally weighted NCC as in Schoenberger et al., Pixelwise View Selection (2016).
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from splatseed.runtime.jit import always_inline, inline
from splatseed.runtime.simd import (
    INDEX,
    LANES,
    VECTOR,
    add,
    broadcast,
    call_lanes,
    divide,
    exp_of_eighth,
    f32x16,
    fma,
    fnma,
    in_all_lanes,
    load,
    minimum,
    multiply,
    select_greater,
    store,
    subtract,
)

BYTE = 8
RADIUS, STRIDE = 2, 2
SIDE = 2 * RADIUS + 1
SAMPLES = SIDE * SIDE
SIGMA_GREY = 25.0
"""Standard deviation of the weight over grey levels."""
SIGMA_SPACE = 5.0
"""Standard deviation of the weight over pixels."""
NOISE = 0.1
"""Variance of image noise, in squared grey levels; weaker texture does not correlate."""
UNSEEN_COST = 1.0
"""Cost in a view whose frame does not contain the point: that of no correlation."""
NUM_BEST = 2
"""Lowest source costs that are averaged: the point may be occluded in the other sources."""
MIN_EXPONENT = np.float32(-0.7)
"""Lower end of ``exp_of_eighth``'s domain."""

# Halved exponents, divided by 8 for ``exp_of_eighth``.
_GREY = np.float32(-0.5 / SIGMA_GREY**2 / 8)
_SPACE = np.float32(-0.5 / SIGMA_SPACE**2 / 8)
_NOISE, _HALF, _ONE, _ZERO = (np.float32(each) for each in (NOISE, 0.5, 1.0, 0.0))
_UNSEEN, _WORST = np.float32(UNSEEN_COST), np.float32(4.0)  # costs end at 2


@inline
def to_grey(image, luma, out):
    """Weighted sum of the channels of uint8 [H, W, 3], rounded, into uint8 [H, W]."""
    for y in range(image.shape[0]):
        for x in range(image.shape[1]):
            pixel = image[y, x]
            value = luma[0] * pixel[0] + luma[1] * pixel[1] + luma[2] * pixel[2]
            out[y, x] = np.uint8(value + np.float32(0.5))


@inline
def pack_quads(grey, out):
    """The quad image of a grey one, uint8 [H, W] into int32 [H, W]."""
    height, width = grey.shape
    for y in range(height):
        # The last row and column are repeated.
        below = min(y + 1, height - 1)
        for x in range(width):
            right = min(x + 1, width - 1)
            low = np.int32(grey[y, x]) | np.int32(grey[y, right]) << 8
            high = np.int32(grey[below, x]) | np.int32(grey[below, right]) << 8
            out[y, x] = low | high << 16


@intrinsic
def sample(typing_context, quads, width, height, column, row):
    """Interpolate the image at (column, row) of each lane; NaN reads the first pixel.

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


def _split(builder, coordinate, size):
    """Split coordinates, clamped to [0, size - 1], into integer and fractional parts."""
    last = builder.sitofp(builder.sub(size, ir.Constant(size.type, 1)), ir.FloatType())
    # maxnum and minnum return the number where the other is NaN: NaN becomes 0.
    zero = ir.Constant(VECTOR, [0.0] * LANES)
    coordinate = call_lanes(builder, "maxnum", [coordinate, zero])
    coordinate = call_lanes(builder, "minnum", [coordinate, in_all_lanes(builder, last)])
    integer = builder.fptosi(coordinate, INDEX)
    return integer, builder.fsub(coordinate, builder.sitofp(integer, VECTOR))


def _gather(builder, data, index):
    """Gather sixteen words, by the processor's own instruction where LLVM finds it faster."""
    pointers = builder.gep(data, [index], source_etype=ir.IntType(32))
    pointers.type = ir.VectorType(ir.PointerType(), LANES)  # llvmlite types it as one pointer
    mask = ir.VectorType(ir.IntType(1), LANES)
    kind = ir.FunctionType(INDEX, [pointers.type, ir.IntType(32), mask, INDEX])
    name = f"llvm.masked.gather.v{LANES}i32.v{LANES}p0"
    function = cgutils.get_or_insert_function(builder.module, kind, name)
    every = ir.Constant(mask, [1] * LANES)
    align = ir.Constant(ir.IntType(32), 4)
    return builder.call(function, [pointers, align, every, ir.Constant(INDEX, ir.Undefined)])


def _byte(builder, words, i):
    """Convert byte i of each word to float32."""
    shifted = builder.lshr(words, ir.Constant(INDEX, [i * BYTE] * LANES)) if i else words
    # The topmost byte needs no mask: the shift fills with zeros.
    low = builder.and_(shifted, ir.Constant(INDEX, [0xFF] * LANES)) if i < 3 else shifted
    return builder.sitofp(low, VECTOR)


def _lerp(builder, a, b, t):
    """(1 - t) a + t b."""
    return call_lanes(builder, "fma", [t, builder.fsub(b, a), a])


@inline
def prepare_window(quads, width, height, u, v, weights, reference):
    """Compute weights c and normalised reference samples a of the windows of sixteen pixels.

    Args:
        quads: The reference view's quad image, flat.
        width: Its columns, int64.
        height: Its rows, int64.
        u: float32 [16], pixels.
        v: float32 [16].
        weights: Filled with c, float32 [SAMPLES * 16].
        reference: Filled with a, float32 [SAMPLES * 16]; holds r meanwhile.
    """
    half = broadcast(_HALF)
    column, row = subtract(load(u, 0), half), subtract(load(v, 0), half)
    center = sample(quads, width, height, column, row)
    total, mean, square = broadcast(_ZERO), broadcast(_ZERO), broadcast(_ZERO)
    for k in range(SAMPLES):
        x, y = STRIDE * (k % SIDE - RADIUS), STRIDE * (k // SIDE - RADIUS)
        right, down = broadcast(np.float32(x)), broadcast(np.float32(y))
        r = sample(quads, width, height, add(column, right), add(row, down))
        # c = exp(-(r - r_center)^2 / (2 SIGMA_GREY^2) - (x^2 + y^2) / (2 SIGMA_SPACE^2))
        difference = subtract(r, center)
        space = broadcast(np.float32(x * x + y * y) * _SPACE)
        exponent = fma(multiply(difference, difference), broadcast(_GREY), space)
        lowest = broadcast(MIN_EXPONENT)
        c = exp_of_eighth(select_greater(lowest, exponent, lowest, exponent))
        total = add(total, c)
        mean = fma(c, r, mean)
        square = fma(multiply(c, r), r, square)
        store(weights, k * LANES, c)
        store(reference, k * LANES, r)
    scale = divide(broadcast(_ONE), total)  # so that the weights sum to 1
    mean, square = multiply(mean, scale), multiply(square, scale)
    # a = c (r - mean_r) / sqrt(var_r + NOISE)
    inverse = divide(broadcast(_ONE), square_root(_variance(square, mean)))
    for k in range(SAMPLES):
        c = multiply(load(weights, k * LANES), scale)
        store(weights, k * LANES, c)
        r = load(reference, k * LANES)
        store(reference, k * LANES, multiply(multiply(c, subtract(r, mean)), inverse))


@inline
def best_cost(sources, sizes, offsets, warps, u, v, planes, weights, reference, out):
    """Average the ``NUM_BEST`` lowest costs over the sources, for one plane per lane.

    Args:
        sources: Quad images of the sources, concatenated, int32.
        sizes: Width and height of each, int64 [S, 2].
        offsets: Start of each, int64 [S + 1].
        warps: A row by row, then b, of each, float32 [S, 12].
        u: float32 [16], pixels.
        v: float32 [16].
        planes: w0, gx, gy, float32 [3 * 16].
        weights: float32 [SAMPLES * 16].
        reference: float32 [SAMPLES * 16].
        out: Filled with the costs, float32 [16].
    """
    lowest, second = broadcast(_WORST), broadcast(_WORST)
    for s in range(len(sizes)):
        quads = sources[offsets[s] : offsets[s + 1]]
        cost = _cost(quads, sizes[s, 0], sizes[s, 1], warps[s], u, v, planes, weights, reference)
        # The two lowest, without a branch: the higher of (cost, lowest) competes with the second.
        higher = select_greater(cost, lowest, cost, lowest)
        lowest, second = minimum(lowest, cost), minimum(second, higher)
    if len(sizes) == 1:
        store(out, 0, lowest)
    else:
        store(out, 0, multiply(add(lowest, second), broadcast(_HALF)))


@always_inline
def _cost(quads, width, height, warp, u, v, planes, weights, reference):
    """Cost in one source: 1 - sum a_i s_i / sqrt(var_s + NOISE)."""
    u0, v0 = load(u, 0), load(v, 0)
    w, gx, gy = load(planes, 0), load(planes, LANES), load(planes, 2 * LANES)
    x0, ax, bx = _component(warp, 0, u0, v0, w, gx, gy)
    y0, ay, by = _component(warp, 1, u0, v0, w, gx, gy)
    z0, az, bz = _component(warp, 2, u0, v0, w, gx, gy)
    half = broadcast(_HALF)  # pixel centres lie at +0.5, samples at whole columns and rows
    correlation, mean, square = broadcast(_ZERO), broadcast(_ZERO), broadcast(_ZERO)
    for j in range(SIDE):
        # P is affine in the pixel: the start of the row, then one step per sample.
        down = broadcast(np.float32(STRIDE * (j - RADIUS)))
        rx, ry, rz = fma(down, bx, x0), fma(down, by, y0), fma(down, bz, z0)
        for i in range(SIDE):
            right = broadcast(np.float32(STRIDE * (i - RADIUS)))
            inverse = divide(broadcast(_ONE), fma(right, az, rz))
            column = subtract(multiply(fma(right, ax, rx), inverse), half)
            row = subtract(multiply(fma(right, ay, ry), inverse), half)
            s = sample(quads, width, height, column, row)
            k = (j * SIDE + i) * LANES
            c = load(weights, k)
            correlation = fma(load(reference, k), s, correlation)
            mean = fma(c, s, mean)
            square = fma(multiply(c, s), s, square)
    # sum a_i s_i needs no mean_s, as the a_i sum to 0.
    inverse = divide(broadcast(_ONE), square_root(_variance(square, mean)))
    cost = fnma(correlation, inverse, broadcast(_ONE))
    return _mask_unseen(cost, x0, y0, z0, width, height)


@always_inline
def _component(warp, i, u, v, w, gx, gy):
    """Component i of P at the window's centre, and its derivatives by column and row."""
    a, b = broadcast(warp[3 * i]), broadcast(warp[3 * i + 1])
    c, d = broadcast(warp[3 * i + 2]), broadcast(warp[9 + i])
    start = fma(a, u, fma(b, v, fma(d, w, c)))  # P_i = a u + b v + c + d w
    return start, fma(d, gx, a), fma(d, gy, b)


@always_inline
def _variance(square, mean):
    """Variance E[x^2] - E[x]^2 plus the noise; never 0."""
    noise = broadcast(_NOISE)
    variance = fnma(mean, mean, add(square, noise))  # rounding can push it below the noise
    return select_greater(variance, noise, variance, noise)


@always_inline
def _mask_unseen(cost, x, y, z, width, height):
    """Replace the cost by ``UNSEEN_COST`` where P is behind the camera or outside the frame."""
    zero, unseen = broadcast(_ZERO), broadcast(_UNSEEN)
    # 0 < x / z < width, multiplied by z > 0; likewise y
    cost = select_greater(z, zero, cost, unseen)
    cost = select_greater(x, zero, cost, unseen)
    cost = select_greater(y, zero, cost, unseen)
    cost = select_greater(multiply(z, broadcast(np.float32(width))), x, cost, unseen)
    return select_greater(multiply(z, broadcast(np.float32(height))), y, cost, unseen)
