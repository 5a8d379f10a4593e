"""What kind of scene gains from which method: descriptors of scenes, and rank correlations.

Notation: l1 >= l2 >= l3 are the variances of a point and its 16 nearest along their principal axes;
h is a point's mean distance to its 6 nearest. Promise: descriptors are dimensionless, of the
original points only, and nothing in them is random; a guideline comes with its rank correlation,
its p value (exact if scenes are few) after Holm over all that were considered, and how many scenes
agree; none is called supported unless that p is at most 5%.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from itertools import permutations, product
from statistics import fmean
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.bench.comparisons import Gains
from splatseed.bench.statistics import LEVEL, holm
from splatseed.bench.study import Study
from splatseed.bench.tables import Number, Table
from splatseed.errors import PointCloudError, SplatseedError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.diagnostics import empty_regions

DESCRIPTIONS = {
    "planarity": "planarity",
    "linearity": "linearity",
    "scattering": "scattering",
    "curvature": "curvature",
    "gap": "wide gaps between points",
    "unevenness": "unevenly spaced points",
    "empty": "image area without points",
    "texture": "texture",
}
"""Each descriptor in words that can follow "scenes with more"."""
Descriptors = Mapping[str, float]
"""A scene's descriptors by name; NaN where unknown."""
_NEIGHBORS = 16
_VIEWS = 24
"""Number of views, evenly spaced, for gaps, empty area and texture."""
_SIDE = 320
"""Longer side of photographs at which their gradients are measured."""
_EXACT = 8
"""Up to this many scenes, all orders are enumerated (40,320); beyond, t approximates well."""
_FEWEST = 3
"""With two scenes every correlation is perfect."""
_LISTED = 10


def describe(scene: Scene, progress: Progress = silent) -> dict[str, float]:
    """The descriptors of a scene.

    ``planarity``, ``linearity``, ``scattering``: means of (l2 - l3) / l1, (l1 - l2) / l1, l3 / l1
    (Weinmann et al. 2015); ``curvature``: mean of l3 / (l1 + l2 + l3) (Pauly et al. 2002);
    ``gap``: median of h as views see it, as a share of the image's longer side; ``unevenness``:
    standard deviation of log h; ``empty``: mean share of the views' area that no point projects to;
    ``texture``: mean length of the gradient of grey values 0 to 1, per pixel of photographs made
    320 pixels large. The last two and the gap are NaN without images.

    Raises:
        PointCloudError: Fewer than four distinct finite originals.
    """
    from splatseed.upsample.neighbors import prepare  # noqa: PLC0415  (SciPy and Numba)

    cloud = prepare(scene.points.originals, progress=progress)
    if len(cloud) < 4:
        raise PointCloudError(
            "at least 4 distinct finite points to describe a scene by",
            found=f"{len(cloud)}",
            fix="Check that the cloud was read correctly.",
        )
    neighbors = cloud.neighbors(_NEIGHBORS)
    progress("describe points", 0.0)
    first, second, third = _variances(cloud.xyz, neighbors.idx).T
    shown = scene.replace(points=scene.points.originals, images=tuple(_some(scene)))
    regions = empty_regions(shown, progress)
    return {
        "planarity": float(((second - third) / first).mean()),
        "linearity": float(((first - second) / first).mean()),
        "scattering": float((third / first).mean()),
        "curvature": float((third / (first + second + third)).mean()),
        "gap": _gap(shown, cloud.xyz + cloud.center, neighbors.spacing),
        "unevenness": float(np.log(neighbors.spacing).std()),
        "empty": math.nan if regions is None else regions.mean,
        "texture": _texture(shown),
    }


def _variances(xyz: Float64[np.ndarray, "n 3"], idx: np.ndarray) -> Float64[np.ndarray, "n 3"]:
    """Variances of every row and its neighbours along their principal axes, greatest first."""
    parts = []
    for start in range(0, len(xyz), 1 << 14):
        rows = slice(start, start + (1 << 14))
        around = np.concatenate([xyz[rows, None], xyz[idx[rows]]], axis=1)
        around -= around.mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", around, around) / around.shape[1]
        parts.append(np.linalg.eigvalsh(covariance)[:, ::-1])
    # Rounding makes a plane's least variance negative.
    return np.asarray(np.maximum(np.concatenate(parts), 0.0))


