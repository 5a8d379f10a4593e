"""Stereo on captures without true depth, against SfM's points of which it was not told.

Notation: of a capture's training photographs (the test views are taken out) some neighbours by
name; of its points every second is *held out*. A held-out point that an image sees is *known* if
its pixel has a depth; its error is that of the plane there, relative. Promise: captures are only
read. Points are no truth: they lie on texture, and are themselves off by a part of a percent.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from benchmarks.common.clouds import find_scenes

import splatseed as ss
from splatseed.depth.stereo.maps import StereoResult, StereoSettings
from splatseed.depth.stereo.pipeline import find_stereo
from splatseed.photos.loading import load_views
from splatseed.photos.sizes import factor_for_size
from splatseed.photos.visibility import Visibility, find_visibility

__all__ = ["FEW", "PointScore", "score_few", "score_points"]

FEW = (0, 30, 300, 3000)
"""How many of a capture's points stereo begins from, drawn at random; 0: none."""


@dataclass(frozen=True)
class PointScore:
    """What stereo makes of one capture.

    Args:
        kept: Share of the maps' pixels that have a depth.
        known: Share of the held-out points, once for each image that sees them, whose pixel has
            one.
        within_1: Share of these that are within 1% of it.
        within_5: Likewise 5%.
        seconds: Processor time.
    """

    kept: float
    known: float
    within_1: float
    within_5: float
    seconds: float

    def cells(self) -> list[str]:
        """As a row of a table."""
        shares = (self.kept, self.known, self.within_1, self.within_5)
        return [*(f"{share:.1%}" for share in shares), f"{self.seconds:.1f}"]


def score_points(
    names: list[str], settings: dict[str, Any], limit: int
) -> dict[str, dict[str, float]]:
    """The score on each capture, as JSON can hold it.

    Args:
        names: Folders of captures.
        settings: Fields of ``StereoSettings``.
        limit: Photographs at most.
    """
    return {name: asdict(_score(name, StereoSettings(**settings), limit)) for name in names}


def score_few(name: str, limit: int) -> list[list[float]]:
    """From each of ``FEW``: points that an image sees, share of pixels kept, processor seconds.

    Args:
        name: The capture's folder.
        limit: Photographs at most.
    """
    scene = ss.load_scene(find_scenes() / name)
    images = scene.split()[0][:limit]
    views = load_views(scene, images, data_factor=2)
    everything, settings = find_visibility(scene), StereoSettings()
    find_stereo(views[:2], images[:2], everything, settings)  # compiled
    order = np.random.default_rng(0).permutation(len(everything.xyz))
    rows = []
    for count in FEW:
        mine = np.isin(np.arange(len(order)), order[:count])[everything.point_idx]
        told = _only(everything, mine)
        if not count:
            told = Visibility(np.empty((0, 3)), np.empty(0, np.int64), {}, {})
        started = time.process_time()
        stereo = find_stereo(views, images, told, settings)
        seconds = time.process_time() - started
        seen = float(np.median([told.count.get(image.image_id, 0) for image in images]))
        kept = np.mean([stereo.confirmed(i).mean() for i in range(len(views))])
        rows.append([seen, float(kept), seconds])
    return rows


def _score(name: str, settings: StereoSettings, limit: int) -> PointScore:
    scene = ss.load_scene(find_scenes() / name)
    images = scene.split()[0][:limit]
    views = load_views(scene, images, data_factor=factor_for_size(images, settings.max_size))
    visibility = find_visibility(scene)
    told = _only(visibility, visibility.point_idx % 2 == 0)
    find_stereo(views[:2], images[:2], told, settings)  # compiled
    started = time.process_time()
    stereo = find_stereo(views, images, told, settings)
    seconds = time.process_time() - started
    check_visibility = _only(visibility, visibility.point_idx % 2 == 1)
    errors = [_errors(stereo, i, check_visibility.of(image)) for i, image in enumerate(images)]
    error = np.concatenate(errors)
    known = np.isfinite(error)
    kept = np.concatenate([stereo.confirmed(i).ravel() for i in range(len(views))]).mean()
    return PointScore(
        float(kept),
        float(known.mean()),
        float((error[known] < 0.01).mean()),
        float((error[known] < 0.05).mean()),
        seconds,
    )


def _only(visibility: Visibility, mine: np.ndarray) -> Visibility:
    """Some of what the images see."""
    before = np.concatenate([[0], np.cumsum(mine)])
    start = {key: int(before[at]) for key, at in visibility.start.items()}
    count = {
        key: int(before[at + visibility.count[key]] - before[at])
        for key, at in visibility.start.items()
    }
    return Visibility(visibility.xyz, visibility.point_idx[mine], start, count)


def _errors(stereo: StereoResult, i: int, xyz: np.ndarray) -> np.ndarray:
    """Relative error at the pixels of points, [M]; NaN where there is no depth."""
    view, grid = stereo.views[i], stereo.settings.grid
    uv, z = view.camera.project(xyz)
    rows, columns = stereo.costs[i].shape
    inside = (z > 0) & ((uv >= 0) & (uv < [columns * grid, rows * grid])).all(axis=1)
    uv, z = uv[inside], z[inside]
    column, row = (uv // grid).astype(int).T
    w, gx, gy = stereo.planes[i][:, row, column]
    across, down = (uv - (np.stack([column, row], axis=1) + 0.5) * grid).T
    error = np.abs(1 / (z * (w + gx * across + gy * down)) - 1)
    return np.where(stereo.confirmed(i)[row, column], error, np.nan)
