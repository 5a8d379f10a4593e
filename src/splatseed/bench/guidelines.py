"""What kind of scene gains from which method: descriptors of scenes, and rank correlations.

Descriptors are dimensionless, of the original points only, and nothing in them is random. A
guideline is supported if its p value is at most 5% after Holm over all that were considered.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from itertools import count as count_from, permutations, product

import numpy as np
import pandas as pd
from scipy.stats import rankdata, spearmanr

from splatseed.bench.comparisons import Gains
from splatseed.bench.plan import SFM
from splatseed.bench.statistics import LEVEL, holm
from splatseed.bench.study import Study
from splatseed.bench.tables import Number, Table, make_table
from splatseed.errors import PointCloudError, SplatseedError
from splatseed.io.photograph import decode_photograph, photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import empty_regions

DESCRIPTIONS = {  # in words that can follow "scenes with more"
    "planarity": "planarity", "linearity": "linearity", "scattering": "scattering",
    "curvature": "curvature", "gap": "wide gaps between points",
    "unevenness": "unevenly spaced points", "empty": "image area without points",
    "texture": "texture",
}  # fmt: skip
Descriptors = Mapping[str, float]  # of a scene by name; NaN where unknown
_NEIGHBORS = 16
_VIEWS = 24  # evenly spaced, for gaps, empty area and texture
_SIDE = 320  # longer side of photographs at which their gradients are measured, pixels
_EXACT = 8  # up to this many scenes all orders are enumerated; beyond, t approximates well
_FEWEST = 3  # with two scenes every correlation is perfect
_LISTED = 10


def describe(scene: Scene, progress: Progress = silent) -> dict[str, float]:
    """The descriptors of a scene, as the notes of the table of winners define them.

    Those of views are NaN without images.

    Raises:
        PointCloudError: Fewer than four distinct finite originals.
    """
    from splatseed.methods.neighbors import prepare  # noqa: PLC0415  (SciPy and Numba)

    cloud = prepare(scene.points.originals, progress=progress)
    if len(cloud) < 4:
        raise PointCloudError(
            "at least 4 distinct finite points to describe a scene by",
            found=f"{len(cloud)}",
            fix="Check that the cloud was read correctly.",
        )
    neighbors = cloud.neighbors(_NEIGHBORS)
    progress("describe points", 0.0)
    parts = []
    for start in range(0, len(cloud), 1 << 14):
        rows = slice(start, start + (1 << 14))
        around = np.concatenate([cloud.xyz[rows, None], cloud.xyz[neighbors.idx[rows]]], axis=1)
        around -= around.mean(axis=1, keepdims=True)
        covariance = np.einsum("nki,nkj->nij", around, around) / around.shape[1]
        parts.append(np.linalg.eigvalsh(covariance))
    # Rounding makes a plane's least variance negative.
    third, second, first = np.maximum(np.concatenate(parts), 0.0).T
    images = sorted(scene.images, key=lambda image: image.name)
    count = min(_VIEWS, len(images))
    some = tuple(images[(2 * i + 1) * len(images) // (2 * count)] for i in range(count))
    shown = scene.replace(points=scene.points.originals, images=some)
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


def _gap(scene: Scene, xyz: np.ndarray, spacing: np.ndarray) -> float:
    seen = [np.empty(0)]
    for camera in (image.camera for image in scene.images):
        uv, depth = camera.project(xyz)
        inside = ((uv >= 0) & (uv < [camera.width, camera.height])).all(axis=1)  # NaN: behind
        pixels = spacing[inside] * camera.K[0, 0] / depth[inside]
        seen.append(pixels / max(camera.width, camera.height))
    values = np.concatenate(seen)
    return float(np.median(values)) if len(values) else math.nan


def _texture(scene: Scene) -> float:
    from PIL import Image as PilImage  # noqa: PLC0415  (slow to import)

    folder = scene.source.image_dir if scene.source else None
    energies = []
    for path in [folder / image.name for image in scene.images] if folder is not None else []:
        with suppress(SplatseedError):  # a photograph that cannot be read is not part of the mean
            picture = decode_photograph(path, photograph_bytes(path), scene.white)
            scale = _SIDE / max(picture.size)
            width, height = (max(round(side * scale), 2) for side in picture.size)
            small = picture.convert("L").resize((width, height), PilImage.Resampling.BOX)
            grey = np.asarray(small, np.float32) / np.float32(255)
            across, down = np.diff(grey, axis=1)[:-1], np.diff(grey, axis=0)[:, :-1]
            energies.append(float(np.hypot(across, down).mean()))
    return float(np.mean(energies)) if energies else math.nan


def guidelines(study: Study, gained: Gains, described: Mapping[str, Descriptors]) -> pd.DataFrame:
    """All guidelines of a strategy, the likeliest first; scenes without descriptors are left out.

    A row for each descriptor and method (whose gain is the mean over its variants) has Spearman's
    ``rho`` over so many ``scenes``, its two-sided ``p``, the same after Holm (``adjusted``), how
    many scenes ``agree``, and the guideline as a ``sentence``.
    """
    scenes = [scene for scene in gained.scenes if scene in described]
    means = pd.DataFrame([gained.means(s) for s in scenes], columns=list(gained.seeds), dtype=float)
    kinds = pd.DataFrame([described[s] for s in scenes], columns=list(DESCRIPTIONS), dtype=float)
    rows = []
    for descriptor, method in product(DESCRIPTIONS, dict.fromkeys(map(study.family, means))):
        labels = [label for label in means if study.family(label) == method]
        both = np.stack([kinds[descriptor], means[labels].mean(axis=1, skipna=False)])
        x, y = both[:, np.isfinite(both).all(axis=0)]
        if len(x) >= _FEWEST and len(set(x)) > 1 and len(set(y)) > 1:
            rho, p = rank_correlation(x, y)
            side = np.sign(x - np.median(x)) * np.sign(y - np.median(y))
            more = "more" if rho > 0 else "less"
            said = f"Scenes with more {DESCRIPTIONS[descriptor]} gain {more} from {method}."
            agree = int((side == np.sign(rho)).sum())
            rows.append((descriptor, method, said, rho, p, agree, len(x)))
    columns = ["descriptor", "method", "sentence", "rho", "p", "agree", "scenes"]
    frame = pd.DataFrame(rows, columns=columns)
    frame = frame.assign(adjusted=holm(list(frame["p"])), weak=-frame["rho"].astype(float).abs())
    return frame.sort_values(["p", "weak"], ignore_index=True)


def rank_correlation(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Spearman's correlation, and its two-sided p value: exact for few scenes, over all orders."""
    if len(x) > _EXACT:
        result = spearmanr(x, y)
        return float(result.statistic), float(result.pvalue)
    a, b = (ranks - ranks.mean() for ranks in (rankdata(x), rankdata(y)))
    scale = math.sqrt(float(a @ a) * float(b @ b))
    chance = np.abs(np.array(list(permutations(b))) @ a) / scale
    rho = float(a @ b) / scale
    return rho, float((chance >= abs(rho) - 1e-9).mean())


