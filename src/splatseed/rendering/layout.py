"""Conversion between PyTorch's arrays and those of the blending kernels.

Notation: arrays are float32; N Gaussians of which G are visible; ``order``, uint32 [G], maps depth
rank to index; an image is [H, W, D], with ``columns`` tiles in a row; T [H, W] is its
transmittance; records and block images are defined in ``blending``. ``first`` is the first of the
up to four channels that one pass of blending takes.
Promise: every array is read and written once, in a fixed order; the same with NumPy's gathers and
transpositions took a tenth of a training step.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from splatseed.rendering.binning import RECORD, TILE
from splatseed.rendering.blending import BLOCKS, CHANNELS
from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.simd import LANES

NEEDLE = 1.0 - 2.0**-22
"""The largest factor below 1 after which float32 rounding still leaves an ellipse."""
RGB = 3
"""Number of channels that gets its own specialised code."""


@kernel
def mark_visible(radii, opacities, colors, least, visible):
    """Which Gaussians are drawn, bool [N]: not culled (radii 0), opacity ``least`` or more.

    A colour that is not finite is left out: 0 times NaN would spread it to every pixel of a tile.
    """
    for i in parallel_range(len(radii)):
        # Branch-free: the processor would mispredict half of the time.
        seen = (radii[i, 0] > 0) & (radii[i, 1] > 0) & (opacities[i] >= least)
        zero = np.float32(0.0)
        for channel in range(colors.shape[1]):
            # 0 times NaN or infinity is NaN, which differs from 0.
            zero += np.float32(0.0) * colors[i, channel]
        visible[i] = seen & (zero == np.float32(0.0))


@kernel
def gather(order, means2d, conics, log_opacities, colors, first, records):
    """Gaussians by index, but ``log_opacities`` by depth rank, to records by depth rank [16 G]."""
    wide = min(CHANNELS, colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i, record = order[g], records[RECORD * g : RECORD * (g + 1)]
        record[0], record[1] = means2d[i, 0], means2d[i, 1]
        # sigma = (a dx^2 + c dy^2) / 2 + b dx dy, and h = (log opacity - sigma) / 8
        record[2] = np.float32(-1 / 16) * conics[i, 0]
        record[3] = np.float32(-1 / 8) * _held(conics[i, 0], conics[i, 1], conics[i, 2])
        record[4] = np.float32(-1 / 16) * conics[i, 2]
        record[5] = np.float32(1 / 8) * log_opacities[g]
        for k in range(6, RECORD):
            record[k] = np.float32(0.0)
        for channel in range(wide):
            record[7 + channel] = colors[i, first + channel]


@always_inline
def _held(a, b, c):
    """b, reduced to keep the conic an ellipse where float32 rounding broke that for a needle.

    Blending relies on sigma >= 0.
    """
    # An ellipse has b^2 < a c.
    product = np.float64(a) * np.float64(c)
    if np.float64(b) * np.float64(b) <= product:
        return b
    return np.float32(math.copysign(NEEDLE * math.sqrt(product), b))


@kernel
def scatter(
    order, totals, first, conics, opacities, d_means2d, d_conics, d_opacities, d_colors, d_absolute
):
    """Sums by depth rank to gradients by index; those of invisible Gaussians stay.

    ``totals`` [G, 16] are ``blending_vjp``'s sums over each Gaussian's spans. They are added to the
    gradients of means, conics and opacities, and written to those of this pass's channels and to
    ``d_absolute``, the absolute gradients of the 2D means [N, 2], unless that is empty.
    """
    wide = min(CHANNELS, d_colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i = order[g]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        # d sigma / d mean = (a dx + b dy, b dx + c dy); the sums of p dx and p dy carry d loss.
        d_means2d[i, 0] += a * totals[g, 1] + b * totals[g, 2]
        d_means2d[i, 1] += b * totals[g, 1] + c * totals[g, 2]
        # d sigma / d (a, b, c) = (dx^2 / 2, dx dy, dy^2 / 2)
        d_conics[i, 0] += np.float32(0.5) * totals[g, 3]
        d_conics[i, 1] += totals[g, 4]
        d_conics[i, 2] += np.float32(0.5) * totals[g, 5]
        # alpha = opacity exp(-sigma): d / d opacity = -(d / d sigma) / opacity
        d_opacities[i] -= totals[g, 0] / opacities[i]
        if len(d_absolute):
            d_absolute[i, 0], d_absolute[i, 1] = totals[g, 10], totals[g, 11]
        for channel in range(wide):
            d_colors[i, first + channel] = totals[g, 6 + channel]


@always_inline
def _first_lane(x, y, columns):
    """The lane, over all tiles, of a pixel that is the first of its row in a block."""
    # Layout [tile, block, lane]: see the table of lanes in ``blending``.
    tile, quarter = y // TILE * columns + x // TILE, y % TILE // 4 * 2 + x % TILE // 4
    return LANES * (BLOCKS * tile + quarter) + y % 4 * 4


@kernel
def from_blocks(blocks, block_T, columns, background, first, image, transmittance):
    """A block image and its T to this pass's channels of an image, on its background [D], and T."""
    height, width, depth = image.shape
    pixels, out_T = image.reshape(-1), transmittance.reshape(-1)
    for y in parallel_range(height):
        for x in range(0, width, 4):
            lane, at = _first_lane(x, y, columns), y * width + x
            colors, T = blocks[_color(lane) :], block_T[lane : lane + 4]
            row, row_T = pixels[depth * at :], out_T[at:]
            if depth == RGB and x + 4 <= width:  # specialised by the compiler
                _from_lanes(colors, T, background, 0, 4, RGB, row, row_T)
            else:
                count = min(4, width - x)
                _from_lanes(colors, T, background, first, count, depth, row, row_T)


