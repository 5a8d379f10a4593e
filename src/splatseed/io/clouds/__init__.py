"""Clouds from elsewhere: scans, dense reconstructions, point maps, read in chunks at any size.

``open_cloud`` recognises the format; a ``CloudFile`` says what its header promises and gives its
points in chunks, in the file's own coordinates. Promise: importing this package loads none of the
optional packages that read formats.
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
    """Open a cloud; the ending of its name tells the format.

    Args:
        path: A .las, .laz, .e57, .ply, .pcd, .xyz, .txt, .csv, .asc, .pts, .npz or .glb file.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: Its name ends in something else, or it is not what its name says.
        MissingDependencyError: The package that reads this format is not installed.
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
            fix="Name a file of points; a scene that splatseed reads goes in SCENE's place.",
        )
    module, _, name = reader.partition(":")
    # Readers load with their use: each needs packages that others do without.
    opened: Callable[[Path], CloudFile] = getattr(import_module(module), name)
    with translate_read_errors(path):
        return opened(path)
