"""Read external clouds (scans, dense reconstructions, point maps) of any size in chunks.

``open_cloud`` detects the format. A ``CloudFile`` yields points in chunks, in the file's own
coordinates. Optional packages are imported only when a file needs them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.cloud_file import CloudChunk, CloudFile
from splatseed.io.files import StrPath, translate_read_errors
from splatseed.io.ply import refuse_gaussians

__all__ = ["CloudChunk", "CloudFile", "open_cloud"]

_READERS = {
    **dict.fromkeys((".las", ".laz"), "splatseed.io.clouds.scans:LasCloud"),
    ".e57": "splatseed.io.clouds.scans:E57Cloud",
    ".ply": "splatseed.io.ply:open_ply",
    ".pcd": "splatseed.io.clouds.pcd:open_pcd",
    **dict.fromkeys(
        (".xyz", ".txt", ".csv", ".asc", ".pts", ".xyzrgb", ".xyzn"),
        "splatseed.io.clouds.text:open_text",
    ),
    ".npz": "splatseed.io.clouds.networks:NpzCloud",
    ".glb": "splatseed.io.clouds.networks:GlbCloud",
}
_SCANNERS = "Save it as .e57 or .las"
_OTHERS = {
    ".ptx": ("a gridded scan of Leica's", f"{_SCANNERS} in CloudCompare, which applies its poses."),
    ".fls": ("a scan of FARO's", f"{_SCANNERS} in FARO SCENE or CloudCompare."),
    ".rcp": ("a project of Autodesk ReCap", "Export it as .e57 or .pts in ReCap."),
    ".rcs": ("a scan of Autodesk ReCap", "Export it as .e57 or .pts in ReCap."),
    ".zfs": ("a scan of Zoller+Froehlich's", f"{_SCANNERS} in Z+F LaserControl."),
    ".obj": ("a mesh", "Sample points of it in CloudCompare or MeshLab, and save them as .ply."),
    ".stl": ("a mesh", "Sample points of it in CloudCompare or MeshLab, and save them as .ply."),
    ".gltf": ("a glTF with its data in other files", "Save it as .glb, for instance in Blender."),
    ".npy": ("an array of NumPy", "Save it as .npz: np.savez('cloud.npz', xyz=..., rgb=...)."),
    ".bin": ("a project of CloudCompare, or another binary file", f"{_SCANNERS} or .ply."),
}
"""Other files of points: what they are, and what reads them."""


def open_cloud(path: StrPath, columns: str | Sequence[str] = ()) -> CloudFile:
    """Open a point file; the suffix determines the format.

    Args:
        path: A .las, .laz, .e57, .ply, .pcd, .xyz, .txt, .csv, .asc, .pts, .npz or .glb file.
        columns: Names of a text file's columns, such as "x y z i r g b"; "_" skips one. By default
            they are those of its header, or found from the values.

    Raises:
        SceneNotFoundError: No such file.
        SceneFormatError: Another suffix, or malformed content.
        ParameterError: ``columns`` are not those of the file.
        MissingDependencyError: The package for this format is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise SceneNotFoundError(f"a cloud at {path}", found="no such file", fix="Check the path.")
    refuse_gaussians(path)
    reader = _READERS.get(path.suffix.lower())
    if (other := _OTHERS.get(path.suffix.lower())) and path.is_file():
        raise SceneFormatError(
            f"{path} to be a cloud: {', '.join(_READERS)}", found=other[0], fix=other[1]
        )
    if reader is None or not path.is_file():
        raise SceneFormatError(
            f"{path} to be a cloud: {', '.join(_READERS)}",
            found="a folder" if path.is_dir() else f"a {path.suffix or 'nameless'} file",
            fix="Pass a file of points; a folder or scene is not one.",
        )
    module, _, name = reader.partition(":")
    # Import readers on use: each needs other optional packages.
    opened: Callable[..., CloudFile] = getattr(import_module(module), name)
    with translate_read_errors(path):
        return opened(path, columns) if name == "open_text" else opened(path)