def _verdict(derived: pd.DataFrame) -> str:
    if derived.empty:
        return f"No guideline: that takes {_FEWEST} scenes with gains and with descriptors."
    scenes, count = int(derived["scenes"].max()), len(derived)
    supported = derived.loc[derived["adjusted"] <= LEVEL, "sentence"]
    if len(supported):
        return f"Supported by {scenes} scenes, after {count} were looked at: {' '.join(supported)}"
    # Two of all orders are perfect.
    fewest = next(n for n in count_from(_FEWEST) if 2 / math.factorial(n) * count <= LEVEL)
    why = (
        f" It could hardly be otherwise: with {count} of them looked at, even a perfect order of "
        f"scenes is evidence only from {fewest} scenes on, and here there are {scenes}."
    )
    return f"The data of these {scenes} scenes supports no guideline.{why * (scenes < fewest)}"


def guideline_table(derived: pd.DataFrame, strategy: str) -> Table:
    """The likeliest guidelines of a strategy with their evidence."""
    rows = [
        (each.sentence, f"{each.agree} of {each.scenes}", Number(each.rho, signed=True),
         Number(each.p, 3), Number(each.adjusted, 3), "yes" if each.adjusted <= LEVEL else "no")
        for each in derived.head(_LISTED).itertuples()
    ]  # fmt: skip
    return make_table(
        "guidelines", ("guideline", "scenes that agree", "rho", "p", "p after Holm", "supported"),
        rows, strategy=strategy, verdict=_verdict(derived), shown=len(rows), count=len(derived),
        exact=_EXACT,
    )  # fmt: skip


def winner_table(gained: Gains, described: Mapping[str, Descriptors]) -> Table:
    """Which method won on each scene, beside what kind of scene it is."""
    rows = []
    for scene in gained.scenes:
        best = gained.top(scene)
        gain = gained.on_scene[scene, best]
        kind = [Number(described.get(scene, {}).get(name, math.nan), 3) for name in DESCRIPTIONS]
        won = Number(gain.mean, 3, gain.se, signed=True)
        told = (best, won, gain.verdict.replace("unknown", "1 run"))
        rows.append((scene, *(told if gain.mean > 0 else (SFM, "", "")), *kind))
    header = ("scene", "best", "gain over sfm, dB", "verdict", *DESCRIPTIONS)
    return make_table("winners", header, rows, strategy=gained.strategy)
