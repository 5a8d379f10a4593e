"""Formats of trained Gaussians that are not read, so that errors can name what reads them.

Promise: only a file's name and, of a PLY, its header are looked at.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from splatseed.errors import SceneFormatError

__all__ = ["refuse_foreign", "refuse_packed"]

_FORMATS = {
    ".spz": "Gaussians compressed by Niantic's spz",
    ".splat": "Gaussians in the .splat format of web viewers, 32 bytes each",
    ".ksplat": "Gaussians in the .ksplat format of GaussianSplats3D",
    ".sog": "Gaussians compressed as PlayCanvas's SOG",
}
_PACKED = "Gaussians compressed as PlayCanvas's .compressed.ply"


def refuse_foreign(path: Path) -> None:
    """Refuse a file whose name is that of a known format which is not read.

    Raises:
        SceneFormatError: It is.
    """
    found = _FORMATS.get(path.suffix.lower())
    if found is not None and path.is_file():
        raise _foreign(path, found)


def refuse_packed(path: Path, properties: Collection[str]) -> None:
    """Refuse a PLY whose vertices are packed Gaussians.

    Args:
        path: The file.
        properties: Those of its vertices.

    Raises:
        SceneFormatError: They are.
    """
    if "packed_position" in properties:
        raise _foreign(path, _PACKED)


def _foreign(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a .ply as 3DGS writes it, or of points",
        found=f"{found}, which splatseed does not read",
        fix="Convert it: PlayCanvas's splat-transform (npx @playcanvas/splat-transform IN "
        "OUT.ply) and"
        " SuperSplat write such a .ply. It holds a trained model, not a scene: score it with "
        "splatseed"
        " evaluate.",
    )
