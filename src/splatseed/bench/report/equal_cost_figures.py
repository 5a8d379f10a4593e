"""Figures of arms at equal seconds, and of what each arm gains at an equal number of Gaussians.

Notation: a colour is a method, a line's dashes a strategy; the baseline is thick and black.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.bench.analysis.arms.compared import Arm, Compared, baseline_of, compared_arms
from splatseed.bench.analysis.study import Cell as Runs, Study
from splatseed.bench.report.drawing import (
    MANY,
    Plot,
    legend_of,
    method_color,
    new_figure,
    panels,
    png,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

DASHES: Mapping[str, str] = {"default": "-", "mcmc": "--", "grow": "-.", "none": ":"}
MARKS: Mapping[str, str] = {"default": "o", "mcmc": "s", "grow": "^", "none": "D"}
POINTS = 60
LATE = 0.25
"""Curves are shown from this share of the baseline's seconds on."""


def seconds_figure(study: Study) -> Plot | None:
    """Test PSNR over seconds of seeding and training, a panel per scene; None without curves.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    scenes = [s for s in study.scenes if base and _curve(_runs(study, base, s))]
    if base is None or len(compared) < 2 or not scenes:
        return None
    arms = _shown(compared, base)
    figure, axes = panels(len(scenes))
    for scene, each in zip(scenes, axes, strict=True):
        _draw_scene(each, study, scene, arms, base)
    legend_of(figure, [(arm.label, _line(arm, base)) for arm in arms])
    left = len(compared) - len(arms)
    more = f" Of {len(compared)} arms, those with the highest mean gain." if left else ""
    return Plot(
        "psnr_seconds_arms",
        "Test PSNR (dB) over wall seconds, those of making the seeds included; mean over "
        f"repeats. The thick line is {base.label}.{more}",
        png(figure),
    )


def _shown(compared: Sequence[Compared], base: Arm) -> list[Arm]:
    """The baseline, and the arms with the highest gain."""
    best = [each.arm for each in compared if each.arm != base]
    return [base, *best[: MANY - 1]]


def _draw_scene(axes: Axes, study: Study, scene: str, arms: Sequence[Arm], base: Arm) -> None:
    low, high, end = math.inf, -math.inf, 0.0
    for arm in arms:
        curve = _curve(_runs(study, arm, scene))
        if curve is None:
            continue
        x, y = curve
        axes.plot(x, y, **_line(arm, base), zorder=3 if arm == base else 2)
        if arm == base:
            end = float(x[-1])
        late = y[x >= LATE * (end or x[-1])]
        if len(late):
            low, high = min(low, float(late.min())), max(high, float(late.max()))
    axes.axvline(end, color="#bbbbbb", linewidth=0.8)
    if low < high:
        axes.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
    axes.set_title(scene.replace("$", r"\$"))
    axes.set_xlabel("seconds, seeding included")
    axes.set_ylabel("PSNR, dB")
    axes.grid(visible=True, alpha=0.25)


def _runs(study: Study, arm: Arm, scene: str) -> Runs:
    return study.cell(arm.strategy, scene, arm.variant)


def _curve(runs: Runs) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean seconds [K] and PSNR [K] over repeats, at the tests that all took; then the end."""
    curves = [{p.step: p for p in run.curve if math.isfinite(p.psnr)} for run in runs.values()]
    steps = sorted(set.intersection(*map(set, curves))) if curves else []
    if not steps:
        return None
    extra = fmean(run.upsample_seconds for run in runs.values())
    x = [extra + fmean(curve[step].seconds for curve in curves) for step in steps]
    y = [fmean(curve[step].psnr for curve in curves) for step in steps]
    return np.array(x), np.array(y)


def _line(arm: Arm, base: Arm) -> dict[str, Any]:
    plain_name = arm.strategy.removesuffix("-3dgs")
    return {
        "color": method_color(arm.variant.method),
        "linestyle": (0, (1, 3)) if plain_name != arm.strategy else DASHES.get(plain_name, "-"),
        "linewidth": 2.4 if arm == base else 1.3,
    }


def arm_figure(study: Study) -> Plot | None:
    """Each arm's mean gain over the baseline with its 95% interval; None where there is one arm.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    others = [each for each in compared if each.arm != base]
    if base is None or not others:
        return None
    figure = new_figure(7.2, 1.2 + 0.24 * len(others))
    axes = figure.subplots()
    for row, each in enumerate(others):
        low, high = each.gain.interval()
        error = None if math.isnan(low) else [[each.gain.mean - low], [high - each.gain.mean]]
        color = method_color(each.arm.variant.method)
        mark = MARKS.get(each.arm.strategy, "P")
        axes.errorbar(each.gain.mean, row, xerr=error, color=color, marker=mark, linestyle="none")
    axes.axvline(0.0, color="#222222", linewidth=1)
    names = [each.arm.label.replace("$", r"\$") for each in others]
    axes.set_yticks(range(len(others)), names)
    axes.set_ylim(len(others) - 0.5, -0.5)
    axes.set_xlabel(f"gain over {base.label}, dB")
    axes.grid(visible=True, axis="x", alpha=0.25)
    alone = all(len(each.scenes) == 1 for each in others)
    of = "repeats and 95% interval for this scene trained again" if alone else (
        "scenes and 95% interval for scenes like these"
    )  # fmt: skip
    return Plot(
        "gain_arms",
        f"Gain over {base.label} of every arm: mean over {of} (of each comparison alone, not "
        "adjusted for their number).",
        png(figure),
    )
