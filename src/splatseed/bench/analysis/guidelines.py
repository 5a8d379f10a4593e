"""Guidelines derived from the data: which kind of scene gains from which method.

Notation: a *guideline* relates a descriptor and a method: scenes with more of the former gain more
(or less) from the latter. Promise: every guideline comes with its rank correlation, its p value
(exact if scenes are few, adjusted after Holm over all that were considered), and with how many
scenes agree; none is called supported unless its adjusted p is at most 5%, and it is said what the
number of scenes can support at all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import permutations
from statistics import fmean

import numpy as np
from jaxtyping import Float64

from splatseed.bench.analysis.descriptors import DESCRIPTIONS, Descriptors
from splatseed.bench.analysis.gains import Gains
from splatseed.bench.analysis.statistics import LEVEL, holm
from splatseed.bench.analysis.tables import Cell, Table, number, words

EXACT = 8
"""Up to this many scenes, all orders are enumerated (40,320); beyond, t approximates well."""
FEWEST = 3
"""With two scenes every correlation is perfect."""

SCENE_NOTE = (
    "Planarity, linearity and scattering of a point's 16 nearest (Weinmann et al. 2015) and their "
    "curvature (surface variation, Pauly et al. 2002), means over the points; gap: the median "
    "spacing of points as the views see it, as a share of the image's longer side; unevenness: "
    "the standard deviation of the logarithm of spacing; empty: the share of the images' area "
    "without points; texture: the mean gradient of grey values at 320 pixels."
)
WINNER_NOTE = (
    "The best is chosen by its own scores, so its gain flatters; within noise: any other may be "
    "as good."
)


@dataclass(frozen=True)
class Guideline:
    """Scenes with more of something gain more, or less, from a method.

    Args:
        descriptor: The descriptor.
        method: The method; its gain is the mean over its variants.
        rho: Spearman's rank correlation over scenes.
        p: Its two-sided p value.
        adjusted: The same after Holm over all guidelines of the strategy.
        agree: Scenes that lie on the side of both medians that the correlation predicts.
        scenes: Number of scenes.
    """

    descriptor: str
    method: str
    rho: float
    p: float
    agree: int
    scenes: int
    adjusted: float = math.nan

    @property
    def supported(self) -> bool:
        """Whether the data supports it."""
        return self.adjusted <= LEVEL

    @property
    def sentence(self) -> str:
        """The guideline in words."""
        more = "more" if self.rho > 0 else "less"
        return f"Scenes with more {DESCRIPTIONS[self.descriptor]} gain {more} from {self.method}."


def guidelines(gained: Gains, described: Mapping[str, Descriptors]) -> tuple[Guideline, ...]:
    """All guidelines of a strategy, the likeliest first.

    Args:
        gained: The gains under the strategy.
        described: Descriptors by scene; scenes without are left out.
    """
    by_method = _by_method(gained)
    looked_at = [
        each
        for field in fields(Descriptors)
        for method, gains in by_method.items()
        if (each := _guideline(field.name, method, gains, described)) is not None
    ]
    p = holm([each.p for each in looked_at])
    known = [replace(each, adjusted=value) for each, value in zip(looked_at, p, strict=True)]
    return tuple(sorted(known, key=lambda each: (each.p, -abs(each.rho))))


def _by_method(gained: Gains) -> dict[str, dict[str, float]]:
    """Each method's gain by scene, dB: the mean over its variants that all of its scenes have."""
    methods: dict[str, dict[str, float]] = {}
    for name in dict.fromkeys(replace(v, ratio=0.0).label for v in gained.variants):
        variants = [v for v in gained.variants if replace(v, ratio=0.0).label == name]
        scenes = [s for s in gained.scenes if all((s, v) in gained.on_scene for v in variants)]
        methods[name] = {s: fmean(gained.on_scene[s, v].mean for v in variants) for s in scenes}
    return methods


def _guideline(
    descriptor: str, method: str, gains: Mapping[str, float], described: Mapping[str, Descriptors]
) -> Guideline | None:
    """The guideline of a descriptor and a method; None for too few scenes or constant values."""
    pairs = [(getattr(described[s], descriptor), gains[s]) for s in gains if s in described]
    x, y = np.array([pair for pair in pairs if not math.isnan(pair[0])]).reshape(-1, 2).T
    if len(x) < FEWEST or len(set(x)) < 2 or len(set(y)) < 2:
        return None
    rho, p = rank_correlation(x, y)
    side = np.sign(x - np.median(x)) * np.sign(y - np.median(y))
    return Guideline(descriptor, method, rho, p, int((side == np.sign(rho)).sum()), len(x))


