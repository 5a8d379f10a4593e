"""Files that hold a similarity: a matrix as text or JSON, or nerfstudio's transform and scale.

Promise: what is read is a rotation, one scale and a translation; anything else is refused.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.io.files import read_bytes
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
    content = read_json(path, _FIX, "a transform, as text or JSON")
    found = similarity_in(path, content, scene, _FIX)
    return found.inverse if path.name == NERFSTUDIO else found


def similarity_in(path: Path, content: Any, scene: Scene, fix: str) -> Similarity:
    """The similarity that the content of a file is.

    Args:
        path: The file; nerfstudio's is recognised by its name.
        content: Rows of a matrix, or a mapping with them and a scale.
        scene: For nerfstudio's file, whose transform begins from COLMAP's own world.
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
        if path.name == NERFSTUDIO:
            matrix = matrix @ _unapplied(scene, fix)
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


def _unapplied(scene: Scene, fix: str) -> Float64[np.ndarray, "4 4"]:
    """From the scene's world to the one that nerfstudio's transform begins from, COLMAP's own.

    A scene read from transforms.json is in that file's world, to which ``applied_transform`` leads.
    """
    path = None if scene.source is None else scene.source.transforms_path
    if path is None:
        return np.eye(4)
    applied = read_json(path, fix).get("applied_transform", np.eye(4)[:3])
    return np.linalg.inv(np.vstack([np.array(applied, np.float64)[:3], np.eye(4)[3:]]))


def read_json(path: Path, fix: str, expected: str = "JSON") -> Any:
    """The content of a JSON file.

    Args:
        path: The file.
        fix: What errors advise.
        expected: What errors say that the file should be.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is no JSON.
    """
    try:
        return json.loads(read_bytes(path))
    except SceneNotFoundError:
        raise SceneNotFoundError(f"a file {path}", found="none", fix=fix) from None
    except json.JSONDecodeError as error:
        found = _where_it_ends(error)
    except UnicodeDecodeError:
        found = "bytes that are no text"
    except (ValueError, RecursionError) as error:
        found = str(error)
    raise SceneFormatError(f"{path} to be {expected}", found=found, fix=fix)


def _where_it_ends(error: json.JSONDecodeError) -> str:
    """What stands where a text stops being JSON."""
    if not error.doc.strip():
        return "an empty file"
    rest = error.doc[error.pos :].strip().splitlines()
    there = repr(rest[0][:40]) if rest else "its end"
    return f"{there} at line {error.lineno}, column {error.colno}"
