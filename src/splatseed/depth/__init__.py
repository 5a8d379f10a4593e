"""Depth-guided lifting: turning pixels of the photographs into points by their depth maps.

``align`` finds the scale (and shift) that takes each map to the scene's units. Promise: photographs
and maps are read one at a time by each thread, whatever the number of images.
"""

from splatseed.depth.alignment import Alignment, align

__all__ = ["Alignment", "align"]
