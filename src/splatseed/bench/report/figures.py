"""Figures: PSNR over steps and seconds, and gains by scene, ratio and strategy.

Notation: a colour is a method and a mark's shape a ratio, in all figures the same; a dashed line or
a hollow mark is the profile "paper". Promise: bars and bands say in the title what they are;
nothing is drawn for a single run but the run itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.bench.analysis.gains import Gains, gains
from splatseed.bench.analysis.statistics import Difference
from splatseed.bench.analysis.study import BASELINE, Cell, Study, Variant
from splatseed.bench.planning.records import RunResult
from splatseed.bench.report.drawing import (
    COLORS,
    MANY,
    Plot,
    legend_of,
    method_color,
    new_figure,
    panels,
    png,
)
from splatseed.scores import CurvePoint
from splatseed.train.settings import StrategyName

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = {2.0: "v", 4.0: "s", 8.0: "o", 16.0: "^", 32.0: "D"}
"""Marks by ratio; other ratios have a cross."""
LATE = 0.15
"""Curves are shown from this fraction of the steps on: before it, all rise equally steeply."""


def shown_variants(variants: Sequence[Variant]) -> tuple[Variant, ...]:
    """All variants, or if they are too many the highest ratio of each method and profile.

    Args:
        variants: In order.
    """
    if len(variants) <= MANY:
        return tuple(variants)
    last = {(each.method, each.profile, each.parameters): each for each in variants}
    return tuple(last.values())


def curve_figure(study: Study, strategy: StrategyName, by: str) -> Plot | None:
    """Test PSNR over steps or over seconds, a panel per scene; None where there are no curves.

    Args:
        study: The study.
        strategy: One of its strategies.
        by: "steps" or "seconds".
    """
    variants = study.variants_of(strategy)
    arms = (BASELINE, *shown_variants(variants))
    scenes = [
        scene
        for scene in study.scenes_of(strategy)
        if any(_curve(study.cell(strategy, scene, arm), by) for arm in arms)
    ]
    if not scenes:
        return None
    figure, parts = panels(len(scenes))
    for scene, axes in zip(scenes, parts, strict=True):
        _draw_curves(axes, study, strategy, scene, arms, by)
        axes.set_title(scene.replace("$", r"\$"))
        axes.set_xlabel(by if by == "steps" else "seconds, upsampling included")
        axes.set_ylabel("PSNR, dB")
    legend_of(figure, [(each.label, _marked(each)) for each in arms])
    return Plot(
        f"psnr_{by}_{strategy}",
        f"Test PSNR (dB) over {by}, strategy {strategy}: mean over repeats, and a band from the "
        f"lowest to the highest.{_left_out(arms[1:], variants)}",
        png(figure),
    )


def _draw_curves(
    axes: Axes,
    study: Study,
    strategy: StrategyName,
    scene: str,
    arms: Iterable[Variant],
    by: str,
) -> None:
    low, high = math.inf, -math.inf
    for arm in arms:
        curve = _curve(study.cell(strategy, scene, arm), by)
        if curve is None:
            continue
        x, psnr = curve
        mean = psnr.mean(axis=0)
        width = 2.2 if arm == BASELINE else 1.3
        every = max(len(mean) // 5, 1)
        marked = ((len(mean) - 1) % every, every)  # the last point is one of them
        zorder = 3 if arm == BASELINE else 2
        axes.plot(x, mean, **_marked(arm), markevery=marked, linewidth=width, zorder=zorder)
        if len(psnr) > 1:
            axes.fill_between(x, psnr.min(axis=0), psnr.max(axis=0), color=_color(arm), alpha=0.15)
        late = min(math.ceil(LATE * len(mean)), len(mean) - 1)
        low, high = min(low, psnr[:, late:].min()), max(high, psnr.max())
    axes.set_ylim(low - 0.03 * (high - low) - 0.01, high + 0.05 * (high - low) + 0.01)
    axes.grid(visible=True, alpha=0.25)


def _curve(cell: Cell, by: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean abscissa [K] and PSNR [R, K] over the tests that all repeats took."""
    curves = [_finite(result) for result in cell.values()]
    if not curves or not all(curves):
        return None
    steps = set.intersection(*({point.step for point in curve} for curve in curves))
    if not steps:
        return None
    kept = [[point for point in curve if point.step in steps] for curve in curves]
    extra = np.array([[result.upsample_seconds] for result in cell.values()])
    seconds = np.array([[point.seconds for point in curve] for curve in kept]) + extra
    x = seconds.mean(axis=0) if by == "seconds" else np.array(sorted(steps), float)
    return x, np.array([[point.psnr for point in curve] for curve in kept])


def _finite(result: RunResult) -> list[CurvePoint]:
    return [point for point in result.curve if math.isfinite(point.psnr)]


def scene_figure(study: Study, strategy: StrategyName) -> Plot | None:
    """The gain on each scene with its 95% interval; None where nothing can be compared.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    gained = gains(study, strategy)
    if not gained.on_scene:
        return None
    variants = shown_variants(gained.variants)
    names = [*gained.scenes, "mean, these scenes"]
    figure = new_figure(7.2, 1.1 + 0.15 * len(names) * (len(variants) + 1.5))
    axes = figure.subplots()
    for row, name in enumerate(names):
        for variant, place in zip(variants, _places(row, len(variants)), strict=True):
            gain = _gain_of(gained, name, variant)
            if gain is not None:
                _dot(axes, gain, place, variant, across=True)
    axes.axvline(0.0, color=COLORS["sfm"], linewidth=1)
    axes.axhline(len(gained.scenes) - 0.5, color="#bbbbbb", linewidth=0.8)
    labels = [name.replace("$", r"\$") for name in names]
    axes.set_yticks(range(len(names)), labels)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel("gain over sfm, dB")
    axes.grid(visible=True, axis="x", alpha=0.25)
    legend_of(figure, [(each.label, _mark_only(each)) for each in variants])
    return Plot(
        f"gain_by_scene_{strategy}",
        f"Gain over sfm on each scene, strategy {strategy}: mean over repeats and 95% interval (of "
        "each comparison alone, not adjusted for their "
        f"number).{_left_out(variants, gained.variants)}",
        png(figure),
    )


def _places(center: float, count: int) -> list[float]:
    """``count`` positions about a centre, close enough to leave a gap to the next centre's."""
    return [center + 0.8 * ((i + 0.5) / count - 0.5) for i in range(count)]


