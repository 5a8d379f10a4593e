"""Two benchmarks: their settings, what changed, and whether that is more than noise.

Notation: the change of an arm on a scene is its mean PSNR in B less that in A, dB. Promise: runs of
two ledgers are not paired, as a seed need not mean the same in another version: the noise of each
ledger is taken from what its own repeats do (of all arms of a scene together), and the test is
Welch's, adjusted after Holm over all changes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatseed.bench.analysis.statistics import Difference, adjusted, difference, these_scenes
from splatseed.bench.analysis.study import Cell as Runs, Study, Variant, studies
from splatseed.bench.analysis.tables import Cell, Table, words
from splatseed.bench.planning.records import RunRow
from splatseed.train.settings import StrategyName

Arm = tuple[StrategyName, Variant]
Place = tuple[StrategyName, str, Variant]


@dataclass(frozen=True)
class Change:
    """How an arm's score changed from A to B.

    Args:
        arm: Strategy and variant.
        scene: The scene; empty for the mean over all that both have.
        difference: B less A, dB; adjusted over all changes of scenes, or of means.
    """

    arm: Arm
    scene: str
    difference: Difference


@dataclass(frozen=True)
class Comparison:
    """The comparison of two ledgers.

    Args:
        settings: Settings that differ, with A's value and B's.
        changes: The change of each arm on each scene that both have.
        means: The mean change of each arm over the scenes that both have.
        only_a: Arms on scenes that only A has.
        only_b: Likewise for B.
        same_runs: Runs that are in both ledgers, with the same key and the same PSNR.
        content: Scenes of the same name whose files differ.
    """

    settings: tuple[tuple[str, str, str], ...]
    changes: tuple[Change, ...]
    means: tuple[Change, ...]
    only_a: tuple[Place, ...]
    only_b: tuple[Place, ...]
    same_runs: int
    content: tuple[str, ...]


def compare(a: Sequence[RunRow], b: Sequence[RunRow]) -> Comparison | None:
    """Compare two ledgers: from each, the set of runs whose settings differ least.

    Args:
        a: The rows of the first.
        b: The rows of the second.

    Returns:
        None if one of them has no finished run.
    """
    chosen = _closest(studies(a), studies(b))
    if chosen is None:
        return None
    first, second = chosen
    shared = sorted(first.cells.keys() & second.cells.keys(), key=_order)
    changes = [Change((s, v), scene, _change(first, second, s, scene, v)) for s, scene, v in shared]
    arms = list(dict.fromkeys(change.arm for change in changes))
    means = [
        Change(arm, "", these_scenes([c.difference for c in changes if c.arm == arm]))
        for arm in arms
    ]
    return Comparison(
        settings=_differing(first.settings, second.settings),
        changes=_adjusted(changes),
        means=_adjusted(means),
        only_a=tuple(sorted(first.cells.keys() - second.cells.keys(), key=_order)),
        only_b=tuple(sorted(second.cells.keys() - first.cells.keys(), key=_order)),
        same_runs=len(_scores(a).items() & _scores(b).items()),
        content=_changed_content(first, second),
    )


def _closest(a: Sequence[Study], b: Sequence[Study]) -> tuple[Study, Study] | None:
    """The pair of studies with the fewest differing settings; among equals, with most in common."""
    pairs = [(one, other) for one in a for other in b]
    return min(
        pairs,
        key=lambda pair: (
            len(_differing(pair[0].settings, pair[1].settings)),
            -len(pair[0].cells.keys() & pair[1].cells.keys()),
        ),
        default=None,
    )


def _differing(
    a: Mapping[str, object], b: Mapping[str, object]
) -> tuple[tuple[str, str, str], ...]:
    names = dict.fromkeys([*a, *b])
    return tuple((n, str(a.get(n)), str(b.get(n))) for n in names if a.get(n) != b.get(n))


def _order(place: Place) -> tuple[object, ...]:
    strategy, scene, variant = place
    return strategy, variant.order, scene


def _change(a: Study, b: Study, strategy: StrategyName, scene: str, variant: Variant) -> Difference:
    """B less A, by Welch's test with each ledger's own noise."""
    means: list[float] = []
    errors: list[float] = []
    freedoms: list[int] = []
    count = 0
    for study in (a, b):
        runs = study.cell(strategy, scene, variant)
        deviation, df = _noise(study, strategy, scene)
        means.append(_mean(runs))
        errors.append(deviation**2 / len(runs))
        freedoms.append(df)
        count += len(runs)
    total = sum(errors)
    if math.isnan(total):
        return difference(means[1] - means[0], math.nan, 0, count)
    weights = [error**2 / df for error, df in zip(errors, freedoms, strict=True)]
    freedom = total**2 / sum(weights) if total > 0 else float(sum(freedoms))
    return difference(means[1] - means[0], math.sqrt(total), freedom, count)


def _mean(runs: Runs) -> float:
    return float(np.mean([result.psnr for result in runs.values()]))


def _noise(study: Study, strategy: StrategyName, scene: str) -> tuple[float, int]:
    """Standard deviation of a run about its arm's mean on a scene, of all arms together."""
    squares, df = 0.0, 0
    for (used, where, _), runs in study.cells.items():
        if (used, where) == (strategy, scene):
            values = np.array([result.psnr for result in runs.values()])
            squares += float(((values - values.mean()) ** 2).sum())
            df += len(values) - 1
    return (math.sqrt(squares / df), df) if df else (math.nan, 0)


