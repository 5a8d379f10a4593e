"""The contract of upsampling methods: a frozen dataclass of parameters that can be called.

A method gets the scene, the number of points to make and a random generator, and returns positions
in the world and colours. Methods that start from the originals get them clean, centred and with
their neighbours from ``neighbors.prepare_scene``. Putting originals first, counting and the origin
of points are handled once, around the method.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from typing import Any, Literal, NamedTuple, Protocol, Union, runtime_checkable

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.errors import ParameterError, PointCloudError
from splatseed.progress import Progress
from splatseed.scene import Scene


class NewPoints(NamedTuple):
    """What a method returns; attributes of points are NaN where unknown."""

    xyz: Float32[np.ndarray, "M 3"]  # world
    rgb: UInt8[np.ndarray, "M 3"]
    notes: tuple[str, ...] = ()  # for the user, one sentence each
    normals: Float32[np.ndarray, "M 3"] | None = None  # unit, world axes
    sizes: Float32[np.ndarray, " M"] | None = None  # initial radius of a Gaussian, scene units
    confidence: Float32[np.ndarray, " M"] | None = None  # that a surface is there, 0 to 1
    source: UInt8[np.ndarray, " M"] | None = None  # codes of their methods, never 0; None: its own


Need = Literal["points", "depth", "photographs", "cloud"]


@dataclasses.dataclass(frozen=True)
class Traits:
    """What a method needs from a scene, and whether the photographs determine its number of points.

    If so, the method is called with 0.
    """

    needs: frozenset[Need] = frozenset({"points"})
    chooses_number: bool = False


@runtime_checkable
class Upsampler(Protocol):
    """An upsampling method. Third parties register classes under ``splatseed.methods``.

    Two members are optional. ``traits`` (``Traits``) is for a method that needs more than points,
    or chooses the number of new points itself. ``paper()``, a class method, gives the parameters
    that follow a paper to the letter; without it both profiles are the same.
    """

    def __call__(
        self, scene: Scene, num_new: int, rng: np.random.Generator, progress: Progress
    ) -> NewPoints:
        """Make exactly ``num_new`` finite points for a scene.

        Every random number comes from ``rng``; ``progress`` is told the stages.
        """
        ...


def traits_of(method: Upsampler) -> Traits:
    """The method's traits, or the default ones."""
    traits: Traits = getattr(method, "traits", Traits())
    return traits


def nothing_finite(number: int) -> PointCloudError:
    """The error for a cloud of so many points, none of them both finite and original."""
    return PointCloudError(
        "at least one original point with finite coordinates",
        found=f"{number} points, none of them finite and original",
        fix="Check that the scene holds the point cloud you meant.",
    )


def require(condition: bool, expected: str, found: object) -> None:
    """Refuse a method's parameter (``ParameterError``) unless ``condition`` holds."""
    if not condition:
        raise ParameterError(expected, found=repr(found), fix="Choose such a value.")


def check_fields(method: Any) -> None:
    """Refuse fields of a method's dataclass that are not of their type or choices."""
    hints = typing.get_type_hints(type(method))
    label = getattr(method, "name", type(method).__name__.lower())
    for field in dataclasses.fields(method):
        value, hint = getattr(method, field.name), hints[field.name]
        require(fits(value, hint), f"{label}.{field.name} as {describe_type(hint)}", value)
    held = getattr(method, "test_every", 0)
    require(held == 0 or held >= 2, f"{label}.test_every of 0 or 2 and more", held)


def fits(value: object, hint: Any) -> bool:
    """Whether a value has a type: a plain one, a choice of literals, or a union of these."""
    if typing.get_origin(hint) is Literal:
        return isinstance(value, str) and value in typing.get_args(hint)
    if typing.get_origin(hint) in {Union, types.UnionType}:
        return any(fits(value, choice) for choice in typing.get_args(hint))
    if isinstance(value, (bool, np.bool_)):
        return hint is bool
    if hint is float:
        return isinstance(value, (int, float, np.integer, np.floating)) and math.isfinite(value)
    if hint is int:
        return isinstance(value, (int, np.integer))
    return not isinstance(hint, type) or isinstance(value, hint)


def describe_type(hint: Any) -> str:
    """A type in words."""
    if typing.get_origin(hint) in {Literal, Union, types.UnionType}:
        return " or ".join(describe_type(choice) for choice in typing.get_args(hint))
    plain = {int: "a whole number", float: "a finite number", bool: "true or false",
             str: "text", dict: "a table", type(None): "none"}  # fmt: skip
    if isinstance(hint, type):
        return plain.get(hint, hint.__name__)
    return repr(hint)
