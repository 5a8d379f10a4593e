"""The paper's tables 1 and 2 beside ours: PSNR and gain of every scene and variant.

Notation: marks are as in ``MARKS``. Promise: our numbers carry their standard error over repeats;
the paper's have a row of their own if the scene's name is one of its scenes; nothing is marked as
best that could be noise.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from splatseed.bench.analysis.gains import Gains, MeanGains, clear_best, gains, mean_gains
from splatseed.bench.analysis.paper import (
    DATASETS,
    PAPER_STEPS,
    PaperDataset,
    dataset_of,
    paper_dataset,
)
from splatseed.bench.analysis.statistics import Difference
from splatseed.bench.analysis.study import BASELINE, Cell as Runs, Study, Variant
from splatseed.bench.analysis.tables import Cell, Table, number, words
from splatseed.train.settings import StrategyName

NOISE, CLEAR, ONE_RUN = "~", "†", "(1 run)"

MARKS = (
    "PSNR in dB, mean ± standard error over repeats. Bold: the best of its row, where its gain "
    "over sfm is significant (paired by scene and repeat, Holm-corrected over all gains on scenes "
    "in this strategy, 5%), or sfm where all are significantly worse; † where it is also better "
    "than the second best. ~: within noise of sfm. (1 run): a single repeat, which has no "
    "standard error of its own."
)
PAPER_NOTE = (
    "Rows '(paper)' are the numbers printed there: 30,000 steps, a quarter (outdoors) or half "
    "(indoors) of the size of Mip-NeRF360's photographs."
)
GAIN_NOTE = (
    "dB ± standard error. On a scene and on these scenes, the noise is that of training again; on "
    "scenes like these, it is the spread of gains from scene to scene, repeats averaged first. "
    "Means are over the scenes that a column has. ~: within noise (Holm-corrected over all cells "
    "of scenes, and over each row of means). (1 run): a single pair, of whose noise nothing is "
    "known."
)
MEAN_NOTE = (
    "dB over sfm. All variants together: what a variant picked blindly gives. Best single "
    "variant: a little flattering, as it is chosen by its own scores. Best of each scene: chosen "
    "on the very test views that it is scored on, so that noise counts as gain; not a gain that "
    "anybody can have. Variants that some scene lacks are left out."
)
TABLE_NAMES = {"mipnerf360": "table1", "replica": "table2", "": "table_scenes"}


def psnr_tables(study: Study, strategy: StrategyName) -> tuple[Table, ...]:
    """PSNR by scene and variant: a table for each dataset of the paper, and one for other scenes.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    gained = gains(study, strategy)
    groups: dict[str, list[str]] = {}
    for scene in study.scenes_of(strategy):
        dataset = dataset_of(scene)
        groups.setdefault("" if dataset is None else dataset.key, []).append(scene)
    return tuple(
        _psnr_table(study, gained, key, groups[key]) for key in (*DATASETS, "") if key in groups
    )


def _psnr_table(study: Study, gained: Gains, key: str, scenes: Sequence[str]) -> Table:
    variants = study.variants_of(gained.strategy)
    rows: list[tuple[Cell, ...]] = []
    for scene in scenes:
        rows.append(_our_row(study, gained, scene, variants))
        dataset = dataset_of(scene)
        if dataset is not None:
            rows.append(_paper_row(dataset, scene, variants))
    known = paper_dataset(key).title if key else "other scenes"
    return Table(
        f"{TABLE_NAMES[key]}_{gained.strategy}",
        f"PSNR, {known}, strategy {gained.strategy}",
        ("scene", BASELINE.label, *(each.label for each in variants)),
        tuple(rows),
        (MARKS, f"Ours: {study.description}.", *_paper_notes(study, key)),
    )


def _paper_notes(study: Study, key: str) -> tuple[str, ...]:
    if not key:
        return ()
    steps = study.settings["max_steps"]
    short = (
        "" if steps == PAPER_STEPS else f" Ours are of {steps:,} steps: compare gains, not levels."
    )
    return (PAPER_NOTE + short,)


def _our_row(
    study: Study, gained: Gains, scene: str, variants: Sequence[Variant]
) -> tuple[Cell, ...]:
    best = gained.best(scene)
    clear = clear_best(study, gained.strategy, scene)

    def cell(variant: Variant) -> Cell:
        gain = gained.on_scene.get((scene, variant))
        verdict = "unknown" if gain is None else gain.verdict
        bold = variant == best and verdict == "better"
        mark = NOISE if verdict == "within noise" else CLEAR if bold and clear else ""
        return _runs_cell(study.cell(gained.strategy, scene, variant), mark=mark, bold=bold)

    known = [gained.on_scene[scene, v].verdict for v in variants if (scene, v) in gained.on_scene]
    as_it_is = bool(known) and set(known) == {"worse"}
    base = _runs_cell(study.cell(gained.strategy, scene, BASELINE), bold=as_it_is)
    return (words(scene), base, *map(cell, variants))


