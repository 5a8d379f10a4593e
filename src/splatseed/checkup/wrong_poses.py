"""Single photographs whose poses are wrong among right ones, by the points that they share.

All photographs are compared with their partners (``consistency``). A photograph's *share* is the
fraction of its points that photographs confirm, over the pairs in which it takes part; that of a
wrong pose is about 0, whereas its right partners have other pairs. Where the share is at most
``max_share`` of the median, and that of every pair at most twice as much, the photograph is
compared with more partners and with those before and after it by name; it is named if all of them
say the same. Photographs that share too few points with others are not checked.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatseed.checkup.consistency import Evidence, PairFit
from splatseed.checkup.examination import comparable
from splatseed.depth.stereo.maps import MIN_POINTS
from splatseed.errors import SplatseedError
from splatseed.findings import Finding
from splatseed.progress import Progress, silent
from splatseed.sampling import strided
from splatseed.scene import Image, Scene
from splatseed.text import agreeing, counted

WRONG_POSES = "wrong-poses"
SAMPLE = 100
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
    max_wrong: float = 0.3
    """Fraction of the photographs above which they are not single ones: nothing is said."""


SINGLE = _Settings()


def find_wrong_poses(
    scene: Scene, images: Sequence[Image], progress: Progress = silent, limit: int | None = None
) -> tuple[Finding, ...]:
    """Name photographs whose poses do not fit the points that others see; nothing without points.

    Args:
        scene: The scene.
        images: Its images to compare.
        progress: Called with the stage and the fraction done.
        limit: The maximum number of photographs to compare, spread evenly; None: all.
    """
    points = scene.points.originals
    images = images if limit is None else strided(images, limit)
    too_few = len(images) < SINGLE.min_photographs
    if too_few or np.count_nonzero(points.distinct) < MIN_POINTS:
        return ()
    evidence = Evidence(scene, images)
    try:
        fit = evidence.fit(
            evidence.given, points=SINGLE.points, photographs=len(images), progress=progress
        )
    except SplatseedError:  # photographs that cannot be used, which the reader of them reports
        return ()
    suspects = _wrong(fit.pairs)
    further = [(i, j) for i in suspects for j in _more_partners(evidence, i)]
    confirmed = _wrong([*fit.pairs, *evidence.fit(evidence.given, compared=further).pairs])
    wrong = tuple(images[i].name for i in confirmed if i in suspects)
    if not wrong or len(wrong) > SINGLE.max_wrong * len(images):
        return ()
    more = len(wrong) - NAMED
    names = ", ".join(wrong[:NAMED]) + (f" and {more:,} more" if more > 0 else "")
    which = agreeing(len(wrong), "its pose is", "their poses are")
    text = (
        f"Points that other photographs confirm do not fit {counted(len(wrong), 'photograph')}: "
        f"{names}; {which} wrong, or {agreeing(len(wrong), 'it shows', 'they show')} other things."
    )
    leave = "`drop_wrong_poses=True` leaves them out of seeds and training."
    return (Finding(WRONG_POSES, text, "error", wrong, fix=leave),)


def _more_partners(evidence: Evidence, i: int) -> list[int]:
    near = evidence.candidates(i, evidence.given.poses)
    beside = [j for j in (i - 2, i - 1, i + 1, i + 2) if 0 <= j < len(evidence.images)]
    return sorted({*near, *beside})


def _wrong(pairs: Sequence[PairFit]) -> list[int]:
    """Return the indices of the views whose pairs all fail."""
    of_view: dict[int, list[PairFit]] = defaultdict(list)
    for pair in pairs:
        of_view[pair.first].append(pair)
        of_view[pair.second].append(pair)
    shares = {i: _share(each) for i, each in of_view.items() if _tested(each) >= SINGLE.min_tested}
    if not shares:
        return []
    median = float(np.median(list(shares.values())))
    if median < SINGLE.min_median:
        return []
    limit = SINGLE.max_share * median
    return sorted(
        i
        for i, share in shares.items()
        if share <= limit and len(of_view[i]) > 1 and max(map(_pair_share, of_view[i])) <= 2 * limit
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
    wrong = {name for finding in findings for name in finding.subjects}
    if not wrong:
        return scene, ()
    images = tuple(image for image in scene.images if image.name not in wrong)
    left = scene.replace(images=images, absent=(*scene.absent, *sorted(wrong)))
    text = f"{counted(len(wrong), 'photograph')} with wrong poses are left out: "
    text += f"{', '.join(sorted(wrong)[:NAMED])}{' ...' if len(wrong) > NAMED else ''}."
    return left, (Finding(WRONG_POSES, text, "info", tuple(sorted(wrong))),)
