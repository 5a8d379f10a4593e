"""Formats of trained Gaussians alone, so that errors can say that a file is a model and no scene.

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
    """Refuse a file whose name is that of a known format of models.

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
        f"{path} to be a scene, or a .ply of points",
        found=f"{found}: a trained model",
        fix="Score it with splatseed evaluate MODEL --scene SCENE, look at it with splatseed view "
        "MODEL; a .ply of it, by splatseed export MODEL -o OUT.ply, is read as points too.",
    )
