"""What every upsampling method is: a frozen dataclass of parameters that can be called.

A method gets the prepared originals, the number of points to make and a random generator, and
returns positions in the world and colours. All else (masking, de-duplication, putting originals
first) is done once, around it.
"""

from __future__ import annotations

import dataclasses
import math
import types
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    Union,
    get_args,
    get_origin,
    get_type_hints,
    runtime_checkable,
)

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import ParameterError
from splatseed.progress import Progress

if TYPE_CHECKING:  # SciPy and Numba load with the first method, not with the package
    from splatseed.upsample.neighbors import PreparedCloud

__all__ = ["NewPoints", "Upsampler", "check_fields", "require"]


class NewPoints(NamedTuple):
    """What a method returns: positions, colours, and whatever more it knows of its points."""

    xyz: Float32[np.ndarray, "M 3"]
    """World positions, float32 [M, 3]."""
    rgb: UInt8[np.ndarray, "M 3"]
    """Colours, uint8 [M, 3]."""
    notes: tuple[str, ...] = ()
    """What the user should know of them, one sentence each."""
    normals: Float32[np.ndarray, "M 3"] | None = None
    """Unit normals, world axes, float32 [M, 3]; NaN where unknown."""
    sizes: Float32[np.ndarray, " M"] | None = None
    """Radius that a Gaussian there should begin with, float32 [M], scene units; NaN where unknown."""
    confidence: Float32[np.ndarray, " M"] | None = None
    """How sure it is that a surface is there, float32 [M], 0 to 1; NaN where unknown."""
    source: UInt8[np.ndarray, " M"] | None = None
    """Codes of the methods that made them, uint8 [M], never 0; the method's own when left out."""


@runtime_checkable
class Upsampler(Protocol):
    """An upsampling method. Third parties register classes under ``splatseed.methods``."""

    def __call__(
        self, cloud: PreparedCloud, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make exactly ``num_new`` finite points from the prepared originals.

        Every random number comes from ``rng``; ``progress`` is told the stages.
        """
        ...

    @classmethod
    def paper(cls) -> Self:
        """The parameters that follow the paper to the letter."""
        ...


def require(condition: bool, expected: str, found: object) -> None:
    """Check a method's parameter.

    Raises:
        ParameterError: ``condition`` does not hold.
    """
    if not condition:
        raise ParameterError(expected, found=repr(found), fix="Choose such a value.")


def check_fields(method: Any) -> None:
    """Hold the fields of a method's dataclass to their annotations: a typo must not pass silently.

    Raises:
        ParameterError: A field is not of its type, or not one of its choices.
    """
    hints = get_type_hints(type(method))
    label = getattr(method, "name", type(method).__name__.lower())
    for field in dataclasses.fields(method):
        value, hint = getattr(method, field.name), hints[field.name]
        require(_fits(value, hint), f"{label}.{field.name} as {_describe(hint)}", value)


def _fits(value: object, hint: Any) -> bool:
    """Whether a value is of a type: a plain one, a choice of literals, or a union of these."""
    if get_origin(hint) is Literal:
        return isinstance(value, str) and value in get_args(hint)
    if get_origin(hint) in {Union, types.UnionType}:
        return any(_fits(value, choice) for choice in get_args(hint))
    if isinstance(value, (bool, np.bool_)):
        return hint is bool
    if hint is float:
        return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)
    if hint is int:
        return isinstance(value, (int, np.integer))
    return not isinstance(hint, type) or isinstance(value, hint)


def _describe(hint: Any) -> str:
    """A type in words."""
    if get_origin(hint) in {Literal, Union, types.UnionType}:
        return " or ".join(_describe(choice) for choice in get_args(hint))
    plain = {int: "a whole number", float: "a finite number", bool: "true or false"}
    if isinstance(hint, type):
        return "none" if hint is type(None) else plain.get(hint, hint.__name__)
    return repr(hint)
