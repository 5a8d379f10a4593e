"""Dense seeds against true depth: as sparse ones, and in proportion to detail or evenly.

Notation: a seed's *error* is that of its depth in the view it comes from, relative to the true
depth of the four depth pixels around it (``truth``). Promise: all photographs of a scene take part,
as nothing is held against a held-out surface; one process per scene.
"""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path
from typing import Any

import numpy as np
from benchmarks.stereo.truth import first, load, nearest_error

import splatseed as ss
from splatseed.depth.stereo import detail
from splatseed.depth.stereo.fusion import StereoSeeds, fuse
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo, known_visibility
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.scene import Scene
from splatseed.seeding import dense

__all__ = ["MULTIPLES", "score_dense"]

MULTIPLES = (4, 16)
"""Budgets, as multiples of the sparse seeds."""
ARMS = {"in proportion to contrast": 1.0, "evenly": 0.0}
SPACING = 8.0


def score_dense(name: str, cache: str, limit: int) -> list[dict[str, Any]]:
    """Rows of label, seeds, shares within 1% and 5%, and processor seconds of one scene."""
    scene = first(load(name, Path(cache)), limit)
    images = scene.images
    views = load_views(scene, images, data_factor=factor_for_size(images, 800), undistort=True)
    started = time.process_time()
    stereo = find_stereo(views, images, known_visibility(scene), StereoSettings())
    seeds = fuse(stereo, SPACING)
    rows = [_row("sparse", stereo, seeds, scene, time.process_time() - started)]
    for multiple in MULTIPLES:
        for label, exponent in ARMS.items():
            budget = len(scene.points) + multiple * len(seeds)
            rows.append(_dense_row(f"{multiple} times, {label}", scene, budget, exponent))
    return rows


def _dense_row(label: str, scene: Scene, budget: int, exponent: float) -> dict[str, Any]:
    """Make seeds within a budget, and keep what they are made of."""
    made: list[tuple[StereoResult, StereoSeeds]] = []
    choose, before = dense.fuse_at_most, detail.DETAIL

    def watched(stereo: StereoResult, *arguments: Any) -> StereoSeeds:
        made.append((stereo, choose(stereo, *arguments)))
        return made[0][1]

    started = time.process_time()
    try:
        dense.fuse_at_most = watched
        detail.DETAIL = dataclasses.replace(before, exponent=exponent)
        ss.upsample(scene, "stereo", budget=budget)
    finally:
        dense.fuse_at_most, detail.DETAIL = choose, before
    return _row(label, *made[0], scene, time.process_time() - started)


def _row(
    label: str, stereo: StereoResult, seeds: StereoSeeds, scene: Scene, seconds: float
) -> dict[str, Any]:
    errors = []
    for i, view in enumerate(stereo.views):
        uv, z = view.camera.project(seeds.xyz[seeds.view_idx == i].astype(float))
        errors.append(
            nearest_error(uv / [view.width, view.height], z, scene.depths.read(view.name).values)
        )
    error = np.concatenate(errors)
    error = error[np.isfinite(error)]
    size = f"{stereo.views[0].width}, every {stereo.settings.grid}"
    shares = [float((error < limit).mean()) for limit in (0.01, 0.05)]
    return {"label": label, "size": size, "seeds": len(seeds), "shares": shares, "seconds": seconds}
