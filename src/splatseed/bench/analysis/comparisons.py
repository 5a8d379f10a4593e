"""Gain against ratio, gain against strategy, and gain at equal numbers of Gaussians.

Notation: gains are those of ``splatseed.bench.analysis.gains``: mean over scenes, for these scenes
alone. Promise: counts are equal if the runs' final numbers of Gaussians differ by at most 1% in
every pair; this is checked, not assumed from the strategy.
"""

from __future__ import annotations

from dataclasses import replace
from statistics import fmean

from splatseed.bench.analysis.gains import Gains, gains
from splatseed.bench.analysis.psnr_tables import gain_cell
from splatseed.bench.analysis.study import Study, Variant, budget_words
from splatseed.bench.analysis.tables import Cell, Table, number, words

EQUAL = 0.01
"""By how much equal numbers of Gaussians may differ."""


def ratio_table(study: Study) -> Table:
    """Mean gain by method and strategy, one column per ratio.

    Args:
        study: The study.
    """
    ratios = sorted({variant.ratio for variant in study.variants})
    rows = []
    for strategy in study.strategies:
        gained = gains(study, strategy)
        by_method: dict[str, dict[float, Variant]] = {}
        for variant in gained.variants:
            by_method.setdefault(replace(variant, ratio=0.0).label, {})[variant.ratio] = variant
        for method, at in by_method.items():
            cells = [gain_cell(gained.on_these[at[r]]) if r in at else Cell() for r in ratios]
            rows.append((words(strategy), words(method), *cells))
    return Table(
        "gain_by_ratio",
        "Gain over sfm in PSNR by ratio, mean over these scenes",
        ("strategy", "method", *(f"{ratio:g}x" if ratio else "no ratio" for ratio in ratios)),
        tuple(rows),
        (NOTE, f"{study.description}."),
    )


NOTE = (
    "dB ± the standard error of training these scenes again. ~: within noise (Holm-corrected over "
    "the variants of a strategy). Means are over the scenes that a variant has."
)


def strategy_table(study: Study) -> Table:
    """Mean gain by variant, one column per strategy, with the baseline's own PSNR below.

    Args:
        study: The study.
    """
    by_strategy: dict[str, Gains] = {
        strategy: gains(study, strategy) for strategy in study.strategies
    }
    rows = [
        (
            words(variant.label),
            *(gain_cell(each.on_these.get(variant)) for each in by_strategy.values()),
        )
        for variant in study.variants
    ]
    return Table(
        "gain_by_strategy",
        "Gain over sfm in PSNR by strategy, mean over these scenes",
        ("method", *by_strategy),
        tuple(rows),
        (
            NOTE
            + " Strategy none adds no Gaussians, so that it shows what seeds alone are worth, but "
            "also gives upsampled runs more Gaussians than sfm.",
            f"{study.description}.",
        ),
    )


def equal_count_table(study: Study) -> Table:
    """Gains of the variants whose runs end with as many Gaussians as the baseline's.

    Args:
        study: The study.
    """
    rows = []
    for strategy in study.strategies:
        gained = gains(study, strategy)
        for variant in gained.variants:
            counts = [
                (base.num_gaussians, own.num_gaussians)
                for scene in gained.scenes
                for base, own in study.pairs(strategy, scene, variant)
            ]
            if all(abs(own - base) <= EQUAL * base for base, own in counts):
                rows.append(
                    (
                        words(strategy),
                        words(variant.label),
                        number(fmean(own for _, own in counts), 0),
                        gain_cell(gained.on_these[variant]),
                        gain_cell(gained.on_like[variant]),
                    )
                )
    return Table(
        "equal_count",
        "Gain over sfm in PSNR at an equal number of Gaussians",
        ("strategy", "method", "Gaussians", "gain, these scenes", "gain, scenes like these"),
        tuple(rows),
        (_equal_note(study, bool(rows)), f"{study.description}."),
    )


def _equal_note(study: Study, any_rows: bool) -> str:
    rule = (
        "Listed are the variants of which every run ends within 1% of the number of Gaussians of "
        "the sfm run that it is paired with. That happens where a cap binds both: under --budgets, "
        "with strategy mcmc, or where --cap-max thins out the seeds of strategy none. ~: within "
        "noise."
    )
    if any_rows:
        return rule
    cap, budget = study.settings["cap_max"], study.settings["budget"]
    capped = f"a cap of {cap:,}" if cap else budget_words(str(budget)) if budget else "no cap"
    return (
        f"None qualifies (strategies {', '.join(study.strategies)}, {capped}): gains may come from "
        f"the mere number of Gaussians. {rule}"
    )
