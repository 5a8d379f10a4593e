"""Single photographs whose poses are wrong among right ones, by the points that they share.

All photographs are compared with their partners (``consistency``). A photograph's *share* is the
fraction of its points that photographs confirm, over the pairs in which it takes part; that of a
wrong pose is about 0, whereas its right partners have other pairs. Where the share is at most
``max_share`` of the median, and that of every pair at most twice as much, the photograph is
compared with more partners and with those before and after it by name; it is named if all of them
say the same. If its points fit with another focal length, that is named instead. Photographs that
share too few points with others are not checked.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatseed.checkup.consistency import Evidence, PairFit
from splatseed.checkup.examination import comparable
from splatseed.checkup.focal_lengths import WRONG_FOCAL_LENGTH, search_factor
from splatseed.depth.stereo.maps import MIN_POINTS
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.progress import Progress, silent
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted, name_some

WRONG_POSES = "wrong-poses"
SAMPLE = 150
"""Photographs that ``splatseed info`` compares unless it is to compare all."""
NAMED = 8
"""Photographs named in the text; all are subjects of the finding."""


@dataclass(frozen=True)
class _Settings:
    """When a pose is wrong."""

    points: int = 24
    """Points of a pair."""
    min_photographs: int = 6
    """With fewer photographs none is checked."""
    min_tested: int = 16
    """Points that a photograph must share with others to be checked."""
    min_median: float = 0.2
    """Median share below which no photograph is checked."""
    max_share: float = 0.25
    """Share of a wrong pose, as a fraction of the median."""
    searched: int = 8
    partners: int = 4
    """Photographs whose focal length may be wrong instead of the pose, and views to find it by."""
    max_wrong: float = 0.3
    """Fraction of the photographs above which they are not single ones: nothing is said."""


SINGLE = _Settings()


def find_wrong_poses(
    scene: Scene,
    images: Sequence[Image],
    progress: Progress = silent,
    limit: int | None = None,
    evidence: Evidence | None = None,
) -> tuple[Finding, ...]:
    """Name photographs whose poses do not fit the points that others see; nothing without points.

    Args:
        scene: The scene.
        images: Its images to compare.
        progress: Called with the stage and the fraction done.
        limit: The maximum number of photographs to compare, spread evenly; None: all.
        evidence: That of the images, which keeps the photographs that it has read.
    """
    points = scene.points.originals
    if limit is not None and len(images) > limit:
        images, evidence = strided(images, limit), None
    too_few = len(images) < SINGLE.min_photographs
    if too_few or np.count_nonzero(points.distinct) < MIN_POINTS:
        return ()
    evidence = evidence or Evidence(scene, images)
    try:
        fit = evidence.fit(
            evidence.given, points=SINGLE.points, photographs=len(images), progress=progress
        )
    except SplatseedError:  # photographs that cannot be used, which the reader of them reports
        return ()
    max_share = SINGLE.max_share * _median_share(fit.pairs)
    suspects = _wrong(fit.pairs, max_share)
    further = [(i, j) for i in suspects for j in _more_partners(evidence, i)]
    more_pairs = evidence.fit(evidence.given, compared=further).pairs
    confirmed = _wrong([*fit.pairs, *more_pairs], max_share)
    wrong = [i for i in confirmed if i in suspects]
    if not wrong or len(wrong) > SINGLE.max_wrong * len(images):
        return ()
    factors = {i: _focal_factor(evidence, i) for i in wrong[: SINGLE.searched]}
    zoomed = {images[i].name: factor for i, factor in factors.items() if factor is not None}
    turned = tuple(images[i].name for i in wrong if images[i].name not in zoomed)
    findings = (_focal_finding(zoomed),) if zoomed else ()
    return (*findings, _pose_finding(turned)) if turned else findings


def _focal_factor(evidence: Evidence, i: int) -> float | None:
    """The factor of a photograph's focal length with which its pose fits; None without any."""
    near = evidence.candidates(i, evidence.given.poses)[: SINGLE.partners]
    return search_factor(evidence, evidence.given, [i], [(i, j) for j in near])


