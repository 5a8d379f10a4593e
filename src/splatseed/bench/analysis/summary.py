"""The answer in a few sentences: does upsampling help here, by which method, at what cost?

Promise: a gain is claimed only if it exceeds noise after adjusting for the number of variants; if
there is a single run of each, the sentences say that the noise is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from statistics import fmean

from splatseed.bench.analysis.convergence import speed
from splatseed.bench.analysis.gains import Gains, gains
from splatseed.bench.analysis.statistics import LEVEL, Difference, Verdict
from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.bench.planning.records import RunResult
from splatseed.literal import counted
from splatseed.train.settings import StrategyName


def summary(study: Study, strategy: StrategyName) -> tuple[str, ...]:
    """The conclusions on a strategy, a sentence or two each.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    gained = gains(study, strategy)
    if not gained.variants:
        return (f"Strategy {strategy}: nothing can be compared with {BASELINE.label} yet.",)
    best = max(gained.variants, key=lambda each: gained.on_these[each].mean)
    said = [_answer(gained, best), _by_scene(gained, best), _elsewhere(gained, best)]
    return tuple(each for each in (*said, _cost(study, strategy, best)) if each)


def decibels(gain: Difference) -> str:
    """A gain in words, with the noise of training again as its standard error."""
    spread = "" if math.isnan(gain.se) else f", ± {gain.se:.2f} by the repeats of all variants"
    return f"{gain.mean:+.2f} dB{spread}"


def _answer(gained: Gains, best: Variant) -> str:
    """Whether any variant gains, and which gains most."""
    scenes = counted(len(gained.scenes), "scene")
    lead = f"Strategy {gained.strategy}, {scenes}:"
    top = gained.on_these[best]
    if top.verdict == "unknown":
        return (
            f"{lead} with one run of each nothing is known of the noise, so no gain can be claimed."
            f" The highest is that of {best.label}, {decibels(top)}."
        )
    better, worse = (_those(gained, verdict) for verdict in ("better", "worse"))
    of = f"of {counted(len(gained.variants), 'variant')}"
    if better:
        most = f"{best.label} most ({decibels(top)})"
        text = f"{lead} yes, {len(better)} {of} gain more than noise, {most}."
    else:
        text = (
            f"{lead} no gain beyond noise was found among "
            f"{counted(len(gained.variants), 'variant')}; the"
            f" highest is that of {best.label}, {decibels(top)}."
        )
    loses = (
        f" Beyond noise, {_listed(worse)} {'lose' if len(worse) > 1 else 'loses'}." if worse else ""
    )
    return text + loses


def _those(gained: Gains, verdict: Verdict) -> list[str]:
    return [each.label for each in gained.variants if gained.on_these[each].verdict == verdict]


def _by_scene(gained: Gains, best: Variant) -> str:
    """On how many scenes the best variant gains and loses."""
    known = [d for s in gained.scenes if (d := gained.on_scene.get((s, best))) is not None]
    if len(known) < 2 or all(each.verdict == "unknown" for each in known):
        return ""
    kinds: tuple[Verdict, ...] = ("better", "worse", "within noise")
    counts = {kind: sum(each.verdict == kind for each in known) for kind in kinds}
    return (
        f"On single scenes {best.label} is better on {counts['better']}, worse on "
        f"{counts['worse']} and within noise on {counts['within noise']} of {len(known)}."
    )


def _elsewhere(gained: Gains, best: Variant) -> str:
    """Whether the gain can be expected on other scenes."""
    like = gained.on_like[best]
    if like.verdict == "unknown":
        return "One scene says nothing about others."
    low, high = like.interval()
    span = f"95% interval {low:+.2f} to {high:+.2f} dB"
    if like.verdict == "within noise":
        lead = "For scenes like these it is not shown to gain"
        return f"{lead}: {span} before adjusting for the choice."
    gain = "a gain" if like.mean > 0 else "a loss"
    return f"For scenes like these {gain} is shown too: {span}."


def _cost(study: Study, strategy: StrategyName, best: Variant) -> str:
    """What the best variant costs beside the baseline, and how soon it is as good."""
    seconds = fmean(own.upsample_seconds for _, own in _pairs(study, strategy, best))
    longer = _times(study, strategy, best, lambda r: r.train_seconds)
    larger = _times(study, strategy, best, lambda r: float(r.num_gaussians))
    text = (
        f"{best.label} costs {seconds:.1f} s of upsampling per scene, trains {longer:.2f} times as "
        f"long as {BASELINE.label} and ends with {larger:.2f} times as many Gaussians."
    )
    sooner = speed(study, strategy, best)
    if sooner is None:
        return text
    if sooner.log_steps is None or sooner.log_seconds is None:
        part = f"{sooner.reached} of {sooner.pairs} runs"
        return f"{text} {part} reach {BASELINE.label}'s final PSNR."
    return f"{text} {_when_as_good(sooner.log_steps, sooner.log_seconds)}"


def _when_as_good(steps: Difference, seconds: Difference) -> str:
    """How soon it reaches the baseline's final result; a single pair's NaN counts as unsure."""
    base = BASELINE.label
    if not any(each.p <= LEVEL for each in (steps, seconds)):
        return f"Whether it reaches {base}'s final PSNR sooner cannot be told from noise."
    parts = [
        f"{math.exp(each.mean):.0%} of the {unit}" + ("" if each.p <= LEVEL else " (may be chance)")
        for each, unit in ((steps, "steps"), (seconds, "seconds"))
    ]
    share = " and ".join(parts)
    return f"To reach {base}'s final PSNR it takes {share} that {base} takes to first reach it."


def _pairs(
    study: Study, strategy: StrategyName, variant: Variant
) -> list[tuple[RunResult, RunResult]]:
    scenes = study.scenes_of(strategy)
    return [pair for scene in scenes for pair in study.pairs(strategy, scene, variant)]


def _times(
    study: Study, strategy: StrategyName, variant: Variant, measure: Callable[[RunResult], float]
) -> float:
    """Geometric mean over pairs of runs of how many times the baseline's measure it is."""
    pairs = _pairs(study, strategy, variant)
    logs = [math.log(max(measure(own), 1e-9) / max(measure(base), 1e-9)) for base, own in pairs]
    return math.exp(fmean(logs))


def _listed(names: Sequence[str]) -> str:
    return " and ".join([*([", ".join(names[:-1])] if names[:-1] else []), names[-1]])