def _adjusted(changes: Sequence[Change]) -> tuple[Change, ...]:
    known = adjusted([change.difference for change in changes])
    return tuple(
        Change(change.arm, change.scene, each)
        for change, each in zip(changes, known, strict=True)
        if each is not None
    )


def _scores(rows: Sequence[RunRow]) -> dict[str, float]:
    return {row.spec.key: row.result.psnr for row in rows if row.result is not None}


def _changed_content(a: Study, b: Study) -> tuple[str, ...]:
    digests = [{s: rows[0].spec.scene_digest for s, rows in each.rows.items()} for each in (a, b)]
    first, second = digests
    return tuple(sorted(s for s in first.keys() & second.keys() if first[s] != second[s]))


def settings_table(comparison: Comparison) -> Table:
    """The settings that differ.

    Args:
        comparison: The comparison.
    """
    rows = tuple(tuple(words(each) for each in row) for row in comparison.settings)
    return Table("settings", "Settings that differ", ("setting", "A", "B"), rows)


def change_table(comparison: Comparison) -> Table:
    """All changes: a row per arm, a column per scene, the mean last.

    Args:
        comparison: The comparison.
    """
    scenes = sorted({change.scene for change in comparison.changes})
    by_place = {(change.arm, change.scene): change.difference for change in comparison.changes}
    rows = tuple(
        (
            words(mean.arm[0]),
            words(mean.arm[1].label),
            *(_cell(by_place.get((mean.arm, scene))) for scene in scenes),
            _cell(mean.difference),
        )
        for mean in comparison.means
    )
    note = (
        "PSNR in B less that in A, dB ± standard error. *: more than noise (Welch's test, "
        "Holm-corrected over all changes on scenes, and over all means); ~: within noise. (1 "
        "run): nothing is known of the noise."
    )
    return Table(
        "changes", "Changes from A to B", ("strategy", "method", *scenes, "mean"), rows, (note,)
    )


def _cell(change: Difference | None) -> Cell:
    if change is None:
        return Cell()
    verdict = change.verdict
    return Cell(
        change.mean,
        change.se,
        3,
        signed=True,
        mark={"within noise": "~", "unknown": ""}.get(verdict, "*"),
        text="(1 run)" if verdict == "unknown" else "",
        bold=verdict in {"better", "worse"},
    )


def only_table(comparison: Comparison) -> Table:
    """What only one of the ledgers has.

    Args:
        comparison: The comparison.
    """
    rows = [("A", place) for place in comparison.only_a] + [
        ("B", place) for place in comparison.only_b
    ]
    return Table(
        "only_one",
        "What only one of them has",
        ("in", "strategy", "scene", "method"),
        tuple(
            (words(name), words(strategy), words(scene), words(variant.label))
            for name, (strategy, scene, variant) in rows
        ),
    )
