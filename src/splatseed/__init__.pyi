from .camera import Camera as Camera
from .depth.stereo import stereo_depths as stereo_depths
from .errors import SplatseedError as SplatseedError
from .io import load_scene as load_scene, write_scene as write_scene
from .methods import METHODS as METHODS
from .pointcloud import PointCloud as PointCloud
from .requirements import __version__ as __version__
from .scene import Scene as Scene
from .seeding.upsampling import add_cover as add_cover, upsample as upsample
from .splat.api import render as render
from .splat.formats import read_gaussians as read_gaussians
from .splat.gaussians import Gaussians as Gaussians
from .training.api import Run as Run, evaluate as evaluate, train as train
