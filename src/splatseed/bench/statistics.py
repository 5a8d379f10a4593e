"""Whether a difference is more than noise.

Notation: ``values`` [A, R] are one scene's scores, arm by repeat, NaN where there is no run; row 0
is the baseline. A *difference* is between two arms, paired by repeat. Three means of differences
answer three questions: on one scene (``paired_differences``), on these scenes if trained again
(``these_scenes``), and on scenes like these (``over_scenes``).

Promise: p values are two-sided; over a family of comparisons they are adjusted after Holm (1979),
which bounds the chance of any false claim in it; where nothing can be said, p is NaN and no claim
is made.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Float64

LEVEL = 0.05
"""A difference is a claim when its adjusted p is at most this."""
EXACT = 1e-9
"""Standard errors below this are rounding: the runs are equal bit for bit."""

Verdict = Literal["better", "worse", "within noise", "unknown"]


@dataclass(frozen=True)
class Difference:
    """A mean difference and how sure it is.

    Args:
        mean: In the unit of the scores.
        se: Standard error of the mean; NaN where one sample leaves it unknown.
        df: Degrees of freedom of the standard error.
        n: Samples that the mean is over: pairs of runs, or scenes.
        p: Two-sided p value of a mean of 0; NaN where unknown.
        adjusted: The same after Holm over the family that it was tested in.
    """

    mean: float
    se: float
    df: float
    n: int
    p: float
    adjusted: float = math.nan

    @property
    def verdict(self) -> Verdict:
        """What may be claimed, at ``LEVEL`` of the adjusted p."""
        if math.isnan(self.adjusted):
            return "unknown"
        if self.adjusted > LEVEL:
            return "within noise"
        return "better" if self.mean > 0 else "worse"

    def interval(self, level: float = 1 - LEVEL) -> tuple[float, float]:
        """Confidence interval of the mean, not adjusted; NaN where unknown.

        Args:
            level: The share of such intervals that hold the true mean.
        """
        from scipy.stats import t  # noqa: PLC0415  (slow to import)

        if math.isnan(self.se):
            return math.nan, math.nan
        half = float(t.ppf((1 + level) / 2, self.df)) * self.se if self.se > EXACT else 0.0
        return self.mean - half, self.mean + half


def difference(mean: float, se: float, df: float, n: int) -> Difference:
    """A difference with the p value of its t statistic.

    Args:
        mean: The mean.
        se: Its standard error; NaN where unknown.
        df: Degrees of freedom of the standard error.
        n: Samples behind the mean.
    """
    from scipy.stats import t  # noqa: PLC0415  (slow to import)

    if math.isnan(se) or df <= 0:
        return Difference(mean, math.nan, 0.0, n, math.nan)
    if se <= EXACT:  # no noise at all: a difference is there or it is not
        return Difference(mean, 0.0, df, n, 1.0 if abs(mean) <= EXACT else 0.0)
    return Difference(mean, se, df, n, float(2 * t.sf(abs(mean) / se, df)))


def paired_differences(values: Float[np.ndarray, "A R"]) -> tuple[Difference | None, ...]:
    """What each arm of a scene gains over row 0: the mean over repeats of paired differences.

    For two arms this is the paired t-test; with more, all of them tell of the noise.

    Args:
        values: Scores by arm and repeat, NaN where there is no run, [A, R].

    Returns:
        One for each of rows 1 to A - 1; None where it and row 0 have no repeat in common. ``p`` is
        not adjusted yet.
    """
    noise, df = pooled_noise(values)
    return tuple(_paired(row - values[0], noise, df) for row in values[1:])


def _paired(differences: Float[np.ndarray, " R"], noise: float, df: float) -> Difference | None:
    known = differences[np.isfinite(differences)]
    if not len(known):
        return None
    return difference(float(known.mean()), noise * math.sqrt(2 / len(known)), df, len(known))


def pooled_noise(values: Float[np.ndarray, "A R"]) -> tuple[float, int]:
    """Standard deviation of a score about its arm's and its repeat's mean, and degrees of freedom.

    With two or three repeats a pair of arms alone says little about the noise, so it is estimated
    from all arms of the scene together: what is left when every arm and every repeat has its own
    mean (the analysis of variance of a randomised block design; Montgomery, Design and Analysis of
    Experiments, ch. 4). That assumes that all arms are equally noisy: of six, one at twice the
    noise of the rest is falsely claimed in 12% of tests rather than 5, the others in 3%.

    Args:
        values: Scores by arm and repeat, NaN where there is no run, [A, R].

    Returns:
        The deviation, NaN where there are no degrees of freedom, and these.
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
    """The mean of differences on several scenes: what training again on the same scenes gives.

    Its noise is the scenes' own, added up.

    Args:
        scenes: One per scene, at least one.
    """
    mean = float(np.mean([each.mean for each in scenes]))
    variance = np.array([each.se**2 for each in scenes])
    total = variance.sum()
    n = sum(each.n for each in scenes)
    if math.isnan(total):
        return difference(mean, math.nan, 0, n)
    freedom = np.array([each.df for each in scenes])
    # Welch-Satterthwaite; without any noise the degrees of freedom are the scenes' own, added up.
    df = float(total**2 / (variance**2 / freedom).sum()) if total > 0 else float(freedom.sum())
    return difference(mean, math.sqrt(total) / len(scenes), df, n)


def over_scenes(means: Sequence[float] | Float64[np.ndarray, " S"]) -> Difference:
    """The mean of differences over scenes, for scenes like these: a one-sample t-test.

    Repeats of one scene are not independent evidence about another: counting every run as a sample
    would find gains that are not there. So repeats are averaged within a scene first.

    Args:
        means: Each scene's mean difference over its repeats, [S], at least one.
    """
    values = np.asarray(means, np.float64)
    n = len(values)
    se = float(values.std(ddof=1)) / math.sqrt(n) if n > 1 else math.nan
    return difference(float(values.mean()), se, n - 1, n)


def holm(p: Sequence[float]) -> tuple[float, ...]:
    """Holm's adjustment of p values for their number; NaN stay so and do not count.

    Args:
        p: The p values of a family.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        (0.03, 0.06, 0.06)
    """
    result = [math.nan] * len(p)
    known = sorted((value, i) for i, value in enumerate(p) if not math.isnan(value))
    least = 0.0
    for rank, (value, i) in enumerate(known):
        least = max(least, min(1.0, (len(known) - rank) * value))
        result[i] = least
    return tuple(result)


def adjusted(family: Sequence[Difference | None]) -> tuple[Difference | None, ...]:
    """The differences of a family with their p values adjusted after Holm.

    Args:
        family: All that is compared in one table; None where there is nothing to compare.
    """
    p = holm([math.nan if each is None else each.p for each in family])
    return tuple(
        None if each is None else replace(each, adjusted=value)
        for each, value in zip(family, p, strict=True)
    )
