"""The tables of a study: scores, gains, costs, convergence, arms at equal cost; and of comparisons.

Promise: means are over runs within a scene first, then over scenes; our numbers carry their
standard error, the paper's have rows or columns of their own where a scene's name is one of its
scenes; nothing is marked as best that could be noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import fmean

import pandas as pd

from splatseed.bench.comparisons import (
    DATASETS,
    PAPER_STEPS,
    Arm,
    Comparison,
    Gains,
    MeanGains,
    Place,
    baseline_of,
    clear_best,
    compared_arms,
    dataset_of,
    gains,
    mean_gains,
    paper_dataset,
    score_advice,
    speeds,
)
from splatseed.bench.plan import SFM
from splatseed.bench.statistics import Difference
from splatseed.bench.study import Study, budget_words
from splatseed.bench.tables import Cell, Number, Table
from splatseed.train.settings import StrategyName

NOISE, CLEAR, ONE_RUN = "~", "†", "(1 run)"
EQUAL = 0.01
"""Numbers of Gaussians that differ by no more than this share count as equal."""
FEWEST = 3
"""Scenes from which on advice is scored."""


def gain_cell(gain: Difference | None, digits: int = 3) -> Cell:
    """A gain with its standard error, and whether it is within noise."""
    if gain is None:
        return ""
    mark = NOISE if gain.verdict == "within noise" else ""
    text = ONE_RUN if math.isnan(gain.se) and gain.n == 1 and digits == 3 else ""
    return Number(gain.mean, digits, gain.se, signed=True, mark=mark, text=text)


def _ratio_cell(log: Difference | None, *, alone: str = "") -> Cell:
    if log is None:
        return ""
    mark = NOISE if log.verdict == "within noise" else ""
    return Number(math.exp(log.mean), mark=mark, text=alone if math.isnan(log.se) else "")


def psnr_tables(study: Study, strategy: StrategyName) -> list[Table]:
    """PSNR by scene and variant: a table per dataset of the paper, and one for other scenes."""
    gained = gains(study, strategy)
    by_dataset: dict[str, list[str]] = {key: [] for key in (*DATASETS, "")}
    for scene in study.scenes_under(strategy):
        dataset = dataset_of(scene)
        by_dataset["" if dataset is None else dataset.key].append(scene)
    return [_psnr_table(study, gained, key, s) for key, s in by_dataset.items() if s]


def _psnr_table(study: Study, gained: Gains, key: str, scenes: Sequence[str]) -> Table:
    seeds = study.seeded_under(gained.strategy)
    marks = (
        "PSNR in dB, mean ± standard error over repeats. Bold: the best of its row, where its gain "
        "over sfm is significant (paired by scene and repeat, Holm-corrected over all gains on "
        "scenes in this strategy, 5%), or sfm where all are significantly worse; † where it is "
        "also better than the second best. ~: within noise of sfm. (1 run): a single repeat, which "
        "has no standard error of its own."
    )
    notes = [marks, f"Ours: {study.description}."]
    rows = []
    for scene in scenes:
        rows.append(_psnr_row(study, gained, scene, seeds))
        if key:
            printed = paper_dataset(key).psnr[scene]
            variants = [study.variants.get(each) for each in (SFM, *seeds)]
            known = [(SFM, 1.0) if v is None else (v.method, v.ratio) for v in variants]
            rows.append((f"{scene} (paper)",
                         *(Number(printed.get(each, math.nan)) for each in known)))  # fmt: skip
    if key:
        steps = study.settings["max_steps"]
        fewer = f" Ours are of {steps:,} steps: compare gains, not levels."
        notes.append(
            "Rows '(paper)' are the numbers printed there: 30,000 steps, a quarter (outdoors) or "
            "half (indoors) of the size of Mip-NeRF360's photographs."
            + (fewer if steps != PAPER_STEPS else "")
        )
    name = {"mipnerf360": "table1", "replica": "table2", "": "table_scenes"}[key]
    return Table(
        f"{name}_{gained.strategy}",
        f"PSNR, {DATASETS.get(key, 'other scenes')}, strategy {gained.strategy}",
        ("scene", SFM, *seeds),
        rows,
        tuple(notes),
    )


def _psnr_row(study: Study, gained: Gains, scene: str, seeds: Sequence[str]) -> tuple[Cell, ...]:
    verdicts = {v: each.verdict for v in seeds if (each := gained.on_scene.get((scene, v)))}
    best, clear = gained.best(scene), clear_best(study, gained.strategy, scene)

    def cell(label: str) -> Cell:
        values = [run.psnr for run in study.results(gained.strategy, scene, label).values()]
        if not values:
            return ""
        verdict = verdicts.get(label)
        bold = label == best and verdict == "better"
        if label == SFM:
            bold = bool(verdicts) and set(verdicts.values()) == {"worse"}
        mark = (
            NOISE if verdict == "within noise" else CLEAR if bold and clear and label != SFM else ""
        )
        mean = fmean(values)
        if len(values) == 1:
            return Number(mean, se=math.nan, text=ONE_RUN, mark=mark, bold=bold)
        variance = sum((value - mean) ** 2 for value in values) / (len(values) - 1)
        return Number(mean, se=math.sqrt(variance / len(values)), mark=mark, bold=bold)

    return scene, *(cell(label) for label in (SFM, *seeds))


_QUALITY = {
    "psnr": ("PSNR, dB", 2), "covisible": ("co-visible PSNR, dB", 2), "ssim": ("SSIM", 4),
    "lpips": ("LPIPS", 4),
}  # fmt: skip
_COSTS = {
    "num_seeds": ("seeds", 0), "seeding": ("upsampling, s", 2), "training": ("training, s", 1),
    "memory": ("peak memory, MB", 0), "gpu_memory": ("peak GPU memory, MB", 0),
    "gaussians": ("Gaussians", 0), "model": ("model, MB", 1), "render": ("render a view, ms", 1),
}  # fmt: skip


def quality_table(study: Study, strategy: StrategyName) -> Table:
    """PSNR, co-visible PSNR, SSIM and, if measured, LPIPS by variant."""
    header, rows = _mean_rows(study, strategy, _QUALITY)
    scenes = _with_baseline(study, strategy).groupby("seeds")["scene"].nunique()
    counted = [(*row, Number(scenes.get(row[0], 0), 0)) for row in rows]
    note = (
        "Means over the scenes that a method and sfm both have: compare methods of equally many "
        "scenes. Co-visible PSNR is over the pixels that at least two training views see. PSNR and "
        "SSIM are better when higher, LPIPS when lower. The tables of gains say what is noise."
    )
    return Table(
        f"quality_{strategy}",
        f"Mean scores, strategy {strategy}",
        (*header, "scenes"),
        counted,
        (note, f"{study.description}."),
    )


def cost_table(study: Study, strategy: StrategyName) -> Table:
    """Time, memory and size by variant, the paper's table 3 beside."""
    header, rows = _mean_rows(study, strategy, _COSTS)
    scenes = study.scenes_under(strategy)
    for key in DATASETS:
        dataset = paper_dataset(key)
        if set(scenes) & set(dataset.psnr):
            header += [f"paper, {what} ({dataset.title})" for what in ("training, s", "model, MB")]
            for i, row in enumerate(rows):
                variant = study.variants.get(str(row[0]))
                entry = (variant.method, variant.ratio) if variant else (SFM, 1.0)
                printed = dataset.costs.get(entry, (math.nan, math.nan))
                rows[i] = (*row, *(Number(each, 0) for each in printed))
    devices = sorted({result.device for result in study.under(strategy)["result"]})
    ours = (
        f"Means over {len(scenes)} scenes ({', '.join(scenes)}). MB are of a million bytes. Times "
        "are wall clock as measured, so that runs side by side on one machine slow each other; "
        f"upsampling is not part of training. Device: {', '.join(devices)}."
    )
    theirs = "The paper's are means over all scenes of its dataset, on its own machine."
    return Table(
        f"table3_{strategy}",
        f"Time, memory and size, strategy {strategy}",
        tuple(header),
        rows,
        (ours, f"{study.description}. {theirs}"),
    )


