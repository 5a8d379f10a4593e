"""Reading and writing scenes, a file or folder per format.

``load_scene`` recognises what a path holds; ``write_scene`` makes a folder that every 3D Gaussian
Splatting trainer loads unchanged; ``find_depths`` finds the depth maps of a scene's images.
Promise: malformed input and failing output raise one error from ``splatseed.errors``; importing
this package loads neither Numba nor SciPy.
"""

from splatseed.io.cleaning import clean_scene
from splatseed.io.depth_maps import DepthFiles, DepthWriter, depth_folder
from splatseed.io.load import find_depths, load_originals, load_scene
from splatseed.io.write import WriteReport, write_scene

__all__ = [
    "DepthFiles",
    "DepthWriter",
    "WriteReport",
    "clean_scene",
    "depth_folder",
    "find_depths",
    "load_originals",
    "load_scene",
    "write_scene",
]
