"""Tables of a study: scores, gains, costs, arms at equal cost.

Means are over the runs of a scene first, then over scenes. Only a significant gain is marked best.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from statistics import fmean, stdev

from splatseed.bench import comparisons
from splatseed.bench.comparisons import ArmKey, ComparedArm, compared_arms, gains
from splatseed.bench.plan import SFM
from splatseed.bench.statistics import Difference, Verdict
from splatseed.bench.study import Study
from splatseed.bench.tables import Cell, Number, Row, Table, make_table
from splatseed.training.settings import StrategyName

CLEAR = "†"
_MARKS: Mapping[Verdict, str] = {"within noise": "~", "too few to tell": "?"}
_COSTS = {
    "num_seeds": ("seeds", 0), "seeding": ("upsampling, s", 2), "training": ("training, s", 1),
    "memory": ("peak memory, MB", 0), "gpu_memory": ("peak GPU memory, MB", 0),
    "gaussians": ("Gaussians", 0), "model": ("model, MB", 1), "render": ("render a view, ms", 1),
}  # fmt: skip
"""Heading and decimals by measure."""
_ARM_COLUMNS = {
    "psnr": ("PSNR, dB", "gain, dB", 2, 3),
    "cc_psnr": ("colour-corrected, dB", "its gain, dB", 2, 3),
    "covisible": ("co-visible, dB", "its gain, dB", 2, 3),
    "ssim": ("SSIM", "its gain", 4, 4), "flip": ("FLIP", "its gain", 4, 4),
    "lpips": ("LPIPS", "its gain", 4, 4),
}  # fmt: skip
"""Headings of a score and of its gain, and the decimals of both."""

Rows = list[Row]


def verdict_mark(gain: Difference) -> str:
    """The mark of a difference that is no claim, which notes of tables explain; else empty."""
    return _MARKS.get(gain.verdict, "")


def _gain_cell(gain: Difference | None, digits: int = 3) -> Cell:
    if gain is None:
        return ""
    return Number(gain.mean, digits, gain.se, signed=True, mark=verdict_mark(gain))


def _ratio_cell(log: Difference | None) -> Cell:
    if log is None:
        return ""
    return Number(math.exp(log.mean), mark=verdict_mark(log))


def psnr_table(study: Study, strategy: StrategyName) -> Table:
    """Tabulate PSNR by scene and variant."""
    columns = (SFM, *study.seeded_under(strategy))
    rows = [_psnr_row(study, strategy, s, columns) for s in study.scenes_under(strategy)]
    return make_table("psnr", ("scene", *columns), rows, strategy=strategy,
                      description=study.description)  # fmt: skip


def _psnr_row(study: Study, strategy: StrategyName, scene: str, labels: Sequence[str]) -> Row:
    gained = gains(study, strategy)
    found = {v: each for v in labels if (each := gained.on_scene.get((scene, v)))}
    best, clear = gained.top(scene), comparisons.clear_best(study, strategy, scene)

    def cell(label: str) -> Cell:
        values = [run.psnr for run in study.results(strategy, scene, label).values()]
        if not values:
            return ""
        gain, mark = found.get(label), ""
        if label == SFM:
            bold = bool(found) and {each.verdict for each in found.values()} == {"worse"}
        else:
            bold = gain is not None and label == best and gain.verdict == "better"
            mark = (verdict_mark(gain) if gain else "") or CLEAR * (bold and clear)
        se = stdev(values) / math.sqrt(len(values)) if len(values) > 1 else math.nan
        return Number(fmean(values), se=se, mark=mark, bold=bold)

    return scene, *map(cell, labels)


def cost_table(study: Study, strategy: StrategyName) -> Table:
    """Tabulate time, memory and size by variant, over the scenes with runs of the baseline."""
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
    devices = sorted({result.device for result in study.under(strategy)["result"]})
    return make_table(
        "costs", ("method", *columns), list(zip(labels, *columns.values(), strict=True)),
        strategy=strategy, count=len(scenes), scenes=", ".join(scenes),
        devices=", ".join(devices), description=study.description,
    )  # fmt: skip


def gain_table(study: Study, strategy: StrategyName) -> Table:
    """Tabulate the gains of each variant by scene, and their two means."""
    gained = gains(study, strategy)
    rows: Rows = [
        (scene, *(_gain_cell(gained.on_scene.get((scene, label))) for label in gained.seeds))
        for scene in gained.scenes
    ]
    rows.append(("mean, these scenes", *map(_gain_cell, gained.on_these.values())))
    if len(gained.scenes) > 1:
        rows.append(("mean, scenes like these", *map(_gain_cell, gained.on_like.values())))
    return make_table("gains", ("scene", *gained.seeds), rows, strategy=strategy,
                      description=study.description)  # fmt: skip


def arm_table(study: Study) -> Table:
    """Tabulate the scores, costs and gains of all arms, in order of gain."""
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
        f"Co-visible PSNR counts the pixels that at least two training views see ({share:.0%} of "
        "them here). Higher PSNR and SSIM are better, lower FLIP and LPIPS. Seconds are wall time."
    )
    header = ("seeds", "strategy", *(word for columns in shown.values() for word in columns[:2]),
              "Gaussians", "seeding, s", "training, s", "scenes")  # fmt: skip
    return make_table(
        "arms", header, rows, base=base.label if base else "the baseline",
        budget=", under one budget of Gaussians" if study.settings["budget"] else "",
        scores="" if math.isnan(share) else scores, description=study.description,
    )  # fmt: skip


def scene_arm_table(study: Study, base: ArmKey) -> Table:
    """Tabulate the gain of each arm on each scene; the row of the baseline has its PSNR."""

    def cell(arm: ComparedArm, scene: str) -> Cell:
        first = study.results(base.strategy, scene, base.seeds)
        own = study.results(arm.arm.strategy, scene, arm.arm.seeds)
        gained = [own[repeat].psnr - first[repeat].psnr for repeat in first.keys() & own.keys()]
        if not gained:
            return ""
        if arm.arm == base:
            return Number(fmean(run.psnr for run in own.values()))
        low, high = (Number(end, signed=True) for end in (min(gained), max(gained)))
        span, gain = f"({low} to {high})" if len(gained) > 1 else "", arm.on_scene[scene]
        return Number(gain.mean, signed=True, text=span, mark=verdict_mark(gain))

    rows = [
        (each.arm.seeds, each.arm.strategy, *(cell(each, scene) for scene in study.scenes))
        for each in compared_arms(study)
    ]
    header = ("seeds", "strategy", *study.scenes)
    return make_table("arms_by_scene", header, rows, base=base.label)


def seconds_table(study: Study, base: ArmKey) -> Table:
    """Tabulate PSNR at the baseline's time, and time and steps to the baseline's PSNR."""
    rows = [
        (each.arm.seeds, each.arm.strategy,
         Number(each.means["seeding"] + each.means["training"], 1),
         _gain_cell(each.gains["in_time"]) if each.arm != base else "baseline",
         f"{each.reached} of {each.runs}",
         *(_ratio_cell(each.gains[name]) for name in ("seconds", "steps")))
        for each in compared_arms(study)
    ]  # fmt: skip
    gain, reached = f"gain at the time of {base.label}, dB", f"runs that reach {base.label}"
    header = (
        "seeds",
        "strategy",
        "total seconds",
        gain,
        reached,
        "relative time",
        "relative steps",
    )
    return make_table("seconds", header, rows, base=base.label)
