"""The paper's guidelines, each as a comparison that these runs can decide, and its verdict.

A guideline is a *contrast* for each scene, in dB, positive where the guideline is right, from the
gains that ``gained`` has. Its mean over scenes is tested by a t-test, paired as each scene is
compared with itself, adjusted after Holm over all guidelines of a way. *Holds*: significantly
positive; *fails*: significantly negative; else it is not decided here. Where the guideline says
that something is as good, or no better, the contrast may be off by ``MARGIN``. Which scenes are of
which kind was written down before the runs.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import pandas as pd
from benchmarks.paper.gained import Results

from splatseed.bench.plan import DEPTH
from splatseed.bench.statistics import Difference, adjusted, over_scenes
from splatseed.bench.tables import Number, Row, Table

__all__ = ["GUIDELINES", "Guideline", "at_ratio", "verdict_table", "verdicts"]

ORGANIC = ("bonsai", "treehill", "fern", "fox", "stone_horse", "face")
PLANAR = ("dorm", "desk", "room0", "redkitchen")
OUTDOORS = ("treehill", "stone_horse")
INDOORS = ("bonsai", "fern", "fox", "face", "dorm", "desk", "room0", "redkitchen")
SIMPLE, SURFACE = ("linear", "triangle"), ("spline", "mls")
POINTS = (*SIMPLE, *SURFACE, "voronoi")
MARGIN = 0.1
"""Gains that differ by less, in dB, count as equal: about the least that anybody would see."""
Contrast = Callable[[pd.DataFrame], pd.Series]
WORDS = {"better": "holds", "worse": "fails"}


@dataclass(frozen=True)
class Guideline:
    """One of the paper's; ``contrast`` is by scene, NaN or left out where runs are missing."""

    text: str
    compares: str
    contrast: Contrast
    scenes: Sequence[str] = (*ORGANIC, *PLANAR)
    margin: float = 0.0

    def test(self, gains: pd.DataFrame) -> Difference | None:
        """The contrast plus the margin over the scenes that have it; None if there are none."""
        own = gains[gains.index.isin(self.scenes, level="scene")]
        values = self.contrast(own).dropna()
        return over_scenes(values + self.margin) if len(values) else None


def _complete(gains: pd.DataFrame, methods: Sequence[str] = POINTS) -> pd.DataFrame:
    """Where all of some methods were run."""
    return gains[list(methods)].dropna()


def at_ratio(values: pd.Series, ratio: float) -> pd.Series:
    """Values by scene, of those that have one at this ratio."""
    return values[values.index.get_level_values("ratio") == ratio].droplevel("ratio")


def _lead(*methods: str) -> Contrast:
    """By how much some methods lead the others, on average."""
    others = [each for each in POINTS if each not in methods]

    def contrast(gains: pd.DataFrame) -> pd.Series:
        table = _complete(gains)
        lead = table[list(methods)].mean(axis=1) - table[others].mean(axis=1)
        return lead.groupby(level=0).mean()

    return contrast


def _suffice(gains: pd.DataFrame) -> pd.Series:
    """What the simple methods gain at 4x, less what the others gain at 16x."""
    table = _complete(gains)
    others = [each for each in POINTS if each not in SIMPLE]
    simple, rest = table[list(SIMPLE)].mean(axis=1), table[others].mean(axis=1)
    return at_ratio(simple, 4.0) - at_ratio(rest, 16.0)


def _steady(gains: pd.DataFrame) -> pd.Series:
    """By how much depth's lowest gain is above the others' lowest, on average."""
    lowest = _complete(gains, (DEPTH, *POINTS)).groupby(level=0).min()
    return lowest[DEPTH] - lowest[list(POINTS)].mean(axis=1)


def _rise(gains: pd.DataFrame) -> pd.Series:
    """What 32x gains over 16x, on average over the methods."""
    means = _complete(gains).mean(axis=1)
    return at_ratio(means, 32.0) - at_ratio(means, 16.0)


GUIDELINES = (
    Guideline("MLS is most often best", "mls over the other four methods", _lead("mls")),
    Guideline(
        "Surface methods suit detail and organic shapes",
        f"spline and mls over linear, triangle and voronoi, on {', '.join(ORGANIC)}",
        _lead(*SURFACE), ORGANIC,
    ),
    Guideline(
        "Voronoi suits planar scenes",
        f"voronoi over the other four methods, on {', '.join(PLANAR)}",
        _lead("voronoi"), PLANAR,
    ),
    Guideline(
        "Simple methods at low ratios suffice",
        f"linear and triangle at 4x less the other three at 16x, not below -{MARGIN} dB",
        _suffice, margin=MARGIN,
    ),
    Guideline(
        "Depth is most consistent",
        "depth's lowest gain on a scene over the others' lowest",
        _steady,
    ),
    Guideline(
        "Benefits plateau at 16x outdoors",
        f"16x less 32x, not below -{MARGIN} dB, on {', '.join(OUTDOORS)}",
        lambda gains: -_rise(gains), OUTDOORS, MARGIN,
    ),
    Guideline("Benefits rise to 32x indoors", "32x over 16x, indoors", _rise, INDOORS),
)  # fmt: skip


def verdicts(gains: pd.DataFrame) -> tuple[str, ...]:
    """Of each guideline, in its order: the verdict and the numbers behind it."""
    tests = adjusted([each.test(gains) for each in GUIDELINES])
    return tuple(map(_told, GUIDELINES, tests))


def _told(guideline: Guideline, test: Difference | None) -> str:
    if test is None:
        return "not decided here: not run"
    verdict = WORDS.get(test.verdict, "not decided here")
    spread = "" if math.isnan(test.se) else f" ± {test.se:.2f}"
    exact = f"= {test.adjusted:.3f}" if test.adjusted >= 0.001 else "< 0.001"
    p = "" if math.isnan(test.adjusted) else f", p {exact}"
    scenes = f"{test.n} scene{'s' if test.n > 1 else ''}"
    return f"{verdict}: {Number(test.mean - guideline.margin, signed=True)}{spread} dB, {scenes}{p}"


def verdict_table(results: Results) -> Table:
    """A row for each guideline, a column for each way, and how often each method was best."""
    told = {way: verdicts(results.gains(way)) for way in results.ways()}
    rows: list[Row] = [
        (each.text, each.compares, *(told[way][i] for way in told))
        for i, each in enumerate(GUIDELINES)
    ]
    best = [_best(results.gains(way)) for way in told]
    rows.append(("", "scenes on which a method is best, by its mean over ratios", *best))
    header = ("the paper's guideline", "what is compared", *(way.label for way in told))
    note = (
        "Mean over scenes ± standard error; p of the paired t-test over scenes, adjusted after "
        "Holm over the guidelines of a column; it holds or fails at 5%."
    )
    return Table("guidelines", "The paper's guidelines", header, rows, (note,))


def _best(gains: pd.DataFrame) -> str:
    means = _complete(gains).groupby(level=0).mean()
    counts = means.idxmax(axis=1).value_counts() if len(means) else pd.Series(dtype=int)
    return ", ".join(f"{name} {number}" for name, number in counts.items())