def _with_baseline(study: Study, strategy: StrategyName) -> pd.DataFrame:
    """The runs under a strategy on scenes that have sfm too."""
    part = study.under(strategy)
    return part[part["scene"].isin(part.loc[part["seeds"] == SFM, "scene"])]


def _mean_rows(
    study: Study, strategy: StrategyName, columns: dict[str, tuple[str, int]]
) -> tuple[list[str], list[tuple[Cell, ...]]]:
    """Means over runs within a scene, then over scenes that sfm has too; of what is known."""
    part = _with_baseline(study, strategy)
    means = part.groupby(["seeds", "scene"])[list(columns)].mean().groupby("seeds").mean()
    means = means.reindex([SFM, *study.seeded_under(strategy)]).dropna(axis=1, how="all")
    rows: list[tuple[Cell, ...]] = [
        (str(label), *(Number(row[name], columns[name][1]) for name in means.columns))
        for label, row in means.iterrows()
    ]
    return ["method", *(columns[name][0] for name in means.columns)], rows


def gain_table(study: Study, strategy: StrategyName) -> Table:
    """What each variant gains: on each scene, on these, on scenes like these, and in the paper."""
    gained = gains(study, strategy)

    rows = [
        (scene, *(gain_cell(gained.on_scene.get((scene, label))) for label in gained.seeds))
        for scene in gained.scenes
    ]
    rows.append(("mean, these scenes", *map(gain_cell, gained.on_these.values())))
    if len(gained.scenes) > 1:
        rows.append(("mean, scenes like these", *map(gain_cell, gained.on_like.values())))
    for key in DATASETS:
        dataset = paper_dataset(key)
        scenes = [scene for scene in gained.scenes if scene in dataset.psnr]
        told = [[dataset.gain(scene, study.variants[label]) for scene in scenes]
                for label in gained.seeds]  # fmt: skip
        means = [fmean(known) if (known := [x for x in each if not math.isnan(x)]) else math.nan
                 for each in told]  # fmt: skip
        if not all(map(math.isnan, means)):
            name = f"paper, {len(scenes)} of {len(dataset.psnr)} {dataset.title} scenes"
            rows.append((name, *(Number(mean, 3, signed=True) for mean in means)))
    note = (
        "dB ± standard error. On a scene and on these scenes, the noise is that of training again; "
        "on scenes like these, it is the spread of gains from scene to scene, repeats averaged "
        "first. Means are over the scenes that a column has. ~: within noise (Holm-corrected over "
        "all cells of scenes, and over each row of means). (1 run): a single pair, of whose noise "
        "nothing is known."
    )
    return Table(
        f"gains_{strategy}",
        f"Gain over sfm in PSNR, strategy {strategy}",
        ("scene", *gained.seeds),
        rows,
        (note, f"{study.description}."),
    )


