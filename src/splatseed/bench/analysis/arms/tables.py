"""Tables of arms at equal numbers of Gaussians and at equal seconds, with conclusions in words.

Notation and promise: see ``splatseed.bench.analysis.arms.compared``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from splatseed.bench.analysis.arms.compared import Arm, Compared, baseline_of, compared_arms
from splatseed.bench.analysis.psnr_tables import gain_cell
from splatseed.bench.analysis.statistics import Difference
from splatseed.bench.analysis.study import BASELINE, Study
from splatseed.bench.analysis.tables import Cell, Table, number, words
from splatseed.bench.planning.records import RunResult

SHOWN = 0.005
"""The least gain in dB that does not read 0.00."""
EQUAL = 0.01
"""Numbers of Gaussians that differ by no more than this share count as equal."""

GAIN_NOTE = (
    "Gains are over {base}, paired by scene and repeat: mean ± standard error over scenes (over "
    "repeats where there is one scene). ~: within noise (t-test, Holm-corrected over the column)."
)
SCORES_NOTE = (
    "Co-visible PSNR counts the pixels that at least two training views see ({share:.0%} of them "
    "here). PSNR and SSIM are better when higher, LPIPS when lower. Seconds are wall time, of "
    "making the seeds and of training."
)
SECONDS_NOTE = (
    "Seconds count making the seeds and training. The gain at {base}'s seconds is an arm's PSNR "
    "when {base} ends, less {base}'s final PSNR; an arm that ended sooner counts with its own "
    "final PSNR. The time to {base}'s PSNR is when an arm first reaches {base}'s final PSNR, as a "
    "share of the time that {base} takes: 0.50 is half of it; a geometric mean, given only where "
    "all runs get there."
)

_DOUBTS = {
    "within noise": ", which may be chance",
    "unknown": ", which a single run cannot confirm",
}
"""What follows a difference that is not shown, by verdict."""


def arm_table(study: Study) -> Table:
    """Every arm's scores, cost and gain over the baseline, the highest gain first.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    with_lpips = any(each.lpips is not None for each in compared)
    with_covisible = any(each.covisible_psnr is not None for each in compared)
    scores = ["PSNR, dB", "gain, dB"]
    scores += ["co-visible, dB", "its gain, dB"] if with_covisible else []
    scores += ["SSIM", "its gain"]
    scores += ["LPIPS", "its gain"] if with_lpips else []
    rows = []
    for each in compared:
        own = each.arm == base
        cells = [number(each.psnr), _gain(each.gain, own)]
        if with_covisible:
            cells += [number(each.covisible_psnr), _gain(each.covisible_gain, own)]
        cells += [number(each.ssim, 4), _gain(each.ssim_gain, own, 4)]
        if with_lpips:
            cells += [number(each.lpips, 4), _gain(each.lpips_gain, own, 4)]
        costs = (each.num_gaussians, 0), (each.seeding, 1), (each.training, 1)
        cells += [*(number(*cost) for cost in costs), words(f"{len(each.scenes)}")]
        rows.append((words(each.arm.variant.label), words(each.arm.strategy), *cells))
    header = ("seeds", "strategy", *scores, "Gaussians", "seeding, s", "training, s", "scenes")
    share = _share(study)
    notes = [GAIN_NOTE.format(base=base.label if base else "")]
    notes += [SCORES_NOTE.format(share=share)] if share is not None else []
    title = "All arms, under one budget of Gaussians" if study.settings["budget"] else "All arms"
    return Table("arms", title, header, tuple(rows), (*notes, f"{study.description}."))


def _gain(gain: Difference | None, own: bool, digits: int = 2) -> Cell:
    if own:
        return words("baseline")
    if digits == 2 or gain is None:
        return gain_cell(gain)
    mark = "~" if gain.verdict == "within noise" else ""
    return Cell(gain.mean, gain.se, digits, signed=True, mark=mark)


def _share(study: Study) -> float | None:
    """Mean share of co-visible pixels over the scenes."""
    shares = []
    for scene in study.scenes:
        runs = [row.result for row in study.rows[scene] if row.result]
        known = [s for run in runs if (s := run.scores.covisible_share) is not None]
        shares += known[:1]
    return sum(shares) / len(shares) if shares else None


