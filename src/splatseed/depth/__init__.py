"""Depth-guided lifting: pixels of the photographs as points, by maps that say how far they are.

``align`` finds the scale (and shift) that takes each map to the scene's units. Promise: photographs
and maps are read one at a time by each thread, whatever the number of images.
"""

from splatseed.depth.alignment import Alignment, align

__all__ = ["Alignment", "align"]
