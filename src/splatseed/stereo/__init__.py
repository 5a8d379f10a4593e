"""Depth and normal maps from photographs alone, on the CPU.

Promise: NumPy and Numba only; importing this package loads neither Numba nor SciPy.
"""

from splatseed.stereo.maps import StereoMap

__all__ = ["StereoMap"]
