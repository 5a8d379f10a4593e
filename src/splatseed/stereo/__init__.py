"""Depth and normal maps from photographs alone, on the CPU.

Promise: NumPy and Numba only; importing this package loads neither Numba nor SciPy.
"""

from splatseed.stereo.maps import StereoMap
from splatseed.stereo.of_scene import stereo_depths
from splatseed.stereo.settings import StereoSettings

__all__ = ["StereoMap", "StereoSettings", "stereo_depths"]
