from .cleaning import clean_scene as clean_scene
from .depth_maps import (
    DepthFiles as DepthFiles,
    DepthWriter as DepthWriter,
    depth_folder as depth_folder,
)
from .load import (
    find_depths as find_depths,
    load_originals as load_originals,
    load_scene as load_scene,
)
from .write import WriteReport as WriteReport, write_scene as write_scene