def mean_gain_table(study: Study) -> Table:
    """The three kinds of mean gain, ours by strategy and the paper's."""
    means: dict[str, MeanGains | None] = {
        f"ours, {each}": mean_gains(gains(study, each).means()) for each in study.strategies
    }
    means |= {f"paper, {DATASETS[key]}": mean_gains(paper_dataset(key).gains()) for key in DATASETS}
    rows = [
        (
            name,
            Number(each.over_all, 3, signed=True),
            Number(each.over_best, 3, signed=True),
            each.best,
            Number(each.per_scene, 3, signed=True),
            Number(each.num_scenes, 0),
            Number(each.num_variants, 0),
        )
        for name, each in means.items()
        if each is not None
    ]
    note = (
        "dB over sfm. All variants together: what a variant picked blindly gives. Best single "
        "variant: a little flattering, as it is chosen by its own scores. Best of each scene: "
        "chosen on the very test views that it is scored on, so that noise counts as gain; not a "
        "gain that anybody can have. Variants that some scene lacks are left out."
    )
    return Table(
        "mean_gains",
        "Three mean gains that are easily mistaken for one another",
        ("", "all variants together", "best single variant", "which", "best of each scene (unfair)",
         "scenes", "variants"),
        rows,
        (note,),
    )  # fmt: skip


