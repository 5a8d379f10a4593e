"""Budgets: the allowed number of points or Gaussians, also per pixel of a photograph (rho)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from splatseed.errors import ParameterError
from splatseed.photos.sizes import TRAINED_SIDE, factor_for_size
from splatseed.photos.view import View, camera_views
from splatseed.scene import Scene

RHO = "rho"
"""The unit of Gaussians per pixel of a photograph."""
MAX_BUDGET = 10**12
"""More points than any trainer holds."""


def points_within(scene: Scene, budget: int | str) -> int:
    """Parse a budget; rho counts pixels of the scene's photographs at the default training size."""
    photographs = _at_trained_size(scene)
    return parse_budget(budget, median_pixels(photographs) if photographs else 0)


def describe_rho(scene: Scene, budget: int | str | None) -> str:
    """Describe the photograph whose pixels a budget in rho counts; empty for other budgets.

    Example:
        >>> from splatseed.pointcloud import PointCloud
        >>> describe_rho(Scene(PointCloud.empty()), "50k")
        ''
    """
    photographs = _at_trained_size(scene)
    if not photographs or not in_rho(budget):
        return ""
    return f": {str(budget).strip()} of {median_size(photographs)} pixels"


def in_rho(budget: int | str | None) -> bool:
    """Whether a budget is per pixel of a photograph."""
    return str(budget).strip().lower().endswith(RHO)


def _at_trained_size(scene: Scene) -> tuple[View, ...]:
    """The views of a scene, without pixels, at the default training size."""
    images = scene.images
    return camera_views(images, factor_for_size(images, TRAINED_SIDE)) if images else ()


def median_size(views: Sequence[View]) -> str:
    """Return the width and height of the view of median size, for messages: "1600 x 1200"."""
    by_pixels = sorted(views, key=lambda view: view.width * view.height)
    middle = by_pixels[len(by_pixels) // 2]
    return f"{middle.width} x {middle.height}"


def median_pixels(views: Sequence[View]) -> float:
    """Return the pixels of the median view; without views, raise a ``ParameterError``."""
    if not views:
        raise ParameterError(
            "images, for a budget in rho", found="none", fix="Give a number of seeds instead."
        )
    return float(np.median([view.width * view.height for view in views]))


def parse_budget(budget: str | float, pixels: float) -> int:
    """Return the number that a budget allows, such as 50000, "50k" or "0.25rho".

    Args:
        budget: A number, also with suffix k or m, or a number of Gaussians per pixel with ``rho``.
        pixels: Pixels of one photograph; 0 if there are none.

    Raises:
        ParameterError: It is no such number, below 1, or above ``MAX_BUDGET``.

    Example:
        >>> parse_budget("50k", 0), parse_budget("0.25rho", 800 * 600)
        (50000, 120000)
    """
    text = str(budget).strip().lower()
    units = {RHO: pixels, "k": 1e3, "m": 1e6}
    unit = next((u for u in units if text.endswith(u)), "")
    try:
        number = float(text.removesuffix(unit)) * units.get(unit, 1.0)
    except ValueError:
        number = math.nan
    if not (0.5 < number <= MAX_BUDGET) or (not unit and number < 1):
        fix = f"Did you mean {text}rho?" if not unit and 0 < number < 1 else "Give 1 or more."
        if unit == RHO and not pixels:
            fix = "Give a number of points: there are no photographs whose pixels could be counted."
        raise ParameterError(
            "a budget such as 50000, 50k, or 0.25rho (a quarter of the pixels of an image)",
            found=repr(budget),
            fix=fix,
        )
    return round(number)