@always_inline
def _color(lane):
    """Offset of a lane's first channel in a block image."""
    return lane // LANES * (CHANNELS * LANES) + lane % LANES


@always_inline
def _from_lanes(colors, T, background, first, count, depth, pixels, out_T):
    """Up to four neighbouring pixels of a row: colour + T background."""
    for k in range(count):
        out_T[k] = T[k]
        for channel in range(min(CHANNELS, depth - first)):
            # colour + T background
            color = colors[LANES * channel + k] + T[k] * background[first + channel]
            pixels[depth * k + first + channel] = color


@kernel
def to_blocks(d_image, image, d_alphas, transmittance, columns, first, gradient, behind):
    """This pass's gradient channels as a block image, and the initial value of ``behind``.

    Every pass takes the part of ``behind``, gradient . colour - (d loss / d alpha) T, of its own
    channels; the first also takes that of alpha. Both are 0 outside the image.
    """
    height, width, depth = image.shape
    d_pixels, pixels = d_image.reshape(-1), image.reshape(-1)
    d_alpha, T = d_alphas.reshape(-1), transmittance.reshape(-1)
    for y in parallel_range(len(behind) // (TILE * columns)):
        for x in range(0, TILE * columns, 4):
            lane, at = _first_lane(x, y, columns), y * width + x
            gradients, after = gradient[_color(lane) :], behind[lane : lane + 4]
            d_row, row, d_T, row_T = (
                d_pixels[depth * at :],
                pixels[depth * at :],
                d_alpha[at:],
                T[at:],
            )
            if depth == RGB and x + 4 <= width and y < height:
                _to_lanes(d_row, row, d_T, row_T, 0, 4, RGB, gradients, after)
            else:
                count = min(4, max(width - x, 0)) if y < height else 0
                _to_lanes(d_row, row, d_T, row_T, first, count, depth, gradients, after)


@always_inline
def _to_lanes(d_pixels, pixels, d_alpha, T, first, count, depth, gradients, after):
    """Up to four neighbouring pixels of a row; zeros fill up the four and the channels."""
    wide = min(CHANNELS, depth - first)
    for k in range(count):
        # alpha = 1 - T: it acts like one more channel, with a background of -1.
        total = -d_alpha[k] * T[k] if first == 0 else np.float32(0.0)
        for channel in range(wide):
            d_pixel = d_pixels[depth * k + first + channel]
            gradients[LANES * channel + k] = d_pixel
            total += d_pixel * pixels[depth * k + first + channel]
        after[k] = total
    for k in range(count, 4):
        after[k] = np.float32(0.0)
    for channel in range(CHANNELS):
        for k in range(count if channel < wide else 0, 4):
            gradients[LANES * channel + k] = np.float32(0.0)
