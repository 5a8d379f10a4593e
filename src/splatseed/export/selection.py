"""The Gaussians of a model to keep: within a box, and opaque enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from splatseed.errors import ParameterError
from splatseed.splat.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class Crop:
    """A box in the model's world.

    Args:
        low: Minimum corner, [3].
        high: Maximum corner, [3].
    """

    low: Float64[np.ndarray, " 3"]
    high: Float64[np.ndarray, " 3"]


def parse_crop(text: str) -> Crop:
    """The box given by six comma-separated numbers: minimum x, y, z, then maximum x, y, z.

    Raises:
        ParameterError: There are not six, or they make no box.

    Example:
        >>> parse_crop("-1,-1,-1,1,1,2").high.tolist()
        [1.0, 1.0, 2.0]
    """
    try:
        numbers = np.array([float(word) for word in text.split(",")])
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (6,) or not (numbers[:3] < numbers[3:]).all():
        raise ParameterError(
            "--crop x0,y0,z0,x1,y1,z1, the minimum and maximum corners of a box",
            found=repr(text),
            fix="splatseed info SCENE prints the bounding box of the points.",
        )
    return Crop(numbers[:3], numbers[3:])


def check_opacity(min_opacity: float) -> None:
    """Refuse a lowest opacity that is not from 0 to 1.

    Raises:
        ParameterError: It is not.
    """
    if not 0 <= min_opacity < 1:
        raise ParameterError(
            "--min-opacity of 0 or more, less than 1", found=f"{min_opacity}", fix="Try 0.05."
        )


def keep_gaussians(
    gaussians: Gaussians, crop: Crop | None = None, min_opacity: float = 0.0
) -> Gaussians:
    """The Gaussians whose centres lie in a box and that are opaque enough, in their order.

    Args:
        gaussians: The model's.
        crop: The box; no limit when left out.
        min_opacity: Lowest opacity kept, 0 to 1.

    Raises:
        ParameterError: The opacity is out of range, or no Gaussian is left.
    """
    check_opacity(min_opacity)
    keep = _opaque(gaussians, min_opacity)
    if crop is not None:
        keep &= ((gaussians.means >= crop.low) & (gaussians.means <= crop.high)).all(axis=1)
    if keep.all():
        return gaussians
    if not keep.any():
        low, high = (_words(end(gaussians.means, axis=0)) for end in (np.min, np.max))
        raise ParameterError(
            "--crop and --min-opacity to leave some Gaussians",
            found=f"none of {len(gaussians):,}, whose centres lie from {low} to {high}",
            fix="Choose a larger box or a smaller opacity.",
        )
    return Gaussians(**{name: array[keep] for name, array in gaussians.arrays().items()})


def _opaque(gaussians: Gaussians, min_opacity: float) -> Bool[np.ndarray, " N"]:
    if min_opacity == 0:
        return np.ones(len(gaussians), bool)
    return np.asarray(gaussians.opacities >= np.log(min_opacity / (1 - min_opacity)))


def _words(corner: np.ndarray) -> str:
    return " ".join(f"{value:.4g}" for value in corner)
