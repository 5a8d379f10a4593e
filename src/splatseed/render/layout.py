"""Between PyTorch's arrays and those of the blending kernels.

Notation: N Gaussians of which G are visible; ``order`` [G] leads from depth rank to index; an image is
[H, W, D]; records, totals and block images are ``blending``'s. ``first`` is the first of the up to
four channels that one pass of blending takes.
Promise: every array is read and written once, in a fixed order; NumPy's gathers and transpositions of
the same took a tenth of a training step.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import numpy as np

from splatseed.jit import always_inline, kernel, parallel_range
from splatseed.render.binning import TILE
from splatseed.render.blending import BLOCKS, CHANNELS, RECORD
from splatseed.render.simd import LANES

__all__ = ["from_blocks", "gather", "mark_visible", "scatter", "to_blocks"]


@kernel
def mark_visible(radii, opacities, colors, least, visible):
    """Which Gaussians are drawn.

    A colour that is not finite is left out: 0 times NaN would carry it to every pixel of a tile.

    Args:
        radii: int32 [N, 2]; 0 = culled.
        opacities: float32 [N].
        colors: float32 [N, D].
        least: Opacities below this are left out.
        visible: Written, bool [N].
    """
    for i in parallel_range(len(radii)):
        drawn = radii[i, 0] > 0 and radii[i, 1] > 0 and opacities[i] >= least
        for channel in range(colors.shape[1]):
            drawn = drawn and np.isfinite(colors[i, channel])
        visible[i] = drawn


@kernel
def gather(order, means2d, conics, log_opacities, colors, first, records):
    """Gaussians by index to records by depth rank.

    Args:
        order: int64 [G].
        means2d: float32 [N, 2].
        conics: float32 [N, 3].
        log_opacities: By depth rank, float32 [G].
        colors: float32 [N, D].
        first: First channel.
        records: Written, float32 [16 G].
    """
    wide = min(CHANNELS, colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i, r = order[g], RECORD * g
        records[r : r + RECORD] = np.float32(0.0)
        records[r], records[r + 1] = means2d[i, 0], means2d[i, 1]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        records[r + 2], records[r + 4] = np.float32(-1 / 16) * a, np.float32(-1 / 16) * c
        records[r + 3] = np.float32(-1 / 8) * b
        records[r + 5] = np.float32(1 / 8) * log_opacities[g]
        for channel in range(wide):
            records[r + 7 + channel] = colors[i, first + channel]


@kernel
def scatter(
    order, totals, first, conics, opacities, d_means2d, d_conics, d_opacities, d_colors, d_absolute
):
    """Sums by depth rank to gradients by index; those of what is not visible stay.

    Args:
        order: int64 [G].
        totals: ``blending``'s sums over each Gaussian's pairs, float32 [G, 16].
        first: First channel.
        conics: float32 [N, 3].
        opacities: float32 [N].
        d_means2d: Added to, float32 [N, 2].
        d_conics: Added to, float32 [N, 3].
        d_opacities: Added to, float32 [N].
        d_colors: Written in this pass's channels, float32 [N, D].
        d_absolute: Written, the absolute gradients of the 2D means, float32 [N, 2].
    """
    wide = min(CHANNELS, d_colors.shape[1] - first)
    for g in parallel_range(len(order)):
        i = order[g]
        a, b, c = conics[i, 0], conics[i, 1], conics[i, 2]
        d_means2d[i, 0] += a * totals[g, 1] + b * totals[g, 2]
        d_means2d[i, 1] += b * totals[g, 1] + c * totals[g, 2]
        d_conics[i, 0] += np.float32(0.5) * totals[g, 3]
        d_conics[i, 1] += totals[g, 4]
        d_conics[i, 2] += np.float32(0.5) * totals[g, 5]
        d_opacities[i] -= totals[g, 0] / opacities[i]
        for k in range(2):
            d_absolute[i, k] = totals[g, 10 + k]
        for channel in range(wide):
            d_colors[i, first + channel] = totals[g, 6 + channel]


@always_inline
def _lane(x, y, columns):
    """Block and lane of a pixel."""
    tile = (y // TILE) * columns + x // TILE
    return BLOCKS * tile + 2 * (y % TILE // 4) + x % TILE // 4, 4 * (y % 4) + x % 4


@kernel
def from_blocks(blocks, transmittance, columns, background, first, image, passing):
    """A block image to this pass's channels of an image, on its background.

    Args:
        blocks: float32 [t * 4 * CHANNELS * 16].
        transmittance: float32 [t * 4 * 16].
        columns: Tiles in a row.
        background: float32 [D].
        first: First channel.
        image: Written, float32 [H, W, D].
        passing: Written, the transmittance, float32 [H, W].
    """
    wide = min(CHANNELS, image.shape[2] - first)
    for y in parallel_range(image.shape[0]):
        for x in range(image.shape[1]):
            block, lane = _lane(x, y, columns)
            rest = transmittance[LANES * block + lane]
            passing[y, x] = rest
            for channel in range(wide):
                color = blocks[LANES * (CHANNELS * block + channel) + lane]
                image[y, x, first + channel] = color + rest * background[first + channel]


@kernel
def to_blocks(d_image, image, d_passing, columns, first, gradient, behind):
    """This pass's channels of the gradient to a block image, and what lies behind the first Gaussian.

    Args:
        d_image: d loss / d image, float32 [H, W, D].
        image: float32 [H, W, D].
        d_passing: What this pass has to count of (d loss / d transmittance) T, float32 [H, W].
        columns: Tiles in a row.
        first: First channel.
        gradient: Written, block image, float32 [t * 4 * CHANNELS * 16]; must hold 0.
        behind: Written, gradient . colour + ``d_passing``, float32 [t * 4 * 16]; must hold 0.
    """
    wide = min(CHANNELS, image.shape[2] - first)
    for y in parallel_range(image.shape[0]):
        for x in range(image.shape[1]):
            block, lane = _lane(x, y, columns)
            total = d_passing[y, x]
            for channel in range(wide):
                slope = d_image[y, x, first + channel]
                gradient[LANES * (CHANNELS * block + channel) + lane] = slope
                total += slope * image[y, x, first + channel]
            behind[LANES * block + lane] = total
