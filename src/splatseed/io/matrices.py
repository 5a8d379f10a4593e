"""Matrices that users give: as numbers, or as the name of a file with them.

Notation: a matrix of 3 or 4 rows of 4 numbers takes old to new coordinates, x -> A x + t with
[A t] its first three rows; the fourth is 0 0 0 1.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.errors import ParameterError, SceneFormatError
from splatseed.io.files import StrPath, read_bytes, read_json
from splatseed.scene import Scene
from splatseed.similarity import Similarity, similarity_of

_KEYS = ("transform", "matrix", "transform_matrix", "transformation")
"""Names under which programs store a matrix in JSON; nerfstudio's ``transform`` has a scale."""
_FIX = "Write 3 or 4 rows of 4 numbers, as text or JSON."
NERFSTUDIO = "dataparser_transforms.json"
"""The file in which nerfstudio records how it moved a scene."""
_TOLERANCE = 1e-3
"""Largest relative difference of the three scales of a similarity."""


def parse_numbers(text: str) -> list[float] | None:
    """Parse numbers between commas or blanks; None for any other text.

    Example:
        >>> parse_numbers("1, 2 3"), parse_numbers("box.txt")
        ([1.0, 2.0, 3.0], None)
    """
    try:
        return [float(word) for word in text.replace(",", " ").split()] or None
    except ValueError:
        return None


def parse_matrix(text: str, name: str) -> Float64[np.ndarray, "4 4"]:
    """Parse a matrix from 12 or 16 numbers, row by row, or the file of a matrix, text or JSON.

    ``name`` is that of the parameter, for errors.

    Raises:
        SceneNotFoundError: There is no such file.
        ParameterError: It is no invertible matrix.
    """
    numbers: Any = parse_numbers(text)
    scale = 1.0
    if numbers is None:
        content = read_bytes(Path(text)).decode("utf-8", "replace")
        numbers = parse_numbers(content)
        if numbers is None:
            numbers, scale = _from_json(content)
    try:
        flat = np.array(numbers, np.float64).reshape(-1)
    except (TypeError, ValueError):
        flat = np.empty(0)
    if len(flat) == 12:
        flat = np.r_[flat, 0, 0, 0, 1]
    found, fix = f"{len(flat)} numbers", "Write 4 rows of 4 numbers, as text or JSON."
    if len(flat) == 16 and np.isfinite(flat).all():
        matrix = flat.reshape(4, 4)
        matrix[:3] *= scale
        if np.allclose(matrix[3], [0, 0, 0, 1], rtol=0, atol=1e-9):
            if np.linalg.matrix_rank(matrix) == 4:
                return matrix
            found = "a matrix that flattens space: its determinant is 0"
        else:
            found = f"a last row of {' '.join(f'{x:g}' for x in matrix[3])}, not 0 0 0 1"
            if not matrix[:3, 3].any():
                fix = "Transpose it: rows come first, and the translation is the last column."
    expected = f"`{name}` as a matrix of 12 or 16 numbers, or its file"
    raise ParameterError(expected, found=found, fix=fix)


def _from_json(content: str) -> tuple[Any, float]:
    """Return the matrix in a JSON text, and the scale beside it."""
    try:
        value = json.loads(content)
        if not isinstance(value, dict):
            return value, 1.0
        key = next(key for key in _KEYS if key in value)
        return value[key], float(value.get("scale", 1.0)) if key == "transform" else 1.0
    except (ValueError, TypeError, StopIteration, RecursionError):
        return None, 1.0


def parse_similarity(text: str, name: str = "transform") -> Similarity:
    """Parse a matrix of a rotation, one scale and a translation, as ``parse_matrix`` does.

    Raises:
        SceneNotFoundError: There is no such file.
        ParameterError: It is another matrix: a Gaussian's colours and size cannot follow it.

    Example:
        >>> parse_similarity("0 -2 0 5, 2 0 0 0, 0 0 2 0").scale
        2.0
    """
    matrix = parse_matrix(text, name)
    left, scales, right = np.linalg.svd(matrix[:3, :3])
    mirrored = np.linalg.det(matrix[:3, :3]) < 0
    if not mirrored and scales[0] - scales[2] <= _TOLERANCE * scales[0]:
        # The nearest rotation: numbers in files are often rounded.
        return Similarity(float(scales.mean()), left @ right, matrix[:3, 3])
    fault = f"a matrix that scales by {scales[2]:.4g} to {scales[0]:.4g}, by direction"
    if mirrored:
        fault = "a mirror: its determinant is negative"
    raise ParameterError(
        f"`{name}` as a rotation, one scale and a translation",
        found=fault,
        fix="Harmonics and rotations of Gaussians follow no other transform.",
    )


def read_cloud_transform(path: StrPath, scene: Scene) -> Similarity:
    """Read a similarity from a cloud's frame to the scene's; else raise ``SceneFormatError``.

    Nerfstudio's file maps the scene to the world in which it trains and exports, so for a cloud
    exported there the inverse is returned.
    """
    path = Path(path)
    with suppress(ValueError):  # not plain numbers
        rows = np.loadtxt(read_bytes(path).decode("utf-8").splitlines(), np.float64, ndmin=2)
        return similarity_in(path, rows.tolist(), scene, _FIX)
    content = read_json(path, "a transform, as text or JSON", fix=_FIX)
    found = similarity_in(path, content, scene, _FIX)
    return found.inverse if path.name == NERFSTUDIO else found


def similarity_in(path: Path, content: Any, scene: Scene, fix: str) -> Similarity:
    """Parse a similarity: the rows of a matrix, or a mapping with a matrix and a scale.

    Nerfstudio's file, recognised by its name, maps from COLMAP's own world; for a scene read from
    transforms.json, the inverse of ``applied_transform`` is applied first. Raises
    ``SceneFormatError`` with this ``fix`` if the content is no similarity.
    """
    scale, rows = 1.0, content
    if isinstance(content, dict):
        rows = next((content[key] for key in _KEYS if key in content), None)
        # Beside other matrices it repeats the matrix's own scale, as in alignment.json.
        scale = content.get("scale", 1.0) if "transform" in content else 1.0
    try:
        matrix = np.atleast_1d(np.array(rows, np.float64))
        matrix = np.concatenate([matrix[:3] * float(scale), np.eye(4)[3:]])
        transforms = scene.source.transforms_path
        if path.name == NERFSTUDIO and transforms is not None:
            applied = read_json(transforms, fix=fix).get("applied_transform")
            applied = np.eye(4) if applied is None else np.array(applied, np.float64)
            applied = np.vstack([applied[:3], np.eye(4)[3:]])
            matrix = matrix @ np.linalg.inv(applied)
        world = similarity_of(matrix)
    except (TypeError, ValueError, OverflowError):
        world = None
    if world is None:
        expected = (
            f"{path} to hold a similarity (rotation, shift and one scale; no shear, no mirror): 3"
            " or 4 rows of 4 numbers, by themselves or as transform, with a scale beside them"
        )
        found = repr(rows)
        found = found if len(found) <= 80 else f"{found[:77]}..."
        raise SceneFormatError(expected, found=found, fix=fix)
    return world
