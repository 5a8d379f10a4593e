"""How good the advice is, by a ledger's runs: leave-one-out over scenes.

Notation: *regret* is the PSNR of the best arm minus that of the advised one, dB; the arms are those
of one strategy, at one number of Gaussians, by method. Promise: the threshold for a scene is fitted
on the other scenes only, and scenes that lack an arm are listed, not filled in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import NamedTuple

from splatseed.bench.analysis.study import BASELINE, Study
from splatseed.bench.analysis.tables import Table, number, words
from splatseed.seeding.advice import AS_IT_IS, ROOM, Measured, advise
from splatseed.train.settings import StrategyName

CLOSE = 0.1
"""Advice within this many decibels of the best arm counts as right."""
ROOMS = (1.0, 1.1, 1.3, 1.6, 2.0, 3.0, 5.0, 1e9)
"""Candidate thresholds; the last leaves every scene as it is."""
ALWAYS = (AS_IT_IS, "mls", "auto")


@dataclass(frozen=True)
class Advised:
    """The advice for a scene.

    Args:
        scene: The scene.
        method: The advised method.
        best: The method of the arm that scored highest.
        psnr: Mean PSNR by method, dB.
    """

    scene: str
    method: str
    best: str
    psnr: Mapping[str, float]

    @property
    def regret(self) -> float:
        """The regret, dB."""
        return self.psnr[self.best] - self.psnr[self.method]


@dataclass(frozen=True)
class AdviceScore:
    """The advice on all scenes.

    Args:
        strategy: The arms' strategy.
        scenes: The advice for each scene.
        left_out: Scenes that lack a necessary run.
    """

    strategy: StrategyName
    scenes: tuple[Advised, ...]
    left_out: tuple[str, ...]

    @property
    def right(self) -> int:
        """The number of scenes with advice within ``CLOSE`` of the best arm."""
        return sum(each.regret <= CLOSE for each in self.scenes)

    def gain_over(self, method: str) -> float | None:
        """Gain of following the advice over always taking one method, dB, mean over scenes."""
        known = [e.psnr[e.method] - e.psnr[method] for e in self.scenes if method in e.psnr]
        return fmean(known) if known else None


def score_advice(study: Study, strategy: StrategyName) -> AdviceScore:
    """Advise each scene with a threshold fitted on the others, and look up the result.

    Args:
        study: A study of runs under a budget.
        strategy: The arms' strategy.
    """
    psnr = {scene: _by_method(study, strategy, scene) for scene in study.scenes}
    known = {s: p for s, p in psnr.items() if AS_IT_IS in p and "auto" in p}
    facts = {scene: _facts(study, strategy, scene) for scene in known}
    advised = []
    for scene, scores in known.items():
        others = [each for each in known if each != scene]
        room = _fitted([(facts[each], known[each]) for each in others])
        method = facts[scene].followed(scores, room)
        best = max(scores, key=lambda each: scores[each])
        advised.append(Advised(scene, method, best, scores))
    left = tuple(scene for scene in study.scenes if scene not in known)
    return AdviceScore(strategy, tuple(advised), left)


def _by_method(study: Study, strategy: StrategyName, scene: str) -> dict[str, float]:
    """Mean PSNR over repeats by method; the first variant stands for its method."""
    scores: dict[str, float] = {}
    for variant in (*study.variants_of(strategy), BASELINE):
        runs = study.cell(strategy, scene, variant)
        if runs and variant.profile == "default":
            scores.setdefault(variant.method, fmean(run.psnr for run in runs.values()))
    return scores


class _Facts(NamedTuple):
    """A scene's measurements from the ledger, and its training."""

    measured: Measured
    most_seeds: int
    strategy: StrategyName

    def followed(self, scores: Mapping[str, float], room: float) -> str:
        """The advised method, or the scene's points as they are if it was not run."""
        said = advise(self.measured, self.most_seeds, strategy=self.strategy, room=room)
        return said.method if said.method in scores else AS_IT_IS


def _facts(study: Study, strategy: StrategyName, scene: str) -> _Facts:
    rows = [r for r in study.rows[scene] if r.spec.arm.strategy == strategy and r.result]
    base = next(r for r in rows if study.variant_of_key[r.spec.key] == BASELINE)
    assert base.result is not None  # noqa: S101  (checked by the caller)
    most = base.spec.most_seeds or base.result.num_gaussians
    return _Facts(Measured(base.result.num_seeds, 0.0), most, strategy)


def _fitted(others: Sequence[tuple[_Facts, Mapping[str, float]]]) -> float:
    """The threshold that suits the other scenes best; among equals the one in use."""
    if not others:
        return ROOM

    def served(room: float) -> tuple[float, bool]:
        gains = [scores[facts.followed(scores, room)] for facts, scores in others]
        return round(fmean(gains), 6), room == ROOM

    return max(ROOMS, key=served)


def advice_table(score: AdviceScore) -> Table:
    """The advice for each scene, and its worth.

    Args:
        score: From ``score_advice``.
    """
    rows = [
        (
            words(each.scene),
            words(each.method),
            words(each.best),
            number(each.regret),
            *(number(_against(each, method), signed=True) for method in ALWAYS),
        )
        for each in score.scenes
    ]
    mean = [words("mean"), words(""), words("")]
    mean.append(number(fmean(e.regret for e in score.scenes) if score.scenes else None))
    rows.append((*mean, *(number(score.gain_over(method), signed=True) for method in ALWAYS)))
    said = (
        f"Within {CLOSE} dB of the best arm on {score.right} of {len(score.scenes)} scenes. Each "
        "scene is advised by the threshold that served the others best."
    )
    left = f"Left out for want of runs: {', '.join(score.left_out)}." if score.left_out else ""
    header = ("scene", "advice", "best arm", "missed, dB",
              *(f"gain over always {method}" for method in ALWAYS))  # fmt: skip
    return Table(
        f"advice_{score.strategy}", f"What the advice is worth, strategy {score.strategy}",
        header, tuple(rows), tuple(each for each in (said, left) if each),
    )  # fmt: skip


def _against(each: Advised, method: str) -> float | None:
    return each.psnr[each.method] - each.psnr[method] if method in each.psnr else None
