"""Convert between PyTorch's arrays and those of the blending kernels.

Notation: arrays are float32; N Gaussians of which G are visible; ``order``, uint32 [G], maps depth
rank to index; an image is [H, W, D], with ``columns`` tiles in a row; T [H, W] is its
transmittance; ``blending`` defines records and block images. ``first`` is the first of the up to
four channels of a pass of blending.
Promise: every array is read and written once, in a fixed order. NumPy's gathers and transpositions
took a tenth of a training step instead.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.rendering._kernels.binning import RECORD, TILE
from splatseed.rendering._kernels.blending import BLOCKS, CHANNELS
from splatseed.runtime.jit import always_inline, kernel, parallel_range
from splatseed.runtime.simd import LANES

NEEDLE = 1.0 - 2.0**-22
"""Largest factor below 1 for which an ellipse survives float32 rounding."""
RGB = 3
"""Number of channels with specialised code."""


@kernel
def find_visible(radii, opacities, colors, min_opacity, visible):
    """Find the Gaussians to draw: not culled (radii 0), opacity at least ``min_opacity``.

    Gaussians whose colours are not finite are skipped: 0 times NaN would spread over their tiles.
    Writes ``visible``, bool [N].
    """
    for i in parallel_range(len(radii)):
        # Branch-free: half of the branches would be mispredicted.
        drawn = (radii[i, 0] > 0) & (radii[i, 1] > 0) & (opacities[i] >= min_opacity)
        zero = np.float32(0.0)
        for channel in range(colors.shape[1]):
            # 0 times NaN or infinity is NaN, which differs from 0.
            zero += np.float32(0.0) * colors[i, channel]
        visible[i] = drawn & (zero == np.float32(0.0))


@kernel
def gather(order, means2d, conics, log_opacities, colors, first, records):
    """Gather Gaussians by index into records by depth rank [16 G].

    ``log_opacities`` [G] are by depth rank already.
    """
    wide = min(CHANNELS, colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i, record = order[g], records[RECORD * g : RECORD * (g + 1)]
        record[0], record[1] = means2d[i, 0], means2d[i, 1]
        # sigma = (a dx^2 + c dy^2) / 2 + b dx dy, and h = (log opacity - sigma) / 8
        record[2] = np.float32(-1 / 16) * conics[i, 0]
        record[3] = np.float32(-1 / 8) * _reduced(conics[i, 0], conics[i, 1], conics[i, 2])
        record[4] = np.float32(-1 / 16) * conics[i, 2]
        record[5] = np.float32(1 / 8) * log_opacities[g]
        for k in range(6, RECORD):
            record[k] = np.float32(0.0)
        for channel in range(wide):
            record[7 + channel] = colors[i, first + channel]


@always_inline
def _reduced(a, b, c):
    """Return b, reduced if float32 rounding left no ellipse (of a needle).

    Blending requires sigma >= 0.
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
    """Scatter sums by depth rank to gradients by index; gradients of invisible Gaussians stay.

    ``totals`` [G, 16] are the sums of ``blending_vjp`` by Gaussian. They are added to the gradients
    of means, conics and opacities. The gradients of this pass's channels are written, and so is
    ``d_absolute``, the absolute gradients of the 2D means, [N, 2] or empty.
    """
    wide = min(CHANNELS, d_colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i = order[g]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        # d sigma / d mean = (a dx + b dy, b dx + c dy), times p, summed
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
    """Return the lane, over all tiles, of the first pixel in a row of a block."""
    # Layout [tile, block, lane]: see the table of lanes in ``blending``.
    tile, quarter = y // TILE * columns + x // TILE, y % TILE // 4 * 2 + x % TILE // 4
    return LANES * (BLOCKS * tile + quarter) + y % 4 * 4


@kernel
def from_blocks(blocks, block_T, columns, background, first, image, transmittance):
    """Convert a block image and its T to this pass's channels of an image, and T.

    The image is blended with ``background`` [D].
    """
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
    """Return the offset of a lane's first channel in a block image."""
    return lane // LANES * (CHANNELS * LANES) + lane % LANES


@always_inline
def _from_lanes(colors, T, background, first, count, depth, pixels, out_T):
    """Write up to four neighbouring pixels of a row: colour + T background."""
    for k in range(count):
        out_T[k] = T[k]
        for channel in range(min(CHANNELS, depth - first)):
            # colour + T background
            color = colors[LANES * channel + k] + T[k] * background[first + channel]
            pixels[depth * k + first + channel] = color


@kernel
def to_blocks(d_image, image, d_alphas, transmittance, columns, first, gradient, behind):
    """Convert this pass's channels of the gradient to a block image, and initialise ``behind``.

    behind = gradient . colour - (d loss / d alpha) T, over the pass's own channels; only the first
    pass includes alpha. Both results are 0 outside the image.
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
    """Write up to four neighbouring pixels of a row; pad pixels and channels with zeros."""
    wide = min(CHANNELS, depth - first)
    for k in range(count):
        # alpha = 1 - T, like another channel with a background of -1
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
