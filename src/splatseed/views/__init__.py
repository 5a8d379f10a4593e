"""Photographs at a size, with their cameras: the input of depth, stereo, seeding and training.

``view`` reads a scene's images as pinhole views, ``photographs`` their pixels.
"""

from splatseed.views.photographs import load_photograph, user_cache_dir
from splatseed.views.view import View, check_lens, load_split, load_views, poses_of

__all__ = [
    "View",
    "check_lens",
    "load_photograph",
    "load_split",
    "load_views",
    "poses_of",
    "user_cache_dir",
]
