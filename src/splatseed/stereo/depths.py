"""Depth maps from photographs alone: views are compared with each other, then their maps are.

Notation: V views of a scene. Promise: the same scene, settings and seed give the same bytes,
whatever the number of threads; a depth is kept only where other views' independently computed maps
agree.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from splatseed.progress import Progress, silent
from splatseed.scene import Image
from splatseed.stereo.matching import match_views
from splatseed.stereo.result import StereoResult
from splatseed.stereo.settings import TOO_FEW, StereoSettings
from splatseed.stereo.start import Hints, hints_from
from splatseed.stereo.without_points import coarse_stereo
from splatseed.views.pairs import choose_sources
from splatseed.views.view import View
from splatseed.views.visibility import Visibility


def find_stereo(
    views: Sequence[View],
    images: Sequence[Image],
    visibility: Visibility,
    settings: StereoSettings,
    seed: int = 0,
    progress: Progress = silent,
    only: Sequence[int] | None = None,
) -> StereoResult:
    """Compare photographs with each other.

    Args:
        views: The photographs, at the size to compare.
        images: Their images, in the same order.
        visibility: The points that each image sees; depth is searched around them. If there are too
            few, small copies of the photographs are compared first, to get some.
        settings: The choices of stereo.
        seed: The same seed gives the same bytes.
        progress: Called with the stage and the fraction done.
        only: The views whose maps are wanted; the bytes are the same as if all were, and other
            views are computed only as far as they confirm these. All when left out.
    """
    if len(visibility.xyz) < TOO_FEW:
        visibility = coarse_stereo(views, seed, progress)
    seen = [visibility.rows_of(image) for image in images]
    centers = np.stack([image.camera.center for image in images])
    sources = choose_sources(seen, visibility.xyz, centers, settings.num_witnesses)
    needed = range(len(views)) if only is None else {*only, *sources[list(only)].ravel().tolist()}
    hints = [
        _hints(view, visibility.xyz[rows]) if i in needed else None
        for i, (view, rows) in enumerate(zip(views, seen, strict=True))
    ]
    return match_views(views, hints, sources, settings, seed, progress)


def _hints(view: View, xyz: Float64[np.ndarray, "M 3"]) -> Hints | None:
    """What the points that a view sees tell about its depth."""
    uv, z = view.camera.project(xyz)
    front = z > 0
    return hints_from(uv[front], 1.0 / z[front]) if front.any() else None
