"""Settings: frozen dataclasses whose fields carry their limits, and the check of all of them.

A field's type is its first limit, ``Literal`` a choice; ``Range`` in ``Annotated`` bounds numbers::

    @dataclass(frozen=True)
    class Fit:
        k: Annotated[int, Range(3, 25)] = 16
        clamp: Annotated[float | None, Range(above=0)] = None
        frame: Literal["local", "world"] = "local"

        def __post_init__(self) -> None:
            check_settings(self, "fit")
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, TypeVar, Union

import numpy as np

from splatseed.errors import ParameterError
from splatseed.text import did_you_mean

Limit = float | str
"""A number, or the name of another field of the same settings."""


@dataclasses.dataclass(frozen=True)
class Range:
    """Limits of a number. None is in every range: the field's type says whether it may be None."""

    minimum: Limit | None = None  # inclusive
    maximum: Limit | None = None  # inclusive
    above: Limit | None = None  # exclusive
    below: Limit | None = None  # exclusive
    also: float | None = None  # one value outside of the limits, such as 0 for "off"

    def contains(self, value: float, settings: Any) -> bool:
        """Whether a value lies in the range, for these settings."""
        low, high, above, below = (
            getattr(settings, limit) if isinstance(limit, str) else limit
            for limit in (self.minimum, self.maximum, self.above, self.below)
        )
        inside = (
            (low is None or value >= low)
            and (high is None or value <= high)
            and (above is None or value > above)
            and (below is None or value < below)
        )
        return inside or (self.also is not None and value == self.also)

    def __str__(self) -> str:
        """As in "from 4 to 25", "above 0 and at most 1", "of at least 2, or 0"."""
        if self.minimum is not None and self.maximum is not None:
            limits = f"from {_shown(self.minimum)} to {_shown(self.maximum)}"
        else:
            named = (("of at least", self.minimum), ("above", self.above),
                     ("at most", self.maximum), ("below", self.below))  # fmt: skip
            limits = " and ".join(f"{how} {_shown(x)}" for how, x in named if x is not None)
        return limits if self.also is None else f"{limits}, or {self.also:g}"


def check_settings(settings: Any, group: str = "") -> None:
    """Check all fields of a dataclass against their types and ranges.

    Args:
        settings: An instance of the dataclass.
        group: Put before a field's name in the message, with a dot, as on the command line.

    Raises:
        ParameterError: A value has another type, is no choice of its ``Literal`` or out of range.
    """
    kind: Any = type(settings)  # a class is hashable, which its type does not say
    for name, (hint, limits) in _limits_of(kind).items():
        value = getattr(settings, name)
        label = f"{group}.{name}" if group else f"`{name}`"
        _require(fits(value, hint), f"{label} as {describe_type(hint)}", value)
        if limits is not None and value is not None:
            _require(limits.contains(value, settings), f"{label} {limits}", value)


Settings = TypeVar("Settings")


def change_settings(settings: Settings, name: str, values: Mapping[str, Any]) -> Settings:
    """Return a copy of a dataclass of settings with some of its fields replaced.

    Anything else, such as a function, has no fields.

    Raises:
        ParameterError: There is no such field; the message calls fields "parameters of ``name``".
    """
    fields = dataclasses.fields(settings) if dataclasses.is_dataclass(settings) else ()
    known = [field.name for field in fields]
    for given in values:
        if given not in known:
            raise ParameterError(
                f"a parameter of {name} ({', '.join(known) or 'it has none'})",
                found=repr(given),
                fix=did_you_mean(given, known).strip() or "Choose one of these.",
            )
    changed: Settings = dataclasses.replace(settings, **values) if known else settings  # type: ignore[type-var]
    return changed


def _require(condition: bool, expected: str, found: object) -> None:
    """Raise a ``ParameterError`` unless ``condition`` holds."""
    if not condition:
        raise ParameterError(expected, found=repr(found), fix="Choose such a value.")


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
    """A type for a message, as in "a whole number or none"."""
    if typing.get_origin(hint) in {Literal, Union, types.UnionType}:
        return " or ".join(describe_type(choice) for choice in typing.get_args(hint))
    plain = {int: "a whole number", float: "a finite number", bool: "true or false",
             str: "text", dict: "a table", type(None): "none"}  # fmt: skip
    if isinstance(hint, type):
        return plain.get(hint, hint.__name__)
    return repr(hint)


@cache
def _limits_of(kind: Any) -> dict[str, tuple[Any, Range | None]]:
    """Type and range of each field of a dataclass, in the order in which they are checked."""
    plain, annotated = typing.get_type_hints(kind), typing.get_type_hints(kind, include_extras=True)
    limits = {
        field.name: (
            plain[field.name],
            next((m for m in typing.get_args(annotated[field.name]) if isinstance(m, Range)), None),
        )
        for field in dataclasses.fields(kind)
    }
    # Limits by other fields come last: a message should name the field that is wrong by itself.
    return dict(sorted(limits.items(), key=lambda item: _depends(item[1][1])))


def _depends(limits: Range | None) -> bool:
    """Whether a limit is another field."""
    return limits is not None and any(isinstance(x, str) for x in dataclasses.astuple(limits))


def _shown(limit: Limit) -> str:
    return limit if isinstance(limit, str) else f"{limit:,}"
