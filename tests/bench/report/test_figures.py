"""Figures are pictures, of what can be told apart, and absent where there is nothing to draw."""

from __future__ import annotations

import dataclasses
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from splatseed.bench.analysis.study import Variant, studies
from splatseed.bench.planning.records import SFM
from splatseed.bench.report.figures import (
    curve_figure,
    ratio_figure,
    scene_figure,
    shown_variants,
    strategy_figure,
)

from ..planted import rows

ORANGE = (0xD5, 0x5E, 0x00)
"""The colour of mls."""


def one(**planted):
    (study,) = studies(rows(**planted))
    return study


def count_of(plot, color):
    """How many pixels of a figure have a colour."""
    pixels = np.asarray(Image.open(BytesIO(plot.png)).convert("RGB")).astype(int)
    return int((np.abs(pixels - np.array(color)).max(axis=2) < 12).sum())


@pytest.mark.parametrize("draw", [
    lambda s: curve_figure(s, "none", "steps"), lambda s: curve_figure(s, "none", "seconds"),
    lambda s: scene_figure(s, "none"), ratio_figure, strategy_figure,
])  # fmt: skip
def test_what_is_there_is_drawn(draw):
    scenes = ("fox",)
    some = {(SFM, 1): 0.0, ("linear", 4): 0.1, ("linear", 8): 0.1}
    more = {**some, ("mls", 8): 0.4}
    plot = draw(one(scenes=scenes, gains=more, strategies=("default", "none")))
    assert count_of(plot, ORANGE) > 20
    less = draw(one(scenes=scenes, gains=some, strategies=("default", "none")))
    assert count_of(less, ORANGE) == 0


def test_there_is_no_figure_of_nothing():
    study = one(gains={(SFM, 1): 0.0, ("mls", 8): 0.1})
    assert scene_figure(one(gains={(SFM, 1): 0.0}), "none") is None
    assert ratio_figure(study) is None
    assert strategy_figure(study) is None
    bare = [dataclasses.replace(r, result=dataclasses.replace(r.result, curve=())) for r in rows()]
    assert curve_figure(studies(bare)[0], "none", "steps") is None


def test_of_many_variants_the_highest_ratios_are_shown():
    methods = ("linear", "mls", "spline")
    many = [Variant(m, p, r) for m in methods for p in ("default", "paper") for r in (4.0, 8.0)]
    assert {each.ratio for each in shown_variants(many)} == {8.0}
    assert len(shown_variants(many)) == 6
    assert shown_variants(many[:8]) == tuple(many[:8])


def test_curves_of_unlike_tests_meet_where_both_were_taken():
    finished = rows(scenes=("fox",), repeats=2)
    shorter = dataclasses.replace(finished[0].result, curve=finished[0].result.curve[::2])
    finished[0] = dataclasses.replace(finished[0], result=shorter)
    assert curve_figure(studies(finished)[0], "none", "steps") is not None
