"""Files that hold a similarity: a matrix as text or JSON, or nerfstudio's transform and scale.

Promise: what is read is a rotation, one scale and a translation; anything else is refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import SceneFormatError
from splatseed.io.files import read_bytes, read_json
from splatseed.scene import Scene
from splatseed.similarity import Similarity, similarity_of

NERFSTUDIO = "dataparser_transforms.json"
_KEYS = ("transform", "matrix", "transform_matrix", "transformation")
_FIX = "Give 3 or 4 rows of 4 numbers, as text or JSON."


def read_cloud_transform(path: Path, scene: Scene) -> Similarity:
    """The transform from a cloud's frame to the scene's.

    Nerfstudio's file leads from the scene to the world that it trains and exports in, so a cloud
    from there goes the other way.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It holds no similarity.
    """
    try:
        rows = np.loadtxt(read_bytes(path).decode("utf-8").splitlines(), np.float64, ndmin=2)
        return similarity_in(path, rows.tolist(), scene, _FIX)
    except (UnicodeDecodeError, ValueError):
        pass  # not plain numbers
    content = read_json(path, "a transform, as text or JSON", fix=_FIX)
    found = similarity_in(path, content, scene, _FIX)
    return found.inverse if path.name == NERFSTUDIO else found


def similarity_in(path: Path, content: Any, scene: Scene, fix: str) -> Similarity:
    """The similarity that the content of a file is.

    Args:
        path: The file; nerfstudio's is recognised by its name.
        content: Rows of a matrix, or a mapping with them and a scale.
        scene: For nerfstudio's file, whose transform begins from COLMAP's own world: a scene read
            from transforms.json is in that file's world, to which ``applied_transform`` leads.
        fix: What errors advise.

    Raises:
        SceneFormatError: It is none.
    """
    scale, rows = 1.0, content
    if isinstance(content, dict):
        rows = next((content[key] for key in _KEYS if key in content), None)
        scale = content.get("scale", 1.0)
    try:
        matrix = np.atleast_1d(np.array(rows, np.float64))
        matrix = np.concatenate([matrix[:3] * float(scale), np.eye(4)[3:]])
        transforms = scene.source.transforms_path if scene.source else None
        if path.name == NERFSTUDIO and transforms is not None:
            applied = read_json(transforms, fix=fix).get("applied_transform", np.eye(4)[:3])
            applied = np.vstack([np.array(applied, np.float64)[:3], np.eye(4)[3:]])
            matrix = matrix @ np.linalg.inv(applied)
        world = similarity_of(matrix)
    except (TypeError, ValueError):
        world = None
    if world is None:
        raise SceneFormatError(
            f"{path} to hold a similarity (rotation, shift and one scale; no shear, no mirror): 3 "
            "or 4 rows of 4 numbers, by themselves or as transform, with a scale beside them",
            found=repr(rows)[:80],
            fix=fix,
        )
    return world
