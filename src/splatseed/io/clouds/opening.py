"""Opening a cloud by its name: which reader reads which file."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from pathlib import Path

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.clouds.cloud_file import CloudFile
from splatseed.io.ply.foreign import refuse_foreign

_READERS = {
    ".las": "las:LasCloud",
    ".laz": "las:LasCloud",
    ".e57": "e57:E57Cloud",
    ".ply": "ply:PlyCloud",
    ".pcd": "pcd:PcdCloud",
    ".xyz": "text:TextCloud",
    ".txt": "text:TextCloud",
    ".csv": "text:TextCloud",
    ".asc": "text:TextCloud",
    ".pts": "text:TextCloud",
    ".npz": "arrays:NpzCloud",
    ".glb": "gltf:GlbCloud",
}
SUFFIXES = tuple(_READERS)
"""The endings of names that ``open_cloud`` knows, in lower case."""


def open_cloud(path: Path | str) -> CloudFile:
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
    refuse_foreign(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None or not path.is_file():
        raise SceneFormatError(
            f"{path} to be a cloud: {', '.join(SUFFIXES)}",
            found="a folder" if path.is_dir() else f"a {path.suffix or 'nameless'} file",
            fix="Name a file of points; a scene that splatseed reads goes in SCENE's place.",
        )
    module, _, name = reader.partition(":")
    # Readers load with their use: each needs packages that others do without.
    open_file: Callable[[Path], CloudFile] = getattr(
        import_module(f"splatseed.io.clouds.{module}"), name
    )
    return open_file(path)
