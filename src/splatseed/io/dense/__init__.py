"""Writing stereo's depth and normal maps: a COLMAP dense workspace, or a plain folder."""

from splatseed.io.dense.maps import DenseMap
from splatseed.io.dense.plain import write_dense_maps
from splatseed.io.dense.report import DenseReport
from splatseed.io.dense.workspace import check_dense_scene, write_dense_workspace

__all__ = [
    "DenseMap",
    "DenseReport",
    "check_dense_scene",
    "write_dense_maps",
    "write_dense_workspace",
]