def _runs_cell(runs: Runs, *, mark: str = "", bold: bool = False) -> Cell:
    """Mean and standard error of a cell's PSNR over its repeats."""
    values = np.array([result.psnr for result in runs.values()])
    if not len(values):
        return Cell()
    if len(values) == 1:
        return Cell(float(values[0]), math.nan, text=ONE_RUN, mark=mark, bold=bold)
    se = float(values.std(ddof=1)) / math.sqrt(len(values))
    return Cell(float(values.mean()), se, mark=mark, bold=bold)


def _paper_row(dataset: PaperDataset, scene: str, variants: Sequence[Variant]) -> tuple[Cell, ...]:
    scores = dataset.psnr[scene]
    arms = (BASELINE, *variants)
    printed = (scores.get((arm.method, arm.ratio)) for arm in arms)
    return _soft((words(f"{scene} (paper)"), *(number(value) for value in printed)))


def _soft(row: Iterable[Cell]) -> tuple[Cell, ...]:
    return tuple(replace(cell, soft=True) for cell in row)


def gain_cell(gain: Difference | None) -> Cell:
    """A gain with its standard error, and whether it is within noise."""
    if gain is None:
        return Cell()
    mark = NOISE if gain.verdict == "within noise" else ""
    text = ONE_RUN if math.isnan(gain.se) and gain.n == 1 else ""
    return Cell(gain.mean, gain.se, 3, signed=True, mark=mark, text=text)


def gain_table(study: Study, strategy: StrategyName) -> Table:
    """What each variant gains: on each scene, on these, on scenes like these, and in the paper.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    gained = gains(study, strategy)

    def row(name: str, gain: Callable[[Variant], Cell]) -> tuple[Cell, ...]:
        return (words(name), *(gain(each) for each in gained.variants))

    rows = [
        row(scene, lambda v, scene=scene: gain_cell(gained.on_scene.get((scene, v))))  # type: ignore[misc]  # mypy cannot infer a lambda's default
        for scene in gained.scenes
    ]
    rows.append(row("mean, these scenes", lambda v: gain_cell(gained.on_these[v])))
    if len(gained.scenes) > 1:
        rows.append(row("mean, scenes like these", lambda v: gain_cell(gained.on_like[v])))
    rows += [_soft(row(name, cells)) for name, cells in _paper_gains(gained)]
    return Table(
        f"gains_{strategy}",
        f"Gain over sfm in PSNR, strategy {strategy}",
        ("scene", *(each.label for each in gained.variants)),
        tuple(rows),
        (GAIN_NOTE, f"{study.description}."),
    )


def _paper_gains(gained: Gains) -> list[tuple[str, Callable[[Variant], Cell]]]:
    """The paper's mean gains over the scenes that ours are of, for each dataset."""
    rows: list[tuple[str, Callable[[Variant], Cell]]] = []
    for key in DATASETS:
        dataset = paper_dataset(key)
        scenes = [scene for scene in gained.scenes if scene in dataset.psnr]
        if not scenes:
            continue

        def cell(v: Variant, dataset: PaperDataset = dataset, scenes: list[str] = scenes) -> Cell:
            return number(_paper_mean(dataset, scenes, v), 3, signed=True)

        if any(cell(variant).value is not None for variant in gained.variants):
            name = f"paper, {len(scenes)} of {len(dataset.psnr)} {dataset.title} scenes"
            rows.append((name, cell))
    return rows


def _paper_mean(dataset: PaperDataset, scenes: Sequence[str], variant: Variant) -> float | None:
    known = [dataset.gain(scene, (variant.method, variant.ratio)) for scene in scenes]
    told = [each for each in known if each is not None]
    return sum(told) / len(told) if told else None


def mean_gain_table(study: Study) -> Table:
    """The three kinds of mean gain, ours by strategy and the paper's.

    Args:
        study: The study.
    """
    rows = []
    for strategy in study.strategies:
        ours = mean_gains(gains(study, strategy).means())
        if ours is not None:
            rows.append(_mean_row(f"ours, {strategy}", ours))
    for key in DATASETS:
        theirs = mean_gains(_paper_means(paper_dataset(key)))
        if theirs is not None:
            rows.append(_soft(_mean_row(f"paper, {DATASETS[key]}", theirs)))
    return Table(
        "mean_gains",
        "Three mean gains that are easily mistaken for one another",
        ("", "all variants together", "best single variant", "which", "best of each scene (unfair)",
         "scenes", "variants"),
        tuple(rows),
        (MEAN_NOTE,),
    )  # fmt: skip


def _paper_means(dataset: PaperDataset) -> dict[str, dict[Variant, float]]:
    return {
        scene: {
            Variant(method, ratio=ratio): psnr - entries["sfm", 1.0]
            for (method, ratio), psnr in entries.items()
            if method != BASELINE.method
        }
        for scene, entries in dataset.psnr.items()
    }


def _mean_row(name: str, means: MeanGains) -> tuple[Cell, ...]:
    kinds = (means.over_all, means.over_best, means.per_scene)
    first, second, third = (number(value, 3, signed=True) for value in kinds)
    sizes = (number(float(each), 0) for each in (means.num_scenes, means.num_variants))
    return (words(name), first, second, words(means.best), third, *sizes)