_THESE = (
    "dB ± the standard error of training these scenes again. ~: within noise (Holm-corrected over "
    "the variants of a strategy). Means are over the scenes that a variant has."
)


def strategy_table(study: Study) -> Table:
    """Mean gain by variant, one column per strategy."""
    gained = [gains(study, strategy).on_these for strategy in study.strategies]
    note = (
        f"{_THESE} Strategy none adds no Gaussians, so that it shows what seeds alone are worth, "
        "but also gives upsampled runs more Gaussians than sfm."
    )
    return Table(
        "gain_by_strategy",
        "Gain over sfm in PSNR by strategy, mean over these scenes",
        ("method", *study.strategies),
        [(label, *(gain_cell(each.get(label)) for each in gained)) for label in study.seeded],
        (note, f"{study.description}."),
    )


def equal_count_table(study: Study) -> Table:
    """Gains of the variants whose runs end with as many Gaussians as the baseline's.

    Counts are equal if they differ by at most 1% in every pair; this is checked, not assumed.
    """
    rows: list[tuple[Cell, ...]] = []
    for strategy in study.strategies:
        gained = gains(study, strategy)
        wide = study.under(strategy).pivot_table(
            index=["scene", "repeat"], columns="seeds", values="gaussians"
        )
        for label in gained.seeds:
            both = wide[[SFM, label]].dropna()
            if ((both[label] - both[SFM]).abs() <= EQUAL * both[SFM]).all():
                means = gain_cell(gained.on_these[label]), gain_cell(gained.on_like[label])
                rows.append((strategy, label, Number(float(both[label].mean()), 0), *means))
    note = (
        "Listed are the variants of which every run ends within 1% of the number of Gaussians of "
        "the sfm run that it is paired with. That happens where a cap binds both: under --budgets, "
        "or where a cap thins out the seeds of strategy none. ~: within noise."
    )
    if not rows:
        cap, budget = study.settings["cap_max"], study.settings["budget"]
        capped = f"a cap of {cap:,}" if cap else budget_words(str(budget)) if budget else "no cap"
        note = (
            f"None qualifies (strategies {', '.join(study.strategies)}, {capped}): gains may come "
            f"from the mere number of Gaussians. {note}"
        )
    return Table(
        "equal_count",
        "Gain over sfm in PSNR at an equal number of Gaussians",
        ("strategy", "method", "Gaussians", "gain, these scenes", "gain, scenes like these"),
        rows,
        (note, f"{study.description}."),
    )


def convergence_table(study: Study, strategy: StrategyName) -> Table:
    """Steps and seconds to the baseline's last PSNR, by variant."""
    rows = [
        (
            label,
            f"{each.reached} of {each.pairs}",
            Number(each.means["steps"], 0),
            Number(each.means["base_steps"], 0),
            _ratio_cell(each.log_steps, alone="(no spread)"),
            Number(each.means["seconds"], 1),
            Number(each.means["base_seconds"], 1),
            _ratio_cell(each.log_seconds, alone="(no spread)"),
        )
        for label, each in speeds(study, strategy).items()
    ]
    note = (
        "Where a run's test PSNR first is at least the last one of the sfm run of the same scene "
        "and repeat; seconds with upsampling. 'sfm' reaches its own last PSNR earlier where its "
        "curve is not rising at the end. Means are over the runs that reach it, within scenes "
        "first; ratios are geometric means, below 1 is sooner, given only where all runs reach it. "
        "~: a ratio within noise (t-test over scenes, or over repeats where there is one scene; "
        "Holm-corrected over the column)."
    )
    return Table(
        f"convergence_{strategy}",
        f"Steps and seconds to sfm's last PSNR, strategy {strategy}",
        ("method", "reached", "steps", "sfm's steps", "steps ratio", "seconds", "sfm's seconds",
         "seconds ratio"),
        rows,
        (note, f"{study.description}."),
    )  # fmt: skip


