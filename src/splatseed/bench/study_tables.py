"""The tables of a study: scores, gains, costs, arms at equal cost, advice; and of comparisons.

Means are over runs within a scene first, then over scenes; the paper's numbers have rows or columns
of their own where a scene's name is one of its scenes; nothing is best that could be noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean

import pandas as pd
from scipy.stats import sem

from splatseed.bench import comparisons
from splatseed.bench.comparisons import DATASETS, PAPER_TABLES, ArmKey, compared_arms, gains
from splatseed.bench.plan import SFM
from splatseed.bench.statistics import Difference
from splatseed.bench.study import Study
from splatseed.bench.tables import Cell, Number, Row, Table, make_table
from splatseed.training.settings import StrategyName

NOISE, CLEAR, ONE_RUN = "~", "†", "(1 run)"
_FEWEST = 3
"""Scenes from which on advice is scored."""
_COSTS = {
    "num_seeds": ("seeds", 0), "seeding": ("upsampling, s", 2), "training": ("training, s", 1),
    "memory": ("peak memory, MB", 0), "gpu_memory": ("peak GPU memory, MB", 0),
    "gaussians": ("Gaussians", 0), "model": ("model, MB", 1), "render": ("render a view, ms", 1),
}  # fmt: skip
"""Heading and digits by measure."""
_ARM_COLUMNS = {
    "psnr": ("PSNR, dB", "gain, dB", 2, 3),
    "cc_psnr": ("colour-corrected, dB", "its gain, dB", 2, 3),
    "covisible": ("co-visible, dB", "its gain, dB", 2, 3),
    "ssim": ("SSIM", "its gain", 4, 4), "flip": ("FLIP", "its gain", 4, 4),
    "lpips": ("LPIPS", "its gain", 4, 4),
}  # fmt: skip
"""Headings of a score and its gain, and the digits of both."""

Rows = list[Row]


def _gain_cell(gain: Difference | None, digits: int = 3, alone: str = "") -> Cell:
    """A gain with its standard error, or with ``alone`` if it is of one sample; ~: within noise."""
    if gain is None:
        return ""
    mark = NOISE if gain.verdict == "within noise" else ""
    text = alone if math.isnan(gain.se) and gain.n == 1 else ""
    return Number(gain.mean, digits, gain.se, signed=True, mark=mark, text=text)


def _ratio_cell(log: Difference | None) -> Cell:
    if log is None:
        return ""
    return Number(math.exp(log.mean), mark=NOISE if log.verdict == "within noise" else "")


def psnr_tables(study: Study, strategy: StrategyName) -> list[Table]:
    """PSNR by scene and variant: a table per dataset of the paper, and one for other scenes."""
    left, tables = study.scenes_under(strategy), []
    for key in (*DATASETS, ""):
        scenes = [each for each in left if not key or each in comparisons.paper_psnr(key).index]
        left = tuple(each for each in left if each not in scenes)
        if scenes:
            tables.append(_psnr_table(study, strategy, key, scenes))
    return tables


def _psnr_table(study: Study, strategy: StrategyName, key: str, scenes: Sequence[str]) -> Table:
    columns, rows = (SFM, *study.seeded_under(strategy)), Rows()
    for scene in scenes:
        rows.append(_psnr_row(study, strategy, scene, columns))
        if key:
            printed = comparisons.paper_psnr(key).loc[scene].reindex(_entries(study, columns))
            rows.append((f"{scene} (paper)", *map(Number, printed)))
    printed_note = (
        "Rows '(paper)' are the numbers printed there: 30,000 steps, a quarter (outdoors) or half "
        "(indoors) of the size of Mip-NeRF360's photographs. Compare gains, not levels."
    )
    table = make_table(
        "table_scenes", ("scene", *columns), rows, strategy=strategy, description=study.description,
        dataset=DATASETS.get(key, "other scenes"), printed=printed_note if key else "",
    )  # fmt: skip
    return replace(table, name=f"{PAPER_TABLES[key]}_{strategy}") if key else table


def _entries(study: Study, labels: Sequence[str]) -> list[tuple[str, float]]:
    """Method and ratio of variants, by which the paper's tables are ordered."""
    arms = [study.variants.get(label) for label in labels]
    return [(arm.method, arm.ratio) if arm else (SFM, 1.0) for arm in arms]