def rank_correlation(
    x: Float64[np.ndarray, " S"], y: Float64[np.ndarray, " S"]
) -> tuple[float, float]:
    """Spearman's correlation and its two-sided p value.

    Args:
        x: One value per scene, not all equal.
        y: Another, likewise.

    Returns:
        The correlation, and how often chance gives one at least as strong: over all orders of up to
        8
        scenes, else by Student's t.
    """
    from scipy.stats import rankdata, spearmanr  # noqa: PLC0415  (slow to import)

    if len(x) > EXACT:
        result = spearmanr(x, y)
        return float(result.statistic), float(result.pvalue)
    a, b = (ranks - ranks.mean() for ranks in (rankdata(x), rankdata(y)))
    orders = np.array(list(permutations(b)))
    scale = math.sqrt(float(a @ a) * float(b @ b))
    chance = np.abs(orders @ a) / scale
    rho = float(a @ b) / scale
    return rho, float((chance >= abs(rho) - 1e-9).mean())


def fewest_scenes(comparisons: int) -> int:
    """The number of scenes from which on a perfect rank correlation can be supported at all.

    Two of all orders are perfect, and Holm's first step requires ``LEVEL`` over all comparisons.

    Args:
        comparisons: Guidelines that are looked at.
    """
    scenes = FEWEST
    while 2 / math.factorial(scenes) * max(comparisons, 1) > LEVEL:
        scenes += 1
    return scenes


def verdict(derived: Sequence[Guideline]) -> str:
    """The conclusion, in a sentence or two.

    Args:
        derived: All guidelines of a strategy.
    """
    if not derived:
        return (
            f"No guideline can be looked for: that takes at least {FEWEST} scenes with gains and "
            "with descriptors."
        )
    scenes = max(each.scenes for each in derived)
    supported = [each for each in derived if each.supported]
    if supported:
        said = " ".join(each.sentence for each in supported)
        return f"Supported by {scenes} scenes, after {len(derived)} were looked at: {said}"
    fewest = fewest_scenes(len(derived))
    why = (
        f" It could hardly be otherwise: with {len(derived)} of them looked at, even a perfect "
        f"order of scenes is evidence only from {fewest} scenes on, and here there are {scenes}."
        if scenes < fewest
        else ""
    )
    return f"The data of these {scenes} scenes supports no guideline.{why}"


def guideline_table(derived: Sequence[Guideline], strategy: str, most: int = 10) -> Table:
    """The likeliest guidelines with their evidence.

    Args:
        derived: All guidelines of the strategy, likeliest first.
        strategy: The strategy.
        most: How many to list.
    """
    rows = tuple(
        (
            words(each.sentence),
            words(f"{each.agree} of {each.scenes}"),
            number(each.rho, 2, signed=True),
            number(each.p, 3),
            number(each.adjusted, 3),
            words("yes" if each.supported else "no", bold=each.supported),
        )
        for each in derived[:most]
    )
    note = (
        f"The {len(rows)} likeliest of {len(derived)} that were looked at (each descriptor with "
        "each method, whose gain is the mean over its ratios). Scenes agree when they are on the "
        "same side of both medians as the correlation says. p is of Spearman's rank correlation, "
        f"exact up to {EXACT} scenes; supported is what is at most 5% after Holm."
    )
    return Table(
        f"guidelines_{strategy}",
        f"Guidelines, strategy {strategy}",
        ("guideline", "scenes that agree", "rho", "p", "p after Holm", "supported"),
        rows,
        (verdict(derived), note),
    )


def scene_table(described: Mapping[str, Descriptors]) -> Table:
    """The descriptors of all scenes.

    Args:
        described: By scene.
    """
    rows = tuple(
        (words(scene), *(number(getattr(each, field.name), 4) for field in fields(Descriptors)))
        for scene, each in sorted(described.items())
    )
    return Table(
        "descriptors",
        "What kind of scene it is",
        ("scene", *(field.name for field in fields(Descriptors))),
        rows,
        (SCENE_NOTE,),
    )


def winner_table(gained: Gains, described: Mapping[str, Descriptors]) -> Table:
    """Which method won on each scene, beside what kind of scene it is.

    Args:
        gained: The gains under the strategy.
        described: Descriptors by scene.
    """
    rows = []
    for scene in gained.scenes:
        best = gained.best(scene)
        gain = None if best is None else gained.on_scene[scene, best]
        won = "sfm" if best is None else best.label
        sure = "" if gain is None else gain.verdict.replace("unknown", "1 run")
        kind = described.get(scene)
        values = [math.nan if kind is None else getattr(kind, f.name) for f in fields(Descriptors)]
        mean = Cell() if gain is None else Cell(gain.mean, gain.se, 3, signed=True)
        rows.append((words(scene), words(won), mean, words(sure), *(number(v, 3) for v in values)))
    return Table(
        f"winners_{gained.strategy}",
        f"What gained most on each scene, strategy {gained.strategy}",
        (
            "scene",
            "best",
            "gain over sfm, dB",
            "verdict",
            *(field.name for field in fields(Descriptors)),
        ),
        tuple(rows),
        (WINNER_NOTE,),
    )
