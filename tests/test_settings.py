"""Settings are checked against the types and ranges of their fields."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import pytest

from splatseed.errors import ParameterError
from splatseed.settings import Range, check_settings


@dataclass(frozen=True)
class Fit:
    k: Annotated[int, Range(3, 25)] = 16
    color_k: Annotated[int, Range(1, "k")] = 5
    clamp: Annotated[float | None, Range(0)] = 0.25
    share: Annotated[float, Range(above=0, maximum=1)] = 0.5
    tolerance: Annotated[float, Range(above=0, below=1)] = 0.5
    test_every: Annotated[int, Range(2, also=0)] = 0
    frame: Literal["local", "world"] = "local"
    keep: bool = True
    name: str = ""

    def __post_init__(self):
        check_settings(self, "fit")


RIGHT = {
    "k": (3, 25, np.int64(9)),
    "color_k": (1, 16),
    "clamp": (None, 0, 2.5, np.float32(1)),
    "share": (1e-9, 1),
    "tolerance": (0.999,),
    "test_every": (0, 2, 8),
    "frame": ("world",),
    "keep": (False, np.bool_(True)),
}
WRONG = {
    "k": (2, 26, 9.0, "9", True, None),
    "color_k": (0, 17),
    "clamp": (-1e-9, np.inf, np.nan, "none"),
    "share": (0, 1.001),
    "tolerance": (0, 1),
    "test_every": (1, -1),
    "frame": ("locl", 1),
    "keep": (1,),
    "name": (1,),
}


@pytest.mark.parametrize("name", RIGHT)
def test_values_in_range_are_taken(name):
    for value in RIGHT[name]:
        assert getattr(replace(Fit(color_k=1), **{name: value}), name) is value


@pytest.mark.parametrize("name", WRONG)
def test_other_values_are_named(name):
    for value in WRONG[name]:
        with pytest.raises(ParameterError, match=rf"^expected fit\.{name} ") as caught:
            replace(Fit(color_k=1), **{name: value})
        assert caught.value.found == repr(value)


def test_a_limit_may_be_another_field():
    with pytest.raises(ParameterError, match=r"fit\.color_k from 1 to k; found 5"):
        Fit(k=4)


def test_without_a_group_the_argument_is_named():
    @dataclass(frozen=True)
    class Plain:
        steps: Annotated[int, Range(1)] = 1

    settings = Plain(0)
    with pytest.raises(ParameterError, match="`steps` of at least 1; found 0"):
        check_settings(settings)


@pytest.mark.parametrize(
    ("limits", "text"),
    [
        (Range(4, 25), "from 4 to 25"),
        (Range(1000), "of at least 1,000"),
        (Range(above=0, maximum=1), "above 0 and at most 1"),
        (Range(above=0, below=1), "above 0 and below 1"),
        (Range(2, also=0), "of at least 2, or 0"),
    ],
)
def test_ranges_are_described(limits, text):
    assert str(limits) == text