def _gap(scene: Scene, xyz: np.ndarray, spacing: Float64[np.ndarray, " n"]) -> float:
    """Median over views and their points of h f / z over the image's longer side."""
    seen = [np.empty(0)]
    for camera in (image.camera for image in scene.images):
        uv, depth = camera.project(xyz)
        inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)  # NaN: behind
        pixels = spacing[inside] * camera.K[0, 0] / depth[inside]
        seen.append(pixels / max(camera.width, camera.height))
    values = np.concatenate(seen)
    return float(np.median(values)) if len(values) else math.nan


def _some(scene: Scene) -> list[Image]:
    """At most ``_VIEWS`` images, evenly spaced in the order of their names."""
    images = sorted(scene.images, key=lambda image: image.name)
    count = min(_VIEWS, len(images))
    return [images[(2 * i + 1) * len(images) // (2 * count)] for i in range(count)]


def _texture(scene: Scene) -> float:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    folder = scene.source.image_dir if scene.source else None
    energies = []
    for path in [folder / image.name for image in scene.images] if folder is not None else []:
        with suppress(SplatseedError):  # a photograph that cannot be read is not part of the mean
            picture = decode_photograph(path, photograph_bytes(path))
            scale = _SIDE / max(picture.size)
            width, height = (max(round(side * scale), 2) for side in picture.size)
            small = picture.convert("L").resize((width, height), PilImage.Resampling.BOX)
            grey = np.asarray(small, np.float32) / np.float32(255)
            across, down = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
            energies.append(float(np.hypot(across, down).mean()))
    return float(np.mean(energies)) if energies else math.nan


class Guideline(NamedTuple):
    """Scenes with more of a descriptor gain more, or less, from a method.

    A method's gain is the mean over its variants; ``rho`` is Spearman's rank correlation over
    ``scenes`` scenes, ``p`` its two-sided p value and ``adjusted`` the same after Holm; ``agree``
    scenes lie on the side of both medians that the correlation predicts.
    """

    descriptor: str
    method: str
    rho: float
    p: float
    agree: int
    scenes: int
    adjusted: float = math.nan

    @property
    def sentence(self) -> str:
        """The guideline in words."""
        more = "more" if self.rho > 0 else "less"
        return f"Scenes with more {DESCRIPTIONS[self.descriptor]} gain {more} from {self.method}."


def guidelines(
    study: Study, gained: Gains, described: Mapping[str, Descriptors]
) -> tuple[Guideline, ...]:
    """All guidelines of a strategy, the likeliest first.

    Args:
        study: The study.
        gained: The gains under the strategy.
        described: Descriptors by scene; scenes without are left out.
    """
    methods: dict[str, dict[str, float]] = {}
    for family in dict.fromkeys(study.variants[label].family for label in gained.seeds):
        labels = [each for each in gained.seeds if study.variants[each].family == family]
        scenes = [s for s in gained.scenes if all((s, v) in gained.on_scene for v in labels)]
        methods[family] = {s: fmean(gained.on_scene[s, v].mean for v in labels) for s in scenes}
    derived = []
    for descriptor, (method, gains) in product(DESCRIPTIONS, methods.items()):
        pairs = [(described[s][descriptor], gains[s]) for s in gains if s in described]
        x, y = np.array([pair for pair in pairs if not math.isnan(pair[0])]).reshape(-1, 2).T
        if len(x) >= _FEWEST and len(set(x)) > 1 and len(set(y)) > 1:
            rho, p = rank_correlation(x, y)
            side = np.sign(x - np.median(x)) * np.sign(y - np.median(y))
            agree = int((side == np.sign(rho)).sum())
            derived.append(Guideline(descriptor, method, rho, p, agree, len(x)))
    corrected = holm([each.p for each in derived])
    derived = [each._replace(adjusted=p) for each, p in zip(derived, corrected, strict=True)]
    return tuple(sorted(derived, key=lambda each: (each.p, -abs(each.rho))))


def rank_correlation(
    x: Float64[np.ndarray, " S"], y: Float64[np.ndarray, " S"]
) -> tuple[float, float]:
    """Spearman's correlation of values, not all equal, and its two-sided p value.

    The p value is exact for up to 8 scenes (over all orders), else by Student's t.
    """
    from scipy.stats import rankdata, spearmanr  # noqa: PLC0415  (slow to import)

    if len(x) > _EXACT:
        result = spearmanr(x, y)
        return float(result.statistic), float(result.pvalue)
    a, b = (ranks - ranks.mean() for ranks in (rankdata(x), rankdata(y)))
    scale = math.sqrt(float(a @ a) * float(b @ b))
    chance = np.abs(np.array(list(permutations(b))) @ a) / scale
    rho = float(a @ b) / scale
    return rho, float((chance >= abs(rho) - 1e-9).mean())


def verdict(derived: tuple[Guideline, ...]) -> str:
    """The conclusion from all guidelines of a strategy, in a sentence or two."""
    if not derived:
        return f"No guideline: that takes {_FEWEST} scenes with gains and with descriptors."
    scenes, count = max(each.scenes for each in derived), len(derived)
    supported = [each.sentence for each in derived if each.adjusted <= LEVEL]
    if supported:
        return f"Supported by {scenes} scenes, after {count} were looked at: {' '.join(supported)}"
    fewest = _FEWEST
    while 2 / math.factorial(fewest) * count > LEVEL:  # two of all orders are perfect
        fewest += 1
    why = (
        f" It could hardly be otherwise: with {count} of them looked at, even a perfect order of "
        f"scenes is evidence only from {fewest} scenes on, and here there are {scenes}."
    )
    return f"The data of these {scenes} scenes supports no guideline.{why * (scenes < fewest)}"


def guideline_table(derived: tuple[Guideline, ...], strategy: str) -> Table:
    """The likeliest guidelines of a strategy with their evidence."""
    rows = [
        (
            each.sentence,
            f"{each.agree} of {each.scenes}",
            Number(each.rho, signed=True),
            Number(each.p, 3),
            Number(each.adjusted, 3),
            "yes" if each.adjusted <= LEVEL else "no",
        )
        for each in derived[:_LISTED]
    ]
    note = (
        f"The {len(rows)} likeliest of {len(derived)} that were looked at (each descriptor with "
        "each method, whose gain is the mean over its ratios). Scenes agree when they are on the "
        "same side of both medians as the correlation says. p is of Spearman's rank correlation, "
        f"exact up to {_EXACT} scenes; supported is what is at most 5% after Holm."
    )
    header = ("guideline", "scenes that agree", "rho", "p", "p after Holm", "supported")
    title = f"Guidelines, strategy {strategy}"
    return Table(f"guidelines_{strategy}", title, header, rows, (verdict(derived), note))


def winner_table(gained: Gains, described: Mapping[str, Descriptors]) -> Table:
    """Which method won on each scene, beside what kind of scene it is."""
    rows = []
    for scene in gained.scenes:
        best = gained.best(scene)
        gain = gained.on_scene[scene, best] if best else None
        kind = [Number(described.get(scene, {}).get(name, math.nan), 3) for name in DESCRIPTIONS]
        won = Number(gain.mean, 3, gain.se, signed=True) if gain else ""
        sure = gain.verdict.replace("unknown", "1 run") if gain else ""
        rows.append((scene, best or "sfm", won, sure, *kind))
    chosen = "The best is chosen by its own scores, so its gain is biased upwards."
    kinds = (
        "Planarity, linearity and scattering of a point's 16 nearest (Weinmann et al. 2015) and "
        "their curvature (surface variation, Pauly et al. 2002), means over the points; gap: the "
        "median spacing of points as the views see it, as a share of the image's longer side; "
        "unevenness: the standard deviation of the logarithm of spacing; empty: the share of the "
        "images' area without points; texture: the mean gradient of grey values at 320 pixels."
    )
    header = ("scene", "best", "gain over sfm, dB", "verdict", *DESCRIPTIONS)
    title = f"What gained most on each scene, strategy {gained.strategy}"
    return Table(f"winners_{gained.strategy}", title, header, rows, (chosen, kinds))