def _base_label(study: Study) -> str:
    base = baseline_of(study)
    return base.label if base else "the baseline"


def _over_base(study: Study) -> str:
    return (
        f"Gains are over {_base_label(study)}, paired by scene and repeat: mean ± standard error "
        "over scenes (over repeats where there is one scene). ~: within noise (t-test, "
        "Holm-corrected over the column)."
    )


def arm_table(study: Study) -> Table:
    """Every arm's scores, cost and gain over the baseline, the highest gain first."""
    base, compared = baseline_of(study), compared_arms(study)
    columns = {
        "psnr": ("PSNR, dB", "gain, dB", 2, 3),
        "covisible": ("co-visible, dB", "its gain, dB", 2, 3),
        "ssim": ("SSIM", "its gain", 4, 4),
        "lpips": ("LPIPS", "its gain", 4, 4),
    }
    shown = [name for name in columns if any(not math.isnan(each.means[name]) for each in compared)]
    rows = []
    for each in compared:
        cells: list[Cell] = []
        for name in shown:
            _, _, digits, gain_digits = columns[name]
            gain = gain_cell(each.gains[name], gain_digits) if each.arm != base else "baseline"
            cells += [Number(each.means[name], digits), gain]
        costs = (("gaussians", 0), ("seeding", 1), ("training", 1))
        cells += [Number(each.means[name], digits) for name, digits in costs]
        rows.append((each.arm.seeds, each.arm.strategy, *cells, f"{len(each.scenes)}"))
    share = study.runs.dropna(subset="share").drop_duplicates("scene")["share"].mean()
    scores_note = (
        "Co-visible PSNR counts the pixels that at least two training views see "
        f"({share:.0%} of them here). PSNR and SSIM are better when higher, LPIPS when lower. "
        "Seconds are wall time, of making the seeds and of training."
    )
    notes = [_over_base(study), *([] if math.isnan(share) else [scores_note])]
    header = [word for name in shown for word in columns[name][:2]]
    return Table(
        "arms",
        "All arms, under one budget of Gaussians" if study.settings["budget"] else "All arms",
        ("seeds", "strategy", *header, "Gaussians", "seeding, s", "training, s", "scenes"),
        rows,
        (*notes, f"{study.description}."),
    )


def scene_arm_table(study: Study) -> Table:
    """Each arm's gain on each scene, mean over repeats, and on the baseline's row its PSNR."""
    base, rows = baseline_of(study), []

    def cell(arm: Arm, scene: str) -> Cell:
        assert base is not None  # noqa: S101  (else there are no arms)
        first = study.results(base.strategy, scene, base.seeds)
        own = study.results(arm.strategy, scene, arm.seeds)
        gained = [own[repeat].psnr - first[repeat].psnr for repeat in first.keys() & own.keys()]
        if not gained:
            return ""
        if arm == base:
            return Number(fmean(run.psnr for run in own.values()))
        span = f"({min(gained):+.2f} to {max(gained):+.2f})" if len(gained) > 1 else ""
        return Number(fmean(gained), signed=True, text=span)

    for each in compared_arms(study):
        cells = [cell(each.arm, scene) for scene in study.scenes]
        rows.append((each.arm.seeds, each.arm.strategy, *cells))
    note = (
        f"PSNR in dB of {_base_label(study)}; of the others what they gain over it, mean over "
        "repeats (with the lowest and the highest, where there are several)."
    )
    header = ("seeds", "strategy", *study.scenes)
    return Table("arms_by_scene", "All arms by scene", header, rows, (note,))


