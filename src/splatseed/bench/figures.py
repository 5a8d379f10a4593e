"""Figures: PSNR over steps and seconds, gains by scene, gains of all arms.

Colours are methods, marker shapes are ratios; dashed lines and hollow markers are the profile
"paper"; the baseline is thick and black. Equal data give equal bytes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from splatseed.bench.comparisons import ArmKey, baseline_of, compared_arms, gains
from splatseed.bench.plan import SFM, Arm
from splatseed.bench.statistics import Difference
from splatseed.bench.study import Study
from splatseed.training.settings import StrategyName

_BLACK = "#222222"
_COLORS = {
    SFM: _BLACK, "linear": "#0072B2", "triangle": "#56B4E9", "spline": "#E69F00",
    "mls": "#D55E00", "voronoi": "#009E73", "depth": "#CC79A7", "random": "#999999",
    "cover": "#B8860B", "stereo": "#1B7837", "auto": "#7B4FA3",
}  # fmt: skip
"""Colours that the colour-blind can tell apart (Okabe and Ito)."""
_MARKERS = {2.0: "v", 4.0: "s", 8.0: "o", 16.0: "^", 32.0: "D"}  # others: a cross
_DASHES = {"default": "-", "mcmc": "--", "grow": "-.", "none": ":"}
_AS_3DGS = (0, (1, 3))
_HIGHEST = " Of each method, the highest ratio."
_INTERVAL = (
    "95% interval, adjusted for the number of comparisons as the tables are: it excludes 0 exactly "
    "if the gain is beyond noise. Without an interval there are too few repeats or scenes to tell"
)
_MAX_CURVES = 8  # in one panel
_LATE = 0.2  # the y axis fits the part of the curves after this share of the run

Style = Mapping[str, Any]


class Plot(NamedTuple):
    """A figure: file name without suffix, caption, and PNG."""

    name: str
    caption: str
    png: bytes


def shown_seeds(study: Study, seeds: Sequence[str]) -> tuple[str, ...]:
    """All variants, or if there are too many, the highest ratio of each method and profile."""
    if len(seeds) <= _MAX_CURVES:
        return tuple(seeds)
    return tuple({study.family(label): label for label in seeds}.values())


def _new_figure(width: float, height: float, count: int = 1) -> tuple[Figure, list[Axes]]:
    """Make a figure of ``count`` panels, up to two per row; the size of a panel is in inches."""
    columns = min(count, 2)  # three would be illegible on a phone
    rows = -(-count // columns)
    size = max(width * columns, 5.0), height * rows + 0.4
    figure = Figure(figsize=size, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[count:]:
        axes.remove()
    return figure, list(panels[:count])


def _plot(name: str, caption: str, figure: Figure, named: Mapping[str, Style]) -> Plot:
    """Encode a figure as PNG, with a legend above its panels."""
    if named:
        handles = [Line2D([], [], label=name, **style) for name, style in named.items()]
        longest = 0.5 + 0.08 * max(map(len, named))  # inches
        columns = min(max(int(figure.get_figwidth() / longest), 1), len(handles))
        figure.legend(handles=handles, loc="outside upper left", ncols=columns,
                      fontsize="small", frameon=False)  # fmt: skip
    out = BytesIO()
    # Without the version of the library, so that the same data give the same bytes.
    figure.savefig(out, dpi=120, format="png", metadata={"Software": None})
    return Plot(name, caption, out.getvalue())


def _style(study: Study, label: str, *, line: bool = True, mark: bool = True) -> dict[str, Any]:
    arm = study.variants.get(label, Arm(SFM, "default", 1.0, "default"))
    color, paper = _COLORS.get(arm.method, "#8C564B"), arm.profile == "paper"
    style = {"color": color, "linestyle": ("--" if paper else "-") if line else "none"}
    if not mark or (line and label == SFM):
        return style
    shape, hollow = _MARKERS.get(arm.ratio, "P"), "white" if paper else color
    return {**style, "marker": shape, "markersize": 5.0, "markerfacecolor": hollow}


def curve_figure(study: Study, strategy: StrategyName) -> Plot | None:
    """Test PSNR of a strategy over steps, a panel per scene; None where there are no curves."""
    seeds = study.seeded_under(strategy)
    shown = (SFM, *shown_seeds(study, seeds))
    arms = {label: (ArmKey(strategy, label), _style(study, label)) for label in shown}
    caption = (
        f"Test PSNR (dB) over steps, strategy {strategy}: mean over repeats, and a band from the "
        f"lowest to the highest.{_HIGHEST * (len(shown) <= len(seeds))}"
    )
    return _draw_curves(study, arms, f"psnr_steps_{strategy}", caption, by="steps")


def seconds_figure(study: Study) -> Plot | None:
    """Test PSNR of all arms over seconds of seeding and training; None without curves."""
    base, compared = baseline_of(study), compared_arms(study)
    if base is None or len(compared) < 2:
        return None
    shown = [base, *(each.arm for each in compared if each.arm != base)][:_MAX_CURVES]
    arms = {}
    for arm in shown:
        dashes = _DASHES.get(arm.strategy, _AS_3DGS if arm.strategy.endswith("-3dgs") else "-")
        style = {**_style(study, arm.seeds, mark=False), "linestyle": dashes}
        arms[arm.label] = arm, style
    more = f" Of {len(compared)} arms, those with the highest mean gain."
    caption = (
        "Test PSNR (dB) over wall seconds, those of making the seeds included; mean over repeats, "
        f"and a band from the lowest to the highest. The thick line is {base.label}."
        f"{more * (len(compared) > len(shown))}"
    )
    return _draw_curves(study, arms, "psnr_seconds_arms", caption, by="seconds")


def _draw_curves(
    study: Study, arms: Mapping[str, tuple[ArmKey, Style]], file: str, caption: str, *, by: str
) -> Plot | None:
    """A panel per scene with curves of PSNR by name; the first arm is the baseline."""
    drawn = {}
    for scene in study.scenes:
        curves = {name: _curve(study, scene, arm, by) for name, (arm, _) in arms.items()}
        if known := {name: curve for name, curve in curves.items() if curve is not None}:
            drawn[scene] = known
    if not drawn:
        return None
    figure, panels = _new_figure(3.6, 2.9, len(drawn))
    styles = {name: style for name, (_, style) in arms.items()}
    baseline = next(iter(arms))
    for (scene, each), axes in zip(drawn.items(), panels, strict=True):
        end = each.get(baseline, next(iter(each.values())))[0][-1]
        late = []
        for name, (x, psnr) in each.items():
            first = name == baseline
            axes.plot(x, psnr.mean(axis=0), **styles[name], linewidth=2.2 if first else 1.3,
                      markevery=max(len(x) // 5, 1), zorder=3 if first else 2)  # fmt: skip
            if len(psnr) > 1:
                low, high = psnr.min(axis=0), psnr.max(axis=0)
                axes.fill_between(x, low, high, color=styles[name]["color"], alpha=0.15)
            late.append(psnr[:, x >= min(_LATE * end, x[-1])].ravel())
        values = np.concatenate(late)
        margin = 0.05 * np.ptp(values) + 0.01
        axes.set_ylim(values.min() - margin, values.max() + margin)
        axes.set_title(scene, parse_math=False)
        axes.set_xlabel(by if by == "steps" else "seconds, seeding included")
        axes.set_ylabel("PSNR, dB")
        axes.grid(visible=True, alpha=0.25)
    return _plot(file, caption, figure, styles)


def _curve(study: Study, scene: str, arm: ArmKey, by: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Mean abscissa [K] and PSNR [R, K] over the tests that all repeats took."""
    runs = list(study.results(arm.strategy, scene, arm.seeds).values())
    curves = [{p.step: p for p in run.curve if math.isfinite(p.psnr)} for run in runs]
    steps = sorted(set.intersection(*map(set, curves))) if curves else []
    if not steps:
        return None
    psnr = np.array([[curve[step].psnr for step in steps] for curve in curves])
    seconds = [[run.upsample_seconds + curve[step].seconds for step in steps]
               for run, curve in zip(runs, curves, strict=True)]  # fmt: skip
    return (np.mean(seconds, axis=0) if by == "seconds" else np.array(steps, float)), psnr


