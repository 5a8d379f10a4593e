"""Structure-from-Motion by pycolmap: photographs to a scene folder.

``reconstruct`` estimates poses, lenses and points, or triangulates points at known poses (RGB-D
capture, simulator, calibration), which it can refine (phone, SLAM). ``undistort`` removes lens
distortion. Both write undistorted ``images/`` and ``sparse/0/*.bin`` with PINHOLE cameras, which
every 3DGS trainer reads.

Output is atomic; failures raise ``splatseed.errors``. With one version of pycolmap on the CPU of
one machine, features and verified matches depend only on images, options and seed. Mapping with
several threads sums in varying order, which bundle adjustment can amplify: 20 photographs gave 4095
or 4047 points. With ``threads=1`` the output is bit-identical. On a GPU nothing is guaranteed.
"""

from splatseed.sfm.colmap import MatcherName, Settings
from splatseed.sfm.own_points import points_without_tracks, with_refined
from splatseed.sfm.pipeline import SfmReport, reconstruct, undistort
from splatseed.sfm.refined_scene import RefinedScene, refined
from splatseed.sfm.refinement import Refinement

__all__ = [
    "MatcherName",
    "RefinedScene",
    "Refinement",
    "Settings",
    "SfmReport",
    "points_without_tracks",
    "reconstruct",
    "refined",
    "undistort",
    "with_refined",
]
