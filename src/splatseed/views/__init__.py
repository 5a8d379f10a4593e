"""Photographs at a size, with their cameras: the input of depth, stereo, seeding and training.

``view`` reads a scene's images as pinhole views, ``photographs`` their pixels.
"""

from splatseed.views.view import (
    View,
    check_lens,
    load_photograph,
    load_split,
    load_views,
    poses_of,
    user_cache_dir,
)

__all__ = [
    "View",
    "check_lens",
    "load_photograph",
    "load_split",
    "load_views",
    "poses_of",
    "user_cache_dir",
]
