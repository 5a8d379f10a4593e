"""What every variant gains over the original cloud, and how certain that is.

Notation: a gain is PSNR of a variant less that of the baseline, dB, paired by scene and repeat.
Promise: the p values of one strategy's gains are adjusted together: those on single scenes as one
family, those over scenes as another; see ``splatseed.bench.analysis.statistics``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from jaxtyping import Float64

from splatseed.bench.analysis.statistics import (
    LEVEL,
    Difference,
    adjusted,
    over_scenes,
    paired_differences,
    pooled_noise,
    these_scenes,
)
from splatseed.bench.analysis.study import BASELINE, Study, Variant
from splatseed.train.settings import StrategyName

Key = TypeVar("Key")


@dataclass(frozen=True)
class Gains:
    """The gains under one strategy.

    Args:
        strategy: The strategy.
        scenes: Scenes on which anything can be compared.
        variants: Variants that can be compared on some scene.
        on_scene: By scene and variant; absent where no repeat has both.
        on_these: By variant: the mean over its scenes, for these scenes alone.
        on_like: By variant: the same mean, for scenes like these.
    """

    strategy: StrategyName
    scenes: tuple[str, ...]
    variants: tuple[Variant, ...]
    on_scene: Mapping[tuple[str, Variant], Difference]
    on_these: Mapping[Variant, Difference]
    on_like: Mapping[Variant, Difference]

    def top(self, scene: str) -> Variant | None:
        """The variant with the greatest gain, or the least loss, on a scene, ignoring noise."""
        means = {
            v: self.on_scene[scene, v].mean for v in self.variants if (scene, v) in self.on_scene
        }
        return max(means, key=lambda each: means[each], default=None)

    def best(self, scene: str) -> Variant | None:
        """The variant that gains most on a scene, or None if none gains, ignoring noise."""
        top = self.top(scene)
        return top if top is not None and self.on_scene[scene, top].mean > 0 else None

    def means(self) -> dict[str, dict[Variant, float]]:
        """Mean gains by scene and variant."""
        by_scene: dict[str, dict[Variant, float]] = {scene: {} for scene in self.scenes}
        for (scene, variant), each in self.on_scene.items():
            by_scene[scene][variant] = each.mean
        return by_scene


@dataclass(frozen=True)
class MeanGains:
    """Three mean gains over scenes that are easily mistaken for one another; dB.

    Args:
        over_all: Of all variants together: the gain of a variant picked blindly.
        best: The variant that gains most on average.
        over_best: Its mean gain; slightly optimistic, as it was chosen by the same scores.
        per_scene: The best variant of each scene, chosen by the test views it is scored on: not a
            gain that anybody can have.
        num_scenes: Scenes in the means.
        num_variants: Variants in the means: those that every scene has.
    """

    over_all: float
    best: str
    over_best: float
    per_scene: float
    num_scenes: int
    num_variants: int


def scores(
    study: Study, strategy: StrategyName, scene: str
) -> tuple[tuple[Variant, ...], Float64[np.ndarray, "A R"]]:
    """PSNR in dB of a scene by arm and repeat, NaN if there is no run; the baseline first.

    Args:
        study: The study.
        strategy: The strategy.
        scene: The scene.
    """
    arms = (BASELINE, *study.variants_of(strategy))
    cells = [study.cell(strategy, scene, arm) for arm in arms]
    repeats = sorted({repeat for cell in cells for repeat in cell})
    values = [[cell[r].psnr if r in cell else math.nan for r in repeats] for cell in cells]
    return arms, np.array(values, np.float64).reshape(len(arms), len(repeats))


def gains(study: Study, strategy: StrategyName) -> Gains:
    """The gains under a strategy.

    Args:
        study: The study.
        strategy: One of its strategies.
    """
    on_scene: dict[tuple[str, Variant], Difference] = {}
    for scene in study.scenes_of(strategy):
        arms, values = scores(study, strategy, scene)
        for variant, each in zip(arms[1:], paired_differences(values), strict=True):
            if each is not None:
                on_scene[scene, variant] = each
    scenes = tuple(s for s in study.scenes if any(s == scene for scene, _ in on_scene))
    variants = tuple(v for v in study.variants if any(v == variant for _, variant in on_scene))
    by_variant = {v: [each for (_, of), each in on_scene.items() if of == v] for v in variants}
    return Gains(
        strategy,
        scenes,
        variants,
        _adjusted(on_scene),
        _adjusted({v: these_scenes(each) for v, each in by_variant.items()}),
        _adjusted({v: over_scenes([one.mean for one in each]) for v, each in by_variant.items()}),
    )


def _adjusted(family: Mapping[Key, Difference]) -> dict[Key, Difference]:
    known = adjusted(list(family.values()))
    return {key: each for key, each in zip(family, known, strict=True) if each is not None}


def clear_best(study: Study, strategy: StrategyName, scene: str) -> bool:
    """Whether a scene's best arm is better than each other one, the second included, beyond noise.

    Args:
        study: The study.
        strategy: The strategy.
        scene: The scene.
    """
    from scipy.stats import t  # noqa: PLC0415  (slow to import)

    _, values = scores(study, strategy, scene)
    noise, df = pooled_noise(values)
    values = values[np.isfinite(values).all(axis=1)]
    if math.isnan(noise) or len(values) < 2:
        return False
    low, high = np.sort(values.mean(axis=1))[-2:]
    se = max(noise * math.sqrt(2 / values.shape[1]), np.finfo(float).tiny)
    # Holm's smallest step: the second is one of all the others.
    return float(2 * t.sf((high - low) / se, df)) * (len(values) - 1) <= LEVEL


def mean_gains(by_scene: Mapping[str, Mapping[Variant, float]]) -> MeanGains | None:
    """The three means of gains.

    Args:
        by_scene: Gains in dB by scene and variant. Variants that some scene lacks are left out.

    Returns:
        None where no variant is left.
    """
    if not by_scene:
        return None
    everywhere = set.intersection(*(set(each) for each in by_scene.values()))
    variants = sorted(everywhere, key=lambda each: each.order)
    if not variants:
        return None
    table = np.array([[row[variant] for variant in variants] for row in by_scene.values()])
    means = table.mean(axis=0)
    best = int(means.argmax())
    return MeanGains(
        float(means.mean()),
        variants[best].label,
        float(means[best]),
        float(table.max(axis=1).mean()),
        *table.shape,
    )
