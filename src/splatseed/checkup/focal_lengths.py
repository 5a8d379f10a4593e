"""Focal lengths that are wrong for some of several cameras, or by a few per cent for all.

The cameras of a capture are compared in groups (``camera_groups``). A group of whose points
photographs confirm far fewer than of others is searched for the factor of its own focal lengths, by
pairs of its photographs as far as there are any. What is left is measured by ``intrinsics_error``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatseed.checkup.consistency import Evidence, Fit, Hypothesis, PairFit
from splatseed.checkup.hypotheses import SEARCH, is_better
from splatseed.checkup.intrinsics_error import IntrinsicsError, estimate_intrinsics_error
from splatseed.findings import Finding
from splatseed.sampling import evenly_spaced
from splatseed.scene import Image
from splatseed.text import counted

WRONG_FOCAL_LENGTH = "wrong-focal-length"


@dataclass(frozen=True)
class _Settings:
    """How groups are compared, and which factors are named."""

    max_groups: int = 6
    same_focal: float = 1.03
    """Ratio of focal lengths up to which cameras of many are one group."""
    low_share: float = 0.5
    """Share of a group's points, as a fraction of the best group's, below which it is searched."""
    photographs: int = 4
    partners: int = 2
    points: int = 24
    """Photographs of a group, their partners, and points of a pair, in a search."""
    min_pairs: int = 3
    """Pairs of a group below which more are compared."""
    min_error: float = 0.025
    """Relative error of a focal length that is named."""
    min_deviations: float = 8.0
    """Standard deviations of such an error."""
    max_miss: float = 0.8
    """Miss that may be left, as a share of that before."""
    rounds: int = 3


FOCAL = _Settings()


def camera_groups(images: Sequence[Image]) -> list[int]:
    """For each image the group of its camera, from 0, in order of appearance.

    A group is a camera; of many cameras, as of a capture with intrinsics for each frame, those of
    nearly the same focal length, in image widths; all, if these are many, too.
    """
    keys = [image.intrinsics.camera_id for image in images]
    if len(set(keys)) > FOCAL.max_groups:
        focal = np.array([image.intrinsics.K[0, 0] / image.intrinsics.width for image in images])
        order = np.argsort(focal, kind="stable")
        steps = focal[order][1:] > FOCAL.same_focal * focal[order][:-1]
        clusters = np.zeros(len(images), np.int64)
        clusters[order[1:]] = np.cumsum(steps)
        keys = clusters.tolist()
    first = list(dict.fromkeys(keys))
    return [first.index(key) if len(first) <= FOCAL.max_groups else 0 for key in keys]


@dataclass(frozen=True, eq=False)
class FoundFactors:
    """Factors of the focal lengths of groups of cameras that fit better than what was given."""

    factors: dict[int, float]  # by group, of the given focal lengths
    before: Fit
    after: Fit  # of the same pairs
    miss_before: float  # px that points far from the centre miss their places by
    miss_after: float


def find_focal_factors(
    evidence: Evidence, fit: Fit, start: Hypothesis, groups: Sequence[int]
) -> FoundFactors | None:
    """Find focal lengths that are wrong for some groups, or a few per cent off; None without any.

    Args:
        evidence: Of the capture.
        fit: How points fit under ``start``.
        start: The capture as it is, or with another focal length for all.
        groups: Of the evidence's images, as ``camera_groups`` has them.
    """
    fit = _with_all_groups(evidence, fit, start, groups)
    compared = [(pair.first, pair.second) for pair in fit.pairs]
    factors = dict.fromkeys(groups, 1.0)
    for group in _low_groups(fit, groups):
        members = [i for i, each in enumerate(groups) if each == group]
        pairs = _own_pairs(evidence, members)
        factors[group] = search_factor(evidence, start, members, pairs) or 1.0
    searched = any(factor != 1.0 for factor in factors.values())
    before = estimate_intrinsics_error(evidence, fit, start, groups)
    after, fitted = before, fit
    for _ in range(FOCAL.rounds):
        if any(factor != 1.0 for factor in factors.values()):
            hypothesis = replace(start, view_factors={i: factors[g] for i, g in enumerate(groups)})
            fitted = evidence.fit(hypothesis, compared=compared)
            after = estimate_intrinsics_error(evidence, fitted, hypothesis, groups)
        corrections = _corrections(after)
        if not corrections:
            break
        factors |= {group: factors[group] * each for group, each in corrections.items()}
    else:
        return None  # it does not converge: something else is wrong
    nearer = searched or after.miss <= FOCAL.max_miss * before.miss
    if fitted is fit or fitted.support < fit.support or not nearer:
        return None
    factors = {group: each * start.focal_factor for group, each in factors.items()}
    if start is not evidence.given:
        fit = evidence.fit(evidence.given, compared=compared)
    return FoundFactors(factors, fit, fitted, before.miss, after.miss)


def _corrections(error: IntrinsicsError) -> dict[int, float]:
    """Factors of the focal lengths of groups that are clearly off."""
    clear = np.abs(error.focal) >= FOCAL.min_deviations * error.focal_sigma
    clear &= np.abs(error.focal) >= FOCAL.min_error
    return {int(group): float(1 + error.focal[group]) for group in np.flatnonzero(clear)}


def search_factor(
    evidence: Evidence,
    start: Hypothesis,
    members: Sequence[int],
    compared: Sequence[tuple[int, int]],
) -> float | None:
    """Find the factor of the focal lengths of some views that fits better; None without any.

    Args:
        evidence: Of the capture.
        start: What else is assumed.
        members: The views.
        compared: Pairs in which they take part.
    """

    def fit(factor: float) -> Fit:
        hypothesis = replace(start, view_factors=dict.fromkeys(members, factor))
        return evidence.fit(hypothesis, points=FOCAL.points, compared=compared)

    fits = {factor: fit(factor) for factor in SEARCH.all_factors}
    best = max(fits, key=lambda factor: fits[factor].score)
    if not is_better(fits[best], fit(1.0)):
        return None
    groups = [int(i in members) for i in range(len(evidence.images))]
    hypothesis = replace(start, view_factors=dict.fromkeys(members, best))
    error = estimate_intrinsics_error(evidence, fits[best], hypothesis, groups)
    near = np.log(SEARCH.all_factors[1] / SEARCH.all_factors[0])  # the next factor's
    return best * float(1 + np.clip(error.focal[1], -near, near))


def _of_group(pair: PairFit, groups: Sequence[int], group: int) -> bool:
    return group in {groups[pair.first], groups[pair.second]}


def _with_all_groups(
    evidence: Evidence, fit: Fit, hypothesis: Hypothesis, groups: Sequence[int]
) -> Fit:
    """Compare photographs of groups that take part in too few pairs, too."""
    further: list[tuple[int, int]] = []
    for group in dict.fromkeys(groups):
        if sum(_of_group(pair, groups, group) for pair in fit.pairs) < FOCAL.min_pairs:
            members = [i for i, each in enumerate(groups) if each == group]
            further += _own_pairs(evidence, members)
    if not further:
        return fit
    more = evidence.fit(hypothesis, points=FOCAL.points, compared=further)
    return replace(fit, pairs=(*fit.pairs, *more.pairs))


def _own_pairs(evidence: Evidence, members: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of some views with each other, as far as there are any; else with others."""
    pairs = []
    partners = max(FOCAL.partners, FOCAL.partners * FOCAL.photographs // len(members))
    for n in evenly_spaced(len(members), FOCAL.photographs).tolist():
        near = evidence.candidates(members[n], evidence.given.poses)[::-1]
        own = [j for j in near if j in members]
        others = [j for j in near if j not in members]
        pairs += [(members[n], j) for j in [*own, *others][:partners]]
    return pairs


def _low_groups(fit: Fit, groups: Sequence[int]) -> list[int]:
    """Groups of which photographs confirm few points, compared with the best; the worst first."""
    shares = {}
    for group in dict.fromkeys(groups):
        own = Fit(tuple(pair for pair in fit.pairs if _of_group(pair, groups, group)), np.nan)
        shares[group] = own.support
    if len(shares) == 1:
        return []
    limit = max(FOCAL.low_share * max(shares.values()), SEARCH.min_support)
    return sorted((g for g, share in shares.items() if share < limit), key=lambda g: shares[g])


def focal_factor_findings(
    images: Sequence[Image], groups: Sequence[int], found: FoundFactors
) -> tuple[Finding, ...]:
    """Name the groups whose focal lengths are wrong, with the numbers before and after."""
    findings = []
    for group, factor in found.factors.items():
        if abs(factor - 1) < FOCAL.min_error:
            continue
        own = [image for image, each in zip(images, groups, strict=True) if each == group]
        shares = [
            Fit(tuple(p for p in fit.pairs if _of_group(p, groups, group)), np.nan).confirmed
            for fit in (found.before, found.after)
        ]
        given, whose = own[0].intrinsics, describe_group(images, groups, group)
        text = (
            f"The focal lengths{whose} are not those of the photographs: photographs confirm "
            f"{shares[0]:.0%} of the points, and {shares[1]:.0%} with focal lengths {factor:.3g} "
            "times as large"
        )
        if not whose:
            text += f"; those far from the centre are off by {found.miss_before:.2g} px, and "
            text += f"{found.miss_after:.2g} px then"
        right = f"{factor * given.K[0, 0]:.5g} px, for {given.width} x {given.height} pixels"
        subjects = tuple(image.name for image in own) if whose else ()
        fix = f"Set {'their' if whose else 'the'} focal length to about {right}."
        findings.append(Finding(WRONG_FOCAL_LENGTH, f"{text}.", "error", subjects, fix=fix))
    return tuple(findings)


def describe_group(images: Sequence[Image], groups: Sequence[int], group: int) -> str:
    """Say whose camera a group is, as a clause that begins with " of"; empty for a single group."""
    own = [image for image, each in zip(images, groups, strict=True) if each == group]
    if len(own) == len(images):
        return ""
    ids = {image.intrinsics.camera_id for image in own}
    camera = f"camera {ids.pop()} (" if len(ids) == 1 else ""
    names = own[0].name + (f" to {own[-1].name}" if len(own) > 1 else "")
    return f" of {camera}{counted(len(own), 'photograph')}, {names}{')' if camera else ''}"
