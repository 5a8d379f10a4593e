"""splatseed: better seeds for 3D Gaussian Splatting.

>>> import splatseed as ss
>>> sorted(ss.METHODS)[:3]
['auto', 'cloud', 'cover']
"""

from splatseed.camera import Camera
from splatseed.depth.stereo import stereo_depths
from splatseed.errors import SplatseedError
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding.upsampling import add_cover as cover, upsample
from splatseed.upsample import METHODS, upsample_points

__all__ = [
    "METHODS",
    "Camera",
    "PointCloud",
    "Scene",
    "SplatseedError",
    "cover",
    "load_scene",
    "stereo_depths",
    "upsample",
    "upsample_points",
    "write_scene",
]