def scene_arm_table(study: Study) -> Table:
    """Each arm's gain on each scene, mean over repeats, and on the baseline's row its PSNR.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    rows = []
    for each in compared:
        cells = []
        for scene in study.scenes:
            own = _runs(study, each.arm, scene)
            pairs = [] if base is None else [
                (first, own[r]) for r, first in _runs(study, base, scene).items() if r in own
            ]  # fmt: skip
            cells.append(_scene_cell(pairs, each.arm == base))
        rows.append((words(each.arm.variant.label), words(each.arm.strategy), *cells))
    note = (
        f"PSNR in dB of {base.label if base else ''}; of the others what they gain over it, mean "
        "over repeats (with the lowest and the highest, where there are several)."
    )
    header = ("seeds", "strategy", *study.scenes)
    return Table("arms_by_scene", "All arms by scene", header, tuple(rows), (note,))


def _runs(study: Study, arm: Arm, scene: str) -> dict[int, RunResult]:
    return dict(study.cell(arm.strategy, scene, arm.variant))


def _scene_cell(pairs: Sequence[tuple[RunResult, RunResult]], own: bool) -> Cell:
    if not pairs:
        return Cell()
    if own:
        return number(sum(base.psnr for base, _ in pairs) / len(pairs))
    gains = [arm.psnr - base.psnr for base, arm in pairs]
    span = f"({min(gains):+.2f} to {max(gains):+.2f})" if len(gains) > 1 else ""
    return Cell(sum(gains) / len(gains), digits=2, signed=True, text=span)


def seconds_table(study: Study) -> Table:
    """Quality at the baseline's seconds, and seconds to the baseline's quality.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    rows = [
        (
            words(each.arm.variant.label),
            words(each.arm.strategy),
            number(each.seeding + each.training, 1),
            _gain(each.gain_in_time, each.arm == base),
            words(f"{each.reached} of {each.runs}"),
            _share_of_time(each.sooner),
        )
        for each in compared
    ]
    name = base.label if base else "the baseline"
    header = ("seeds", "strategy", "seconds in all", f"gain at {name}'s seconds, dB",
              f"runs that reach {name}'s PSNR", "time to it")  # fmt: skip
    notes = (SECONDS_NOTE.format(base=name), GAIN_NOTE.format(base=name))
    return Table("seconds", "At equal seconds", header, tuple(rows), notes)


def _share_of_time(sooner: Difference | None) -> Cell:
    if sooner is None:
        return Cell()
    mark = "~" if sooner.verdict == "within noise" else ""
    return Cell(math.exp(sooner.mean), digits=2, mark=mark)


def unequal_numbers(study: Study) -> str | None:
    """A warning that the arms end with different numbers of Gaussians; None if they do not.

    Args:
        study: The study.
    """
    numbers = [each.num_gaussians for each in compared_arms(study)]
    if not numbers or max(numbers) <= min(numbers) * (1 + EQUAL):
        return None
    hint = "" if study.settings["budget"] else ": --budgets bounds every arm alike"
    return (
        f"The arms end with {min(numbers):,.0f} to {max(numbers):,.0f} Gaussians, and more of them "
        f"alone can bring a gain{hint}."
    )


def answer_at_equal_cost(study: Study) -> tuple[str, ...]:
    """The conclusions on the arms, for a reader who has not seen the tables.

    Args:
        study: The study.
    """
    base, compared = baseline_of(study), compared_arms(study)
    others = [each for each in compared if each.arm != base]
    if base is None or not others:
        return ()
    best, scenes = others[0], len(others[0].scenes)
    lead = f"On {scenes} scene{'' if scenes == 1 else 's'}"
    at = " under one budget of Gaussians" if study.settings["budget"] else ""
    at = at if unequal_numbers(study) else " with equal numbers of Gaussians"
    first = f"{best.arm.label} comes out best: "
    if best.gain.mean < SHOWN:
        first = f"nothing beats {base.label}: {best.arm.label} comes closest, "
    said = [f"{lead}{at}, {first}{_against(best, base)}."]
    as_it_is = [each for each in others if each.arm.variant == BASELINE]
    seeded = [each for each in others if each.arm.variant != BASELINE]
    if best.arm.variant == BASELINE and seeded:
        said.append(
            f"Of other seeds, {seeded[0].arm.label} does best: {_against(seeded[0], base)}."
        )
    elif best.arm.variant != BASELINE and as_it_is:
        top = as_it_is[0]
        said.append(f"Without new points, {top.arm.label} does best: {_against(top, base)}.")
    return (*said, *_in_time(best, base))


def _against(each: Compared, base: Arm) -> str:
    """A gain in words."""
    gain = each.gain
    if abs(gain.mean) < SHOWN:
        return f"level with {base.label}"
    more = "more" if gain.mean > 0 else "less"
    over = "scenes" if len(each.scenes) > 1 else "repeats"
    spread = "" if math.isnan(gain.se) else f" (± {gain.se:.2f} over {over})"
    doubt = _DOUBTS.get(gain.verdict, "")
    if gain.verdict == "within noise" and len(each.scenes) == 1:
        # The noise of all variants together, which other sentences go by, may tell more.
        doubt = f", which these two arms' {each.runs} repeats alone do not confirm"
    return f"{abs(gain.mean):.2f} dB{spread} {more} than {base.label}{doubt}"


def _in_time(best: Compared, base: Arm) -> tuple[str, ...]:
    """What the best arm is worth in time."""
    told = []
    if best.gain_in_time is not None:
        ahead = best.gain_in_time.mean
        place = "ahead" if ahead >= 0 else "behind"
        told.append(
            f"When {base.label} has finished, seeding counted, {best.arm.label} is "
            f"{abs(ahead):.2f} dB {place}{_DOUBTS.get(best.gain_in_time.verdict, '')}."
        )
    if best.sooner is not None:
        share = math.exp(best.sooner.mean)
        sooner = f"{share:.0%} of the time" if share < 1 else f"{share:.2f} times the time"
        told.append(
            f"It reaches {base.label}'s final PSNR after {sooner} of the whole run of "
            f"{base.label}, seeding counted{_DOUBTS.get(best.sooner.verdict, '')}."
        )
    elif best.reached < best.runs:
        told.append(f"{best.reached} of its {best.runs} runs reach {base.label}'s final PSNR.")
    return tuple(told)