def _psnr_row(study: Study, strategy: StrategyName, scene: str, labels: Sequence[str]) -> Row:
    gained = gains(study, strategy)
    verdicts = {v: each.verdict for v in labels if (each := gained.on_scene.get((scene, v)))}
    best, clear = gained.top(scene), comparisons.clear_best(study, strategy, scene)

    def cell(label: str) -> Cell:
        values = [run.psnr for run in study.results(strategy, scene, label).values()]
        if not values:
            return ""
        verdict, text = verdicts.get(label), ONE_RUN if len(values) == 1 else ""
        if label == SFM:
            bold, mark = bool(verdicts) and set(verdicts.values()) == {"worse"}, ""
        else:
            bold = label == best and verdict == "better"
            mark = NOISE if verdict == "within noise" else CLEAR * (bold and clear)
        se = math.nan if text else float(sem(values))
        return Number(fmean(values), se=se, text=text, mark=mark, bold=bold)

    return scene, *map(cell, labels)


def cost_table(study: Study, strategy: StrategyName) -> Table:
    """Time, memory and size by variant, over the scenes that sfm has too; the paper's beside."""
    part = study.under(strategy)
    part = part[part["scene"].isin(part.loc[part["seeds"] == SFM, "scene"])]
    means = part.groupby(["seeds", "scene"])[list(_COSTS)].mean().groupby("seeds").mean()
    means = means.reindex([SFM, *study.seeded_under(strategy)]).dropna(axis=1, how="all")
    columns = {
        heading: [Number(each, digits) for each in means[name]]
        for name, (heading, digits) in _COSTS.items()
        if name in means
    }
    counts = part.groupby("seeds")["scene"].nunique().reindex(means.index)
    columns["scenes"] = [Number(each, 0) for each in counts]
    labels, scenes = list(means.index), tuple(sorted(set(part["scene"])))
    for key, title in DATASETS.items():
        if set(scenes) & set(comparisons.paper_psnr(key).index):
            printed = comparisons.paper_costs(key).reindex(_entries(study, labels))
            for name, what in (("train_time_s", "training, s"), ("model_size_mb", "model, MB")):
                columns[f"paper, {what} ({title})"] = [Number(each, 0) for each in printed[name]]
    devices = sorted({result.device for result in study.under(strategy)["result"]})
    return make_table(
        "table3", ("method", *columns), list(zip(labels, *columns.values(), strict=True)),
        strategy=strategy, count=len(scenes), scenes=", ".join(scenes),
        devices=", ".join(devices), description=study.description,
    )  # fmt: skip


def gain_table(study: Study, strategy: StrategyName) -> Table:
    """What each variant gains: on each scene, on these, on scenes like these, and in the paper."""
    gained = gains(study, strategy)
    rows: Rows = [
        (
            scene,
            *(
                _gain_cell(gained.on_scene.get((scene, label)), alone=ONE_RUN)
                for label in gained.seeds
            ),
        )
        for scene in gained.scenes
    ]
    rows.append(("mean, these scenes", *map(_gain_cell, gained.on_these.values())))
    if len(gained.scenes) > 1:
        like = (_gain_cell(each, alone="(1 scene)") for each in gained.on_like.values())
        rows.append(("mean, scenes like these", *like))
    for key, title in DATASETS.items():
        printed = comparisons.paper_gains(key)
        scenes = [scene for scene in gained.scenes if scene in printed.index]
        means = printed.loc[scenes].mean().reindex(_entries(study, gained.seeds))
        if means.notna().any():
            name = f"paper, {len(scenes)} of {len(printed)} {title} scenes"
            rows.append((name, *(Number(mean, 3, signed=True) for mean in means)))
    return make_table("gains", ("scene", *gained.seeds), rows, strategy=strategy,
                      description=study.description)  # fmt: skip