def seconds_table(study: Study) -> Table:
    """Quality at the baseline's seconds, and seconds to the baseline's quality."""
    base, name = baseline_of(study), _base_label(study)
    rows = [
        (
            each.arm.seeds,
            each.arm.strategy,
            Number(each.means["seeding"] + each.means["training"], 1),
            gain_cell(each.gains["in_time"]) if each.arm != base else "baseline",
            f"{each.reached} of {each.runs}",
            _ratio_cell(each.gains["sooner"]),
        )
        for each in compared_arms(study)
    ]
    note = (
        f"Seconds count making the seeds and training. The gain at {name}'s seconds is an arm's "
        f"PSNR when {name} ends, less {name}'s final PSNR; an arm that ended sooner counts with "
        f"its own final PSNR. The time to {name}'s PSNR is when an arm first reaches {name}'s "
        f"final PSNR, as a share of the time that {name} takes: 0.50 is half of it; a geometric "
        "mean, given only where all runs get there."
    )
    header = ("seeds", "strategy", "seconds in all", f"gain at {name}'s seconds, dB",
              f"runs that reach {name}'s PSNR", "time to it")  # fmt: skip
    return Table("seconds", "At equal seconds", header, rows, (note, _over_base(study)))


def advice_table(study: Study, strategy: StrategyName) -> Table | None:
    """The advice for each scene, and its worth; None for too few scenes."""
    score = score_advice(study, strategy)
    if len(score.advised) < FEWEST:
        return None
    always = (SFM, "mls", "auto")
    missed = {scene: -score.gain_over(scene, score.best(scene)) for scene in score.advised}
    over = {each: [score.gain_over(scene, each) for scene in score.advised] for each in always}
    rows: list[tuple[Cell, ...]] = [
        (
            scene,
            score.advised[scene],
            score.best(scene),
            Number(missed[scene]),
            *(Number(over[each][i], signed=True) for each in always),
        )
        for i, scene in enumerate(score.advised)
    ]
    known = {each: [gain for gain in over[each] if not math.isnan(gain)] for each in always}
    rows.append((
        "mean", "", "", Number(fmean(missed.values())),
        *(Number(fmean(each) if each else math.nan, signed=True) for each in known.values()),
    ))  # fmt: skip
    right = sum(each <= 0.1 for each in missed.values())
    said = (
        f"Within 0.1 dB of the best arm on {right} of {len(missed)} scenes. Each scene is advised "
        "by the threshold that served the others best."
    )
    left = f"Left out for want of runs: {', '.join(score.left_out)}."
    return Table(
        f"advice_{strategy}",
        f"What the advice is worth, strategy {strategy}",
        ("scene", "advice", "best arm", "missed, dB", *(f"gain over always {e}" for e in always)),
        rows,
        (said, left) if score.left_out else (said,),
    )


def comparison_tables(comparison: Comparison) -> tuple[Table, Table, Table]:
    """The settings of two benchmarks that differ, the changes, and what only one of them has."""
    scenes = sorted({scene for _, _, scene in comparison.changes})

    def changed(arm: Arm, scene: str) -> Cell:
        return _change_cell(comparison.changes.get((*arm, scene)))

    changes = [
        (*arm, *(changed(arm, scene) for scene in scenes), _change_cell(mean))
        for arm, mean in comparison.means.items()
    ]
    note = (
        "PSNR in B less that in A, dB ± standard error. *: more than noise (Welch's test, "
        "Holm-corrected over all changes on scenes, and over all means); ~: within noise. (1 "
        "run): nothing is known of the noise."
    )
    only: list[tuple[str, Place]] = [("A", each) for each in comparison.only_a]
    only += [("B", each) for each in comparison.only_b]
    return (
        Table("settings", "Settings that differ", ("setting", "A", "B"), comparison.settings),
        Table("changes", "Changes from A to B", ("strategy", "method", *scenes, "mean"), changes,
              (note,)),
        Table("only_one", "What only one of them has", ("in", "strategy", "scene", "method"),
              [(name, strategy, scene, label) for name, (strategy, label, scene) in only]),
    )  # fmt: skip


def _change_cell(change: Difference | None) -> Cell:
    if change is None:
        return ""
    mark = {"within noise": NOISE, "unknown": ""}.get(change.verdict, "*")
    text = ONE_RUN if change.verdict == "unknown" else ""
    return Number(change.mean, 3, change.se, signed=True, mark=mark, text=text, bold=mark == "*")
