"""Quality and cost of every variant on average; and the paper's table 3 beside ours.

Promise: means are over runs within a scene first, then over the scenes that the variant and the
baseline both have, so that a method is not charged for scenes that another skipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from statistics import fmean
from typing import NamedTuple

from splatseed.bench.analysis.paper import DATASETS, PaperDataset, paper_dataset
from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.bench.analysis.tables import Cell, Table, number, words
from splatseed.bench.planning.records import RunResult
from splatseed.train.settings import StrategyName

QUALITY_NOTE = (
    "Means over the scenes that a method and sfm both have: compare methods of equally many "
    "scenes. Co-visible PSNR is over the pixels that at least two training views see. PSNR and "
    "SSIM are better when higher, LPIPS when lower. The tables of gains say what "
    "is noise."
)

Measure = Callable[[RunResult], float]


class _Column(NamedTuple):
    name: str
    measure: Measure
    digits: int


COLUMNS = (
    _Column("seeds", lambda r: r.num_seeds, 0),
    _Column("upsampling, s", lambda r: r.upsample_seconds, 2),
    _Column("training, s", lambda r: r.train_seconds, 1),
    _Column("peak memory, MB", lambda r: _bytes(r.peak_bytes), 0),
    _Column("peak GPU memory, MB", lambda r: _bytes(r.peak_gpu_bytes), 0),
    _Column("Gaussians", lambda r: r.num_gaussians, 0),
    _Column("model, MB", lambda r: r.model_bytes / 1e6, 1),
    _Column("render a view, ms", lambda r: 1e3 * r.scores.render_seconds, 1),
)
"""MB are 1,000,000 bytes."""

QUALITY = (
    _Column("PSNR, dB", lambda r: r.psnr, 2),
    _Column("co-visible PSNR, dB", lambda r: _known_or_nan(r.scores.covisible_psnr), 2),
    _Column("SSIM", lambda r: r.ssim, 4),
    _Column("LPIPS", lambda r: _known_or_nan(r.lpips), 4),
)


def _bytes(count: int | None) -> float:
    return math.nan if count is None else count / 1e6


def _known_or_nan(score: float | None) -> float:
    return math.nan if score is None else score


def mean_of(
    study: Study, strategy: StrategyName, variant: Variant, measure: Measure
) -> float | None:
    """A measure's mean over runs within a scene, then over scenes that the baseline has as well.

    Args:
        study: The study.
        strategy: The strategy.
        variant: The variant; the baseline itself is taken on all its scenes.
        measure: The value to take from a result; NaN if unknown.

    Returns:
        None if nothing is known.
    """
    means = []
    for scene in study.scenes_of(strategy):
        runs = study.cell(strategy, scene, variant)
        if runs and study.cell(strategy, scene, BASELINE):
            means.append(fmean(measure(result) for result in runs.values()))
    known = [each for each in means if not math.isnan(each)]
    return fmean(known) if known else None


def quality_table(study: Study, strategy: StrategyName) -> Table:
    """PSNR, co-visible PSNR, SSIM and, if measured, LPIPS by variant.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    arms = (BASELINE, *study.variants_of(strategy))
    shown = _known(study, strategy, arms, QUALITY)
    rows = [
        (
            words(arm.label),
            *(_cost(study, strategy, arm, column) for column in shown),
            number(float(_num_scenes(study, strategy, arm)), 0),
        )
        for arm in arms
    ]
    return Table(
        f"quality_{strategy}",
        f"Mean scores, strategy {strategy}",
        ("method", *(column.name for column in shown), "scenes"),
        tuple(rows),
        (QUALITY_NOTE, f"{study.description}."),
    )


def _known(
    study: Study, strategy: StrategyName, arms: Iterable[Variant], columns: Iterable[_Column]
) -> list[_Column]:
    """The columns that any arm has a value in."""
    return [
        column
        for column in columns
        if any(mean_of(study, strategy, arm, column.measure) is not None for arm in arms)
    ]


def _num_scenes(study: Study, strategy: StrategyName, arm: Variant) -> int:
    scenes = study.scenes_of(strategy)
    return sum(
        bool(study.cell(strategy, s, arm) and study.cell(strategy, s, BASELINE)) for s in scenes
    )


def cost_table(study: Study, strategy: StrategyName) -> Table:
    """Time, memory and size by variant.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    datasets = [paper_dataset(key) for key in DATASETS]
    datasets = [each for each in datasets if set(study.scenes_of(strategy)) & set(each.psnr)]
    arms = (BASELINE, *study.variants_of(strategy))
    shown = _known(study, strategy, arms, COLUMNS)
    rows = [
        (
            words(arm.label),
            *(_cost(study, strategy, arm, column) for column in shown),
            *_paper_costs(datasets, arm),
        )
        for arm in arms
    ]
    header = ["method", *(column.name for column in shown)]
    for each in datasets:
        header += [f"paper, training, s ({each.title})", f"paper, model, MB ({each.title})"]
    return Table(
        f"table3_{strategy}",
        f"Time, memory and size, strategy {strategy}",
        tuple(header),
        tuple(rows),
        _notes(study, strategy),
    )


def _cost(study: Study, strategy: StrategyName, arm: Variant, column: _Column) -> Cell:
    return number(mean_of(study, strategy, arm, column.measure), column.digits)


def _paper_costs(datasets: Iterable[PaperDataset], arm: Variant) -> list[Cell]:
    cells = []
    for dataset in datasets:
        cost = dataset.costs.get((arm.method, arm.ratio))
        cells.append(number(None if cost is None else cost.train_seconds, 0))
        cells.append(number(None if cost is None else cost.model_megabytes, 0))
    return cells


def _notes(study: Study, strategy: StrategyName) -> tuple[str, ...]:
    scenes = study.scenes_of(strategy)
    devices = {
        result.device
        for (used, _, _), cell in study.cells.items()
        if used == strategy
        for result in cell.values()
    }
    ours = (
        f"Means over {len(scenes)} scenes ({', '.join(scenes)}). MB are of a million bytes. Times "
        "are wall clock as measured, so that runs side by side on one machine slow each other; "
        f"upsampling is not part of training. Device: {', '.join(sorted(devices))}."
    )
    theirs = "The paper's are means over all scenes of its dataset, on its own machine."
    return ours, f"{study.description}. {theirs}"
