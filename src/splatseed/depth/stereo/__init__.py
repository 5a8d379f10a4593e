"""Depth and normal maps from photographs alone, on the CPU.

Promise: NumPy and Numba only; importing this package loads neither Numba nor SciPy.
"""

from splatseed.depth.stereo.maps import StereoMap, stereo_depths
from splatseed.depth.stereo.settings import StereoSettings

__all__ = ["StereoMap", "StereoSettings", "stereo_depths"]