def _left_out(shown: Sequence[Variant], variants: Sequence[Variant]) -> str:
    return "" if len(shown) == len(variants) else " Of each method, the highest ratio."


def _gain_of(gained: Gains, name: str, variant: Variant) -> Difference | None:
    if name in gained.scenes:
        return gained.on_scene.get((name, variant))
    return gained.on_these[variant]


def _dot(
    axes: Axes, gain: Difference, place: float, variant: Variant, *, across: bool = False
) -> None:
    """A gain and its interval at a place along the other axis."""
    low, high = gain.interval()
    error = None if math.isnan(low) else [[gain.mean - low], [high - gain.mean]]
    x, y = (gain.mean, place) if across else (place, gain.mean)
    bars: dict[str, Any] = {"xerr" if across else "yerr": error}
    axes.errorbar(x, y, linestyle="none", elinewidth=1.3, **_mark(variant), **bars)


def ratio_figure(study: Study) -> Plot | None:
    """Mean gain over the ratio, one panel per strategy; None if there is only one ratio.

    Args:
        study: The study.
    """
    with_ratio = [variant for variant in study.variants if variant.ratio]
    if len({variant.ratio for variant in with_ratio}) < 2:
        return None
    figure, parts = panels(len(study.strategies))
    for strategy, axes in zip(study.strategies, parts, strict=True):
        gained = gains(study, strategy)
        for line in _lines(variant for variant in gained.variants if variant.ratio):
            means = [gained.on_these[variant].mean for variant in line]
            axes.plot([variant.ratio for variant in line], means, **_line(line[0]), linewidth=1.3)
            for variant in line:
                _dot(axes, gained.on_these[variant], variant.ratio, variant)
        ratios = sorted({variant.ratio for variant in gained.variants} - {0.0})
        axes.set_xscale("log", base=2)
        axes.set_xticks(ratios, [f"{ratio:g}x" for ratio in ratios])
        axes.set_xticks([], minor=True)
        axes.axhline(0.0, color=COLORS["sfm"], linewidth=1)
        axes.set_title(f"strategy {strategy}")
        axes.set_xlabel("points, per original")
        axes.set_ylabel("gain over sfm, dB")
        axes.grid(visible=True, alpha=0.25)
    lines = [replace(line[0], ratio=0.0) for line in _lines(with_ratio)]
    legend_of(figure, [(each.label, _line(each)) for each in lines])
    return Plot(
        "gain_by_ratio",
        "Mean gain over sfm (dB) on these scenes by ratio, with 95% interval of training again.",
        png(figure),
    )


def _lines(variants: Iterable[Variant]) -> list[list[Variant]]:
    """Variants that differ in their ratio alone, together."""
    lines: dict[tuple[object, ...], list[Variant]] = {}
    for variant in variants:
        lines.setdefault((variant.method, variant.profile, variant.parameters), []).append(variant)
    return list(lines.values())


def strategy_figure(study: Study) -> Plot | None:
    """Mean gain by strategy; None where there is but one.

    Args:
        study: The study.
    """
    if len(study.strategies) < 2:
        return None
    figure = new_figure(7.2, 3.6)
    axes = figure.subplots()
    variants = shown_variants(study.variants)
    for column, strategy in enumerate(study.strategies):
        gained = gains(study, strategy)
        for variant, place in zip(variants, _places(column, len(variants)), strict=True):
            if variant in gained.on_these:
                _dot(axes, gained.on_these[variant], place, variant)
    axes.axhline(0.0, color=COLORS["sfm"], linewidth=1)
    axes.set_xticks(range(len(study.strategies)), study.strategies)
    axes.set_ylabel("gain over sfm, dB")
    axes.grid(visible=True, axis="y", alpha=0.25)
    legend_of(figure, [(each.label, _mark_only(each)) for each in variants])
    return Plot(
        "gain_by_strategy",
        "Mean gain over sfm on these scenes by strategy, with 95% interval of training again."
        f"{_left_out(variants, study.variants)}",
        png(figure),
    )


def _color(variant: Variant) -> str:
    return method_color(variant.method)


def _mark(variant: Variant) -> dict[str, Any]:
    hollow = "white" if variant.profile == "paper" else _color(variant)
    shape = MARKERS.get(variant.ratio, "P")
    return {"color": _color(variant), "marker": shape, "markersize": 5.0, "markerfacecolor": hollow}


def _line(variant: Variant) -> dict[str, Any]:
    return {"color": _color(variant), "linestyle": "--" if variant.profile == "paper" else "-"}


def _marked(variant: Variant) -> dict[str, Any]:
    """A line with the ratio's mark on it; the baseline has none."""
    return {**_mark(variant), **_line(variant), "markersize": 0.0 if variant == BASELINE else 4.5}


def _mark_only(variant: Variant) -> dict[str, Any]:
    return {"linestyle": "none", **_mark(variant)}
