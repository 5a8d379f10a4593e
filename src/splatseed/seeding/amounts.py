"""A budget in words: how many seeds or Gaussians there may be."""

from __future__ import annotations

import math
import re

from splatseed.errors import ParameterError

RHO = "rho"
"""The unit of Gaussians per pixel of a photograph."""
DECIMAL = re.compile(r"\d+,\d+(rho|k|m)")
"""A number with a decimal comma and a unit."""
MOST = 10**12
"""More than any trainer holds, so that a slip is told at once."""


def parse_budget(budget: str | float, pixels: float) -> int:
    """The number of points or Gaussians that a budget allows.

    Args:
        budget: A number such as 50000, "50000", "50k" or "0.5M", or "0.25rho" for Gaussians per
            pixel of one image.
        pixels: Pixels of one image.

    Raises:
        ParameterError: It is neither, or allows none, or more than anything can hold.

    Example:
        >>> parse_budget("50k", 0), parse_budget("0.25rho", 800 * 600)
        (50000, 120000)
    """
    text = str(budget).strip().lower()
    units = {RHO: pixels, "k": 1e3, "m": 1e6}
    unit = next((each for each in units if text.endswith(each)), "")
    try:
        number = float(text.removesuffix(unit)) * units.get(unit, 1.0)
    except ValueError:
        number = math.nan
    bare = not unit and 0 < number < 1
    if bare or not (math.isfinite(number) and round(number) >= 1):
        none = unit == RHO and 0 < number < 1  # photographs are too small for this share
        meant = f"{text}rho" if bare else text.replace(",", ".") if DECIMAL.fullmatch(text) else ""
        smaller = ", or reduce photographs by a smaller factor" if none else ""
        raise ParameterError(
            "a budget such as 50000, 50k, or 0.25rho (a quarter of the pixels of an image)",
            found=f"{text}, which of {pixels:,.6g} pixels is none" if none else repr(budget),
            fix=f"Did you mean {meant}?" if meant else f"Give a number of at least 1{smaller}.",
        )
    if number > MOST:
        raise ParameterError(
            "a budget that a trainer can hold", found=repr(budget), fix="Give one such as 500k."
        )
    return round(number)
