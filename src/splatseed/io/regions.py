"""Regions of space that users give as text: a box, a sphere, a turned box."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Float64

from splatseed.errors import ParameterError
from splatseed.io.matrices import parse_matrix, parse_numbers

Region: TypeAlias = Callable[[Float[np.ndarray, "N 3"]], Bool[np.ndarray, " N"]]
"""Maps positions to whether they lie in a region."""
REGION_FORM = "x0,y0,z0,x1,y1,z1|x,y,z,r|FILE"
"""What ``parse_region`` parses, for the help of options."""


def parse_region(text: str, name: str = "region") -> Region:
    """Parse a region: six numbers, four, or a matrix.

    - x0,y0,z0,x1,y1,z1: a box, by its minimum and maximum corners;
    - x,y,z,r: a sphere, by its centre and radius;
    - 12 or 16 numbers, or a file with them: a turned box, by the matrix from the cube of side 1
      around 0 to the box. Its columns are the box's edges and its centre.

    ``name`` is that of the parameter, for errors.

    Raises:
        SceneNotFoundError: There is no such file.
        ParameterError: It is no region.

    Example:
        >>> inside = parse_region("-1,-1,-1,1,1,2")
        >>> inside(np.array([[0, 0, 2.0], [0, 0, -2.0]])).tolist()
        [True, False]
    """
    numbers = parse_numbers(text)
    if numbers is not None and len(numbers) == 6:
        low, high = np.reshape(numbers, (2, 3))
        if (low < high).all():
            return lambda xyz: np.asarray(((xyz >= low) & (xyz <= high)).all(axis=1))
    elif numbers is not None and len(numbers) == 4:
        center, radius = np.array(numbers[:3]), numbers[3]
        if radius > 0 and np.isfinite(center).all():
            return lambda xyz: np.asarray(np.linalg.norm(xyz - center, axis=1) <= radius)
    elif len(numbers or ()) in {12, 16} or (numbers is None and _is_file(text)):
        return turned_box(parse_matrix(text, name))
    raise ParameterError(
        f"`{name}=x0,y0,z0,x1,y1,z1`, the minimum and maximum corners of a box, x,y,z,r, the "
        "centre and radius of a sphere, or the matrix of a turned box",
        found=repr(text),
        fix="splatseed info SCENE prints the bounding box of the points.",
    )


def turned_box(world_from_cube: Float64[np.ndarray, "4 4"]) -> Region:
    """Return the box that an invertible matrix makes of the cube of side 1 around 0."""
    cube_from_world = np.linalg.inv(world_from_cube)
    turn, shift = cube_from_world[:3, :3], cube_from_world[:3, 3]
    return lambda xyz: np.asarray((np.abs(xyz @ turn.T + shift) <= 0.5).all(axis=1))


def _is_file(text: str) -> bool:
    """Whether text names a file, rather than misspelt numbers."""
    return bool(text.strip()) and (Path(text).exists() or "," not in text)