def mean_gain_table(study: Study) -> Table:
    """The three kinds of mean gain, ours by strategy and the paper's."""
    known, rows = {}, Rows()
    for strategy in study.strategies:
        gained = gains(study, strategy)
        known[f"ours, {strategy}"] = pd.DataFrame([gained.means(s) for s in gained.scenes])
    for key, title in DATASETS.items():
        printed = comparisons.paper_gains(key)
        labels = [f"{method} {ratio:g}x" for method, ratio in printed.columns]
        known[f"paper, {title}"] = printed.set_axis(labels, axis=1)
    for name, table in known.items():
        complete = table.dropna(axis=1)  # the variants that every scene has
        if not complete.empty:
            means = complete.mean()
            best = str(means.idxmax())
            kinds = means.mean(), means[best], complete.max(axis=1).mean()
            over_all, over_best, over_each = (Number(each, 3, signed=True) for each in kinds)
            whole = (Number(size, 0) for size in complete.shape)
            rows.append((name, over_all, over_best, best, over_each, *whole))
    header = ("", "all variants together", "best single variant", "which",
              "best of each scene (unfair)", "scenes", "variants")  # fmt: skip
    return make_table("mean_gains", header, rows)


def arm_table(study: Study) -> Table:
    """Every arm's scores, cost and gain over the baseline, the highest gain first."""
    base, compared, rows = comparisons.baseline_of(study), compared_arms(study), Rows()
    shown = {
        name: columns
        for name, columns in _ARM_COLUMNS.items()
        if any(not math.isnan(each.means[name]) for each in compared)
        and (name != "cc_psnr" or study.settings["exposure"] != "none")
    }
    for each in compared:
        cells: list[Cell] = []
        for name, (_, _, digits, gain_digits) in shown.items():
            gain = _gain_cell(each.gains[name], gain_digits) if each.arm != base else "baseline"
            cells += [Number(each.means[name], digits), gain]
        costs = (("gaussians", 0), ("seeding", 1), ("training", 1))
        cells += [Number(each.means[name], digits) for name, digits in costs]
        rows.append((each.arm.seeds, each.arm.strategy, *cells, f"{len(each.scenes)}"))
    share = study.runs.dropna(subset="share").drop_duplicates("scene")["share"].mean()
    scores = (
        "Co-visible PSNR counts the pixels that at least two training views see "
        f"({share:.0%} of them here). PSNR and SSIM are better when higher, FLIP and "
        "LPIPS when lower. "
        "Seconds are wall time, of making the seeds and of training."
    )
    header = ("seeds", "strategy", *(word for columns in shown.values() for word in columns[:2]),
              "Gaussians", "seeding, s", "training, s", "scenes")  # fmt: skip
    return make_table(
        "arms", header, rows, base=base.label if base else "the baseline",
        budget=", under one budget of Gaussians" if study.settings["budget"] else "",
        scores="" if math.isnan(share) else scores, description=study.description,
    )  # fmt: skip


def scene_arm_table(study: Study, base: ArmKey) -> Table:
    """Each arm's gain on each scene, mean over repeats, and on the baseline's row its PSNR."""

    def cell(arm: ArmKey, scene: str) -> Cell:
        first = study.results(base.strategy, scene, base.seeds)
        own = study.results(arm.strategy, scene, arm.seeds)
        gained = [own[repeat].psnr - first[repeat].psnr for repeat in first.keys() & own.keys()]
        if not gained:
            return ""
        if arm == base:
            return Number(fmean(run.psnr for run in own.values()))
        low, high = (Number(end, signed=True) for end in (min(gained), max(gained)))
        span = f"({low} to {high})" if len(gained) > 1 else ""
        return Number(fmean(gained), signed=True, text=span)

    arms = [each.arm for each in compared_arms(study)]
    rows = [(a.seeds, a.strategy, *(cell(a, scene) for scene in study.scenes)) for a in arms]
    header = ("seeds", "strategy", *study.scenes)
    return make_table("arms_by_scene", header, rows, base=base.label)