def _focal_finding(factors: Mapping[str, float]) -> Finding:
    each = name_some([f"{name} ({factor:.3g} times)" for name, factor in factors.items()], NAMED)
    count = f"{counted(len(factors), 'photograph')} {agreeing(len(factors), 'has', 'have')}"
    text = f"By the points that others confirm, {count} another focal length: {each}."
    fix = "Correct it, or leave them out of seeds and training: `drop_wrong_poses=True`."
    return Finding(WRONG_FOCAL_LENGTH, text, "error", tuple(factors), fix=fix)


def _pose_finding(wrong: tuple[str, ...]) -> Finding:
    which = agreeing(len(wrong), "its pose is", "their poses are")
    shows = agreeing(len(wrong), "it shows", "they show")
    count = f"{counted(len(wrong), 'photograph')} {agreeing(len(wrong), 'does', 'do')}"
    text = f"{count} not fit the points that others confirm: {name_some(wrong, NAMED)}; "
    text += f"{which} wrong, or {shows} other things."
    leave = "`drop_wrong_poses=True` leaves them out of seeds and training."
    return Finding(WRONG_POSES, text, "error", wrong, fix=leave)


def _more_partners(evidence: Evidence, i: int) -> list[int]:
    near = evidence.candidates(i, evidence.given.poses)
    beside = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(evidence.images)]
    return sorted({*near, *beside})


def _pairs_of_views(pairs: Sequence[PairFit]) -> dict[int, list[PairFit]]:
    """The pairs of each view that shares enough points with others."""
    of_view: dict[int, list[PairFit]] = defaultdict(list)
    for pair in pairs:
        of_view[pair.first].append(pair)
        of_view[pair.second].append(pair)
    return {i: each for i, each in of_view.items() if _tested(each) >= SINGLE.min_tested}


def _median_share(pairs: Sequence[PairFit]) -> float:
    """The median view's share; 0, at which none is wrong, where it is too low."""
    median = float(np.median([*map(_share, _pairs_of_views(pairs).values())] or [0.0]))
    return median if median >= SINGLE.min_median else 0.0


def _wrong(pairs: Sequence[PairFit], limit: float) -> list[int]:
    """Return the indices of the views whose pairs all fail: their share is at most ``limit``."""
    return sorted(
        i
        for i, each in _pairs_of_views(pairs).items()
        if limit > 0
        and len(each) > 1
        and _share(each) <= limit
        and max(map(_pair_share, each)) <= 2 * limit
    )


def _tested(pairs: Sequence[PairFit]) -> int:
    return sum(pair.tested for pair in pairs)


def _share(pairs: Sequence[PairFit]) -> float:
    return sum(pair.confirmed for pair in pairs) / max(_tested(pairs), 1)


def _pair_share(pair: PairFit) -> float:
    return pair.confirmed / max(pair.tested, 1)


def without_wrong_poses(
    scene: Scene, progress: Progress = silent
) -> tuple[Scene, tuple[Finding, ...]]:
    """Leave out the images that ``find_wrong_poses`` names; also return what was found."""
    findings = find_wrong_poses(scene, comparable(scene), progress)
    return leave_out(scene, [name for finding in findings for name in finding.subjects])


def leave_out(scene: Scene, wrong: Collection[str]) -> tuple[Scene, tuple[Finding, ...]]:
    """Leave out images whose poses are known to be wrong, as far as they are there; say so."""
    names = tuple(sorted({name for name in wrong if name in scene}))
    if not names:
        return scene, ()
    which = agreeing(
        len(names), "that does not fit the points is", "that do not fit the points are"
    )
    text = f"{counted(len(names), 'photograph')} {which} left out: "
    text += f"{', '.join(names[:NAMED])}{' ...' if len(names) > NAMED else ''}."
    return scene.without(names), (Finding(WRONG_POSES, text, "info", names),)
