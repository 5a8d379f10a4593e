"""Structure-from-Motion: photographs to a scene folder, by pycolmap.

``reconstruct`` finds poses, lenses and points, or points alone for poses that are already known (an
RGB-D capture, a simulator, another tool's calibration), and can refine those where a phone or SLAM
made them; ``undistort`` removes lens distortion from a scene. Both write the folder that every 3DGS
trainer reads: undistorted ``images/`` and ``sparse/0/*.bin`` with PINHOLE cameras.

Promise: the output appears whole or not at all, and every failure is one of ``splatseed.errors``.
With one version of pycolmap on the CPU of one machine, features and verified matches are the same
for the same images, options and seed. Mapping with several threads sums in varying order, and
bundle adjustment can amplify that: 20 photographs gave 4095 points or 4047. With ``threads=1`` the
files are the same byte for byte. A GPU guarantees nothing.
"""

from splatseed.sfm.colmap import MatcherName, Settings
from splatseed.sfm.pipeline import SfmReport, reconstruct, refined, undistort, with_refined
from splatseed.sfm.refinement import Refinement

__all__ = [
    "MatcherName",
    "Refinement",
    "Settings",
    "SfmReport",
    "reconstruct",
    "refined",
    "undistort",
    "with_refined",
]