def scene_figure(study: Study, strategy: StrategyName) -> Plot | None:
    """The gain on each scene with its interval; None where nothing can be compared."""
    gained = gains(study, strategy)
    if not gained.on_scene:
        return None
    seeds = shown_seeds(study, gained.seeds)
    styles = {label: _style(study, label, line=False) for label in seeds}
    names = [*gained.scenes, "mean, these scenes"]
    figure, (axes,) = _new_figure(7.2, 0.7 + 0.15 * len(names) * (len(seeds) + 1.5))
    for row, name in enumerate(names):
        for i, label in enumerate(seeds):
            known = gained.on_scene.get((name, label))
            gain = known if name in gained.scenes else gained.on_these[label]
            if gain is not None:  # close enough to leave a gap to the next scene's
                place = row + 0.8 * ((i + 0.5) / len(seeds) - 0.5)
                axes.errorbar(gain.mean, place, xerr=_interval(gain), **styles[label])
    axes.axhline(len(gained.scenes) - 0.5, color="#bbbbbb", linewidth=0.8)
    _finish_rows(axes, names, SFM)
    some = _HIGHEST * (len(seeds) < len(gained.seeds))
    caption = (
        f"Gain over sfm on each scene, strategy {strategy}: mean over repeats and {_INTERVAL}."
        f"{some}"
    )
    return _plot(f"gain_by_scene_{strategy}", caption, figure, styles)


def _interval(gain: Difference) -> list[list[float]] | None:
    low, high = gain.interval()
    return None if math.isnan(low) else [[gain.mean - low], [high - gain.mean]]


def _finish_rows(axes: Axes, names: Sequence[str], base: str) -> None:
    axes.axvline(0.0, color=_BLACK, linewidth=1)
    axes.set_yticks(range(len(names)), names, parse_math=False)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_xlabel(f"gain over {base}, dB")
    axes.grid(visible=True, axis="x", alpha=0.25)


def arm_figure(study: Study) -> Plot | None:
    """Each arm's mean gain over the baseline with its interval; None where there is one arm."""
    base, compared = baseline_of(study), compared_arms(study)
    others = [each for each in compared if each.arm != base]
    if base is None or not others:
        return None
    figure, (axes,) = _new_figure(7.2, 0.8 + 0.24 * len(others))
    for row, each in enumerate(others):
        style = _style(study, each.arm.seeds, line=False, mark=False)
        axes.errorbar(each.gain.mean, row, xerr=_interval(each.gain), marker="o", **style)
    _finish_rows(axes, [each.arm.label for each in others], base.label)
    alone = all(len(each.scenes) == 1 for each in others)
    of = "repeats, for this scene trained again" if alone else "scenes, for scenes like these"
    caption = f"Gain over {base.label} of every arm: mean over {of}, and {_INTERVAL}."
    return _plot("gain_arms", caption, figure, {})
