"""Read external clouds (scans, dense reconstructions, point maps) of any size in chunks.

``open_cloud`` detects the format. A ``CloudFile`` yields points in chunks, in the file's own
coordinates. Optional packages are imported only when a file needs them.
"""

from __future__ import annotations

from collections.abc import Callable
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
    **dict.fromkeys((".xyz", ".txt", ".csv", ".asc", ".pts"), "splatseed.io.clouds.text:open_text"),
    ".npz": "splatseed.io.clouds.networks:NpzCloud",
    ".glb": "splatseed.io.clouds.networks:GlbCloud",
}


def open_cloud(path: StrPath) -> CloudFile:
    """Open a point file; the suffix determines the format.

    Args:
        path: A .las, .laz, .e57, .ply, .pcd, .xyz, .txt, .csv, .asc, .pts, .npz or .glb file.

    Raises:
        SceneNotFoundError: No such file.
        SceneFormatError: Another suffix, or malformed content.
        MissingDependencyError: The package for this format is not installed.
    """
    path = Path(path)
    if not path.exists():
        raise SceneNotFoundError(f"a cloud at {path}", found="no such file", fix="Check the path.")
    refuse_gaussians(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None or not path.is_file():
        raise SceneFormatError(
            f"{path} to be a cloud: {', '.join(_READERS)}",
            found="a folder" if path.is_dir() else f"a {path.suffix or 'nameless'} file",
            fix="Pass a file of points; a folder or scene is not one.",
        )
    module, _, name = reader.partition(":")
    # Import readers on use: each needs other optional packages.
    opened: Callable[[Path], CloudFile] = getattr(import_module(module), name)
    with translate_read_errors(path):
        return opened(path)
