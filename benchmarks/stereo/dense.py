"""Dense seeds against true depth: as sparse ones, and in proportion to detail or evenly.

Notation: a seed's *error* is that of its depth in the view it comes from, relative to the true
depth of the four depth pixels around it (``truth``). Promise: all photographs of a scene take part,
as nothing is held against a held-out surface; one process per scene.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from benchmarks.stereo.truth import first, load, nearest_error

import splatseed as ss
from splatseed.depth.stereo import detail, fusion
from splatseed.depth.stereo.fusion import fuse
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo, known_visibility
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

__all__ = ["MULTIPLES", "score_dense"]

MULTIPLES = (4, 16)
"""Budgets, as multiples of the sparse seeds."""
ARMS = {"in proportion to contrast": 1.0, "evenly": 0.0}
SPACING = 8.0
Part: TypeAlias = tuple[StereoResult, int, PointCloud]
"""Seeds of one view: the result of stereo, the index of the view, and the seeds."""


def score_dense(name: str, cache: str, limit: int) -> list[dict[str, Any]]:
    """Rows of label, seeds, shares within 1% and 5%, and processor seconds of one scene."""
    scene = first(load(name, Path(cache)), limit)
    images = scene.images
    views = load_views(scene, images, data_factor=factor_for_size(images, 800), undistort=True)
    with _watched(fusion) as parts:
        started = time.process_time()
        stereo = find_stereo(views, images, known_visibility(scene), StereoSettings())
        seeds = fuse(stereo, SPACING)
        rows = [_row("sparse", parts, scene, time.process_time() - started)]
    for multiple in MULTIPLES:
        for label, exponent in ARMS.items():
            budget = len(scene.points) + multiple * len(seeds)
            rows.append(_dense_row(f"{multiple} times, {label}", scene, budget, exponent))
    return rows


def _dense_row(label: str, scene: Scene, budget: int, exponent: float) -> dict[str, Any]:
    """Make seeds within a budget, and keep what they are made of."""
    before, started = detail.DETAIL, time.process_time()
    with _watched(detail) as parts:
        try:
            detail.DETAIL = dataclasses.replace(before, exponent=exponent)
            ss.upsample(scene, "stereo", budget=budget)
        finally:
            detail.DETAIL = before
    return _row(label, parts, scene, time.process_time() - started)


@contextmanager
def _watched(module: ModuleType) -> Iterator[list[Part]]:
    """Keep the seeds of each view that ``module`` makes while the block runs."""
    make_seeds, parts = module.make_seeds, list[Part]()

    def watched(stereo: StereoResult, i: int, places: Any) -> PointCloud:
        parts.append((stereo, i, make_seeds(stereo, i, places)))
        return parts[-1][2]

    module.make_seeds = watched
    try:
        yield parts
    finally:
        module.make_seeds = make_seeds


def _row(label: str, parts: list[Part], scene: Scene, seconds: float) -> dict[str, Any]:
    errors, stereo = [], parts[0][0]
    for _, i, seeds in parts:
        view = stereo.views[i]
        uv, z = view.camera.project(seeds.xyz.astype(float))
        errors.append(
            nearest_error(uv / [view.width, view.height], z, scene.depths.read(view.name).values)
        )
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    size = f"{stereo.views[0].width}, every {stereo.settings.grid}"
    num = sum(len(seeds) for _, _, seeds in parts)
    shares = [float((error < limit).mean()) for limit in (0.01, 0.05)]
    return {"label": label, "size": size, "seeds": num, "shares": shares, "seconds": seconds}
