"""Structure-from-Motion: photographs to a scene folder, by pycolmap.

``reconstruct`` finds poses, lenses and points; ``triangulate`` finds points for poses that are
already known (an RGB-D capture, a simulator, another tool's calibration). Both write the folder
that every 3DGS trainer reads: ``images/`` free of lens distortion, ``sparse/0/*.bin`` with PINHOLE
cameras.

Promise: the output appears whole or not at all, and every failure is one of ``splatseed.errors``.
pycolmap is an optional dependency (``pip install "splatseed[sfm]"``), imported when it is needed.

Reproducibility: features, matches and their verification are the same for the same images, options
and seed on one machine. The poses and points of ``reconstruct`` agree to the rounding of parallel
sums, which bundle adjustment can amplify, and ``threads=1`` removes that. Another pycolmap version,
another CPU or a GPU may give a different, equally valid model.
"""

from splatseed.sfm.pipeline import reconstruct, triangulate
from splatseed.sfm.report import SfmReport
from splatseed.sfm.settings import DeviceName, MatcherName

__all__ = ["DeviceName", "MatcherName", "SfmReport", "reconstruct", "triangulate"]