def seconds_table(study: Study, base: ArmKey) -> Table:
    """Quality at the baseline's seconds, and steps and seconds to the baseline's quality."""
    rows = [
        (each.arm.seeds, each.arm.strategy,
         Number(each.means["seeding"] + each.means["training"], 1),
         _gain_cell(each.gains["in_time"]) if each.arm != base else "baseline",
         f"{each.reached} of {each.runs}",
         *(_ratio_cell(each.gains[name]) for name in ("seconds", "steps")))
        for each in compared_arms(study)
    ]  # fmt: skip
    header = ("seeds", "strategy", "seconds in all", f"gain at {base.label}'s seconds, dB",
              f"runs that reach {base.label}'s PSNR", "time to it", "steps to it")  # fmt: skip
    return make_table("seconds", header, rows, base=base.label)


def advice_table(study: Study, strategy: StrategyName) -> Table | None:
    """The advice for each scene, and its worth; None for too few scenes."""
    scores = comparisons.score_advice(study, strategy)
    left_out = scores.index[scores["advice"].isna()]
    scores = scores.drop(left_out).dropna(axis=1, how="all")
    if len(scores) < _FEWEST:
        return None
    psnr, advice = scores.drop(columns="advice").astype(float), scores["advice"]
    advised = pd.Series([psnr.loc[scene, of] for scene, of in advice.items()], psnr.index)
    best, missed = psnr.idxmax(axis=1), psnr.max(axis=1) - advised
    always = (SFM, "mls", "auto")
    over = pd.DataFrame({each: advised - psnr.get(each, math.nan) for each in always})
    rows: Rows = [
        (scene, advice[scene], best[scene], Number(missed[scene]),
         *(Number(each, signed=True) for each in over.loc[scene]))
        for scene in scores.index
    ]  # fmt: skip
    means = (Number(mean, signed=True) for mean in over.mean())
    rows.append(("mean", "", "", Number(missed.mean()), *means))
    over_always = (f"gain over always {each}" for each in always)
    return make_table(
        "advice", ("scene", "advice", "best arm", "missed, dB", *over_always), rows,
        strategy=strategy, right=(missed <= 0.1).sum(), count=len(missed),
        left_out=f"Left out for want of runs: {', '.join(left_out)}." if len(left_out) else "",
    )  # fmt: skip


def comparison_tables(comparison: comparisons.Comparison) -> tuple[Table, Table, Table]:
    """The settings of two benchmarks that differ, the changes, and what only one of them has."""
    scenes = sorted({scene for _, _, scene in comparison.changes})
    changes = [
        (*arm, *(_change_cell(comparison.changes.get((*arm, scene)), ONE_RUN) for scene in scenes),
         _change_cell(mean))
        for arm, mean in comparison.means.items()
    ]  # fmt: skip
    settings = make_table("settings", ("setting", "A", "B"), comparison.settings)
    changed = make_table("changes", ("strategy", "method", *scenes, "mean"), changes)
    only = make_table("only_one", ("in", "strategy", "scene", "method"), comparison.only)
    return settings, changed, only


def _change_cell(change: Difference | None, alone: str = "") -> Cell:
    if change is None:
        return ""
    mark = {"within noise": NOISE, "unknown": ""}.get(change.verdict, "*")
    text = alone if change.verdict == "unknown" else ""
    return Number(change.mean, 3, change.se, signed=True, mark=mark, text=text, bold=mark == "*")
