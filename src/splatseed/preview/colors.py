"""Colour maps for numbers, and colour bars that explain them.

Promise: colours are perceptually uniform and remain distinct in grey print; unknown values are
grey.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Float64, UInt8
from PIL import Image as PillowImage, ImageDraw

from splatseed.preview.page import GRID_SIDE, INK, PAPER, font

UNKNOWN = (150, 150, 150)
RANGE = (2, 98)
"""Percentiles of a map's values between which its colours vary."""


def heat(values: Float64[np.ndarray, " N"]) -> UInt8[np.ndarray, "N 3"]:
    """Colours of values 0..1: blue is good, yellow bad, distinct in grey print."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import, needed here alone)

    rgba = colormaps["plasma"](np.clip(values, 0.0, 1.0), bytes=True)
    return np.asarray(rgba[..., :3])


def map_colors(
    values: Float[np.ndarray, "H W"], low: float, high: float, colormap: str = "viridis"
) -> UInt8[np.ndarray, "H W 3"]:
    """Colours of a map's values from ``low`` to ``high``; grey where they are not finite."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import, needed here alone)

    known = np.isfinite(values)
    share = (np.where(known, values, low) - low) / max(high - low, 1e-12)
    colors = colormaps[colormap](np.clip(share, 0.0, 1.0), bytes=True)[..., :3]
    return np.asarray(np.where(known[..., None], colors, np.array(UNKNOWN, np.uint8)))


def usual_range(values: Float[np.ndarray, "H W"]) -> tuple[float, float]:
    """The range of a map's finite values without its extremes; 0 to 0 if there are none."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 0.0
    low, high = np.percentile(finite, RANGE)
    return float(low), float(high)


def color_bar(low: str, high: str, colormap: str = "plasma") -> UInt8[np.ndarray, "H W 3"]:
    """A strip of colours, by default of ``heat``, with labels at its ends."""
    strip = map_colors(np.tile(np.linspace(0.0, 1.0, 240), (20, 1)), 0.0, 1.0, colormap)
    bar = PillowImage.new("RGB", (GRID_SIDE, 44), PAPER)
    bar.paste(PillowImage.fromarray(strip), (70, 12))
    draw = ImageDraw.Draw(bar)
    draw.text((58, 22), low, fill=INK, font=font(18), anchor="rm")
    draw.text((322, 22), high, fill=INK, font=font(18), anchor="lm")
    return np.asarray(bar)
