"""Test whether differences exceed the noise.

Notation: ``values`` [A, R] are one scene's scores, arm by repeat, NaN where there is no run; row 0
is the baseline. A *difference* is between two arms, paired by repeat. Its mean is tested on one
scene (``paired_differences``), on the same scenes trained again (``these_scenes``), and on scenes
like these (``over_scenes``).

p values are two-sided, and adjusted over a family of comparisons after Holm (1979), which bounds
the chance of any false claim in the family. An unknown p is NaN, and makes no claim.
``Difference.verdict`` is the one rule of significance: marks in tables, intervals in figures and
sentences of the report follow from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64
from scipy.special import stdtr, stdtrit  # of scipy.stats.t, which takes 40 times as long

from splatseed.text import counted

LEVEL = 0.05
"""A difference is a claim when its adjusted p is at most this."""
EXACT = 1e-9
"""Standard errors below this are rounding errors of equal runs."""
MIN_DF = 3
"""Degrees of freedom from which anything is claimed, a difference or noise. Of 2, the standard
deviation is known to within a factor of 12 (95% interval: 0.5 to 6.3 times the estimate), of 3 to
within 7."""

Verdict = Literal["better", "worse", "within noise", "too few to tell"]
Unit = Literal["repeat", "scene"]


@dataclass(frozen=True)
class Difference:
    """A mean difference and its significance.

    Args:
        mean: In the unit of the scores.
        se: Standard error of the mean; NaN for one sample.
        df: Degrees of freedom of the standard error.
        n: Repeats or scenes that the mean is over.
        p: Two-sided p value of a mean of 0; NaN if unknown.
        adjusted: The p value after Holm's adjustment over its family.
        unit: What ``n`` counts, and what the standard error is between.
    """

    mean: float
    se: float
    df: float
    n: int
    p: float
    adjusted: float = math.nan
    unit: Unit = "repeat"

    @property
    def verdict(self) -> Verdict:
        """The rule of significance: a claim if the adjusted p is at most ``LEVEL``, else noise.

        With fewer than ``MIN_DF`` degrees of freedom, repeats or scenes are too few to tell.
        """
        if self.df < MIN_DF or math.isnan(self.adjusted):
            return "too few to tell"
        if self.adjusted > LEVEL:
            return "within noise"
        return "better" if self.mean > 0 else "worse"

    @property
    def caveat(self) -> str:
        """The verdict in parentheses, to follow the mean in a sentence; empty for a claim."""
        return {
            "within noise": f" (within the noise between {self.unit}s)",
            "too few to tell": f" ({counted(self.n, self.unit)}: too few to tell)",
        }.get(self.verdict, "")

    def interval(self) -> tuple[float, float]:
        """The interval of the mean that excludes 0 exactly if the difference is a claim.

        This is the confidence interval at 1 - ``LEVEL``, widened by the ratio of the adjusted p to
        p; NaN if there are too few samples to tell.
        """
        level = LEVEL
        if not math.isnan(self.adjusted):
            level *= self.p / self.adjusted if self.adjusted > 0 else 1.0
            if self.verdict == "too few to tell":
                return math.nan, math.nan
        if math.isnan(self.se):
            return math.nan, math.nan
        half = -float(stdtrit(self.df, level / 2)) * self.se if self.se > EXACT else 0.0
        return self.mean - half, self.mean + half


def difference(mean: float, se: float, df: float, n: int, unit: Unit = "repeat") -> Difference:
    """Make a difference with the p value of its t statistic.

    Args:
        mean: The mean.
        se: Its standard error; NaN if unknown.
        df: Degrees of freedom of the standard error.
        n: Repeats or scenes behind the mean.
        unit: What ``n`` counts.
    """
    if math.isnan(se) or df <= 0:
        return Difference(mean, math.nan, 0.0, n, math.nan, unit=unit)
    if se <= EXACT:  # no noise
        return Difference(mean, 0.0, df, n, 1.0 if abs(mean) <= EXACT else 0.0, unit=unit)
    return Difference(mean, se, df, n, float(2 * stdtr(df, -abs(mean) / se)), unit=unit)


def paired_differences(values: Float[np.ndarray, "A R"]) -> tuple[Difference | None, ...]:
    """Compute the gain of each arm of a scene over row 0, the mean of paired differences.

    For two arms this is the paired t-test; more arms improve the estimate of the noise.

    Args:
        values: Scores by arm and repeat, NaN where there is no run, [A, R].

    Returns:
        A difference for each of rows 1 to A - 1, None without a repeat in common with row 0.
        ``p`` is not adjusted.
    """
    noise, df = pooled_noise(values)
    return tuple(_paired(row - values[0], noise, df) for row in values[1:])


def _paired(differences: Float[np.ndarray, " R"], noise: float, df: float) -> Difference | None:
    known = differences[np.isfinite(differences)]
    if not len(known):
        return None
    return difference(float(known.mean()), noise * math.sqrt(2 / len(known)), df, len(known))


def pooled_noise(values: Float[np.ndarray, "A R"]) -> tuple[float, int]:
    """Estimate the noise of a score from all arms of a scene, which share it.

    Two or three repeats of a pair of arms would determine it poorly. It is the residual after
    fitting a mean per arm and per repeat (analysis of variance of a randomised block design;
    Montgomery, Design and Analysis of Experiments, ch. 4). The estimate assumes that all arms are
    equally noisy: of six, one with twice the noise of the others is falsely claimed in 12% of tests
    rather than 5%, the others in 3%.

    Args:
        values: Scores by arm and repeat, NaN where there is no run, [A, R].

    Returns:
        The standard deviation, NaN without degrees of freedom; and the degrees of freedom.
    """
    arm, repeat = np.nonzero(np.isfinite(values))
    design = np.hstack([np.eye(values.shape[0])[arm], np.eye(values.shape[1])[repeat]])
    scores = values[arm, repeat]
    if not len(scores):
        return math.nan, 0
    level = scores.mean()  # subtracted so that rounding stays far below the noise
    fit, _, rank, _ = np.linalg.lstsq(design, scores - level, rcond=None)
    df = len(scores) - int(rank)
    if df == 0:
        return math.nan, 0
    rest = scores - level - design @ fit
    return math.sqrt(float(rest @ rest) / df), df


def these_scenes(scenes: Sequence[Difference]) -> Difference:
    """Average differences over scenes, with the noise of training the same scenes again.

    Args:
        scenes: A difference per scene, at least one.
    """
    mean = float(np.mean([scene.mean for scene in scenes]))
    variance = np.array([scene.se**2 for scene in scenes])
    total = variance.sum()
    n = max(scene.n for scene in scenes)
    if math.isnan(total):
        return difference(mean, math.nan, 0, n)
    freedom = np.array([scene.df for scene in scenes])
    # Welch-Satterthwaite; without noise, the sum of the degrees of freedom.
    df = float(total**2 / (variance**2 / freedom).sum()) if total > 0 else float(freedom.sum())
    return difference(mean, math.sqrt(total) / len(scenes), df, n)


def over_scenes(
    means: Sequence[float] | Float64[np.ndarray, " S"], unit: Unit = "scene"
) -> Difference:
    """Average differences over scenes, with the error for scenes like these: a one-sample t-test.

    The samples are scenes, not runs, as the repeats of a scene are not independent.

    Args:
        means: The mean difference of each scene over its repeats, [S], at least one; or the
            differences of each repeat of a single scene.
        unit: Which of both.
    """
    values = np.asarray(means, np.float64)
    n = len(values)
    se = float(values.std(ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return difference(float(values.mean()), se, n - 1, n, unit)


def holm(p: Sequence[float]) -> tuple[float, ...]:
    """Adjust p values for their number after Holm; NaN are kept, and not counted.

    Args:
        p: The p values of a family.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        (0.03, 0.06, 0.06)
    """
    result = [math.nan] * len(p)
    known = sorted((value, i) for i, value in enumerate(p) if not math.isnan(value))
    minimum = 0.0
    for rank, (value, i) in enumerate(known):
        minimum = max(minimum, min(1.0, (len(known) - rank) * value))
        result[i] = minimum
    return tuple(result)


def adjusted(family: Sequence[Difference | None]) -> tuple[Difference | None, ...]:
    """Adjust the p values of a family after Holm.

    Args:
        family: All differences of one table; None for missing ones.
    """
    p = holm([math.nan if member is None else member.p for member in family])
    return tuple(
        None if member is None else replace(member, adjusted=value)
        for member, value in zip(family, p, strict=True)
    )
