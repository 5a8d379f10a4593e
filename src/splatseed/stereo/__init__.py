"""Depth and normals from photographs alone, on the CPU."""

from splatseed.stereo.depths import stereo_depths
from splatseed.stereo.maps import StereoMap
from splatseed.stereo.settings import StereoSettings

__all__ = ["StereoMap", "StereoSettings", "stereo_depths"]
