"""File formats of trained Gaussians, so that errors can say that a file is a model, not a scene.

Promise: only a file's name and, for a PLY, its header are looked at.
"""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from splatseed.errors import SceneFormatError

_FORMATS = {
    ".spz": "Gaussians compressed by Niantic's spz",
    ".splat": "Gaussians in the .splat format of web viewers, 32 bytes each",
    ".ksplat": "Gaussians in the .ksplat format of GaussianSplats3D",
    ".sog": "Gaussians compressed as PlayCanvas's SOG",
}
_PACKED = "Gaussians compressed as PlayCanvas's .compressed.ply"


def refuse_foreign(path: Path) -> None:
    """Refuse a file whose name is that of a known model format.

    Raises:
        SceneFormatError: It is one.
    """
    kind = _FORMATS.get(path.suffix.lower())
    if kind is not None and path.is_file():
        raise _foreign(path, kind)


def refuse_packed(path: Path, properties: Collection[str]) -> None:
    """Refuse a PLY whose vertices are packed Gaussians.

    Args:
        path: The file.
        properties: The properties of its vertices.

    Raises:
        SceneFormatError: They are.
    """
    if "packed_position" in properties:
        raise _foreign(path, _PACKED)


def _foreign(path: Path, kind: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a scene, or a .ply of points",
        found=f"{kind}: a trained model",
        fix="Score it with splatseed evaluate MODEL --scene SCENE, look at it with splatseed view "
        "MODEL; a .ply of it, by splatseed export MODEL -o OUT.ply, is read as points too.",
    )
