"""Depth and normal maps from photographs alone, on the CPU.

Promise: NumPy and Numba only; importing this package loads neither Numba nor SciPy.
"""

from splatseed.depth.stereo.maps import StereoMap, StereoSettings, stereo_depths

__all__ = ["StereoMap", "StereoSettings", "stereo_depths"]
