"""Points for scenes without any, by stereo on downsampled photographs.

A few views are matched over every depth first; their depths give the range and the sources of all
views, which are matched next. Promise: the same photographs and seed give the same bytes; every
point is confirmed by two other views.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64

from splatseed.camera import Camera
from splatseed.depth.stereo.fusion import fuse
from splatseed.depth.stereo.maps import StereoSettings, block_means
from splatseed.depth.stereo.matching import DepthPrior, match_views
from splatseed.photos.sources import choose_by_pose, choose_sources
from splatseed.photos.view import View
from splatseed.photos.visibility import Visibility, points_in_image
from splatseed.progress import Progress
from splatseed.projection import pixel_centers, scaled
from splatseed.sampling import evenly_spaced, strided


@dataclass(frozen=True)
class _CoarseSettings:
    side: int = 200  # longer side of the downsampled photographs, pixels
    cell: float = 4.0  # pixels between points
    num_sampled: int = 24  # views matched first, to find the range of depths
    max_sample_cost: float = 0.15  # pixels of higher cost do not count towards the range
    min_parallax: float = 0.2  # pixels, at the farthest depth tried first
    range_factor: float = 3.0  # the second search extends beyond the 10th and 90th percentiles
    max_points: int = 30_000  # more points do not improve the choice of sources


COARSE = _CoarseSettings()
MATCHING = StereoSettings(grid=2, sweeps=6, tolerance=0.03, max_cost=0.4)


def coarse_stereo(views: Sequence[View], seed: int, progress: Progress) -> Visibility:
    """Find points by stereo on downsampled copies of two or more photographs."""
    small = [downsampled(view, COARSE.side) for view in views]
    quantiles = _inverse_depth_quantiles(small, seed, progress)
    # Sources share the hypothetical points that a view may see, at good angles.
    xyz, seen = _hypothetical_points(small, quantiles)
    centers = np.stack([view.camera.center for view in small])
    sources = choose_sources(seen, xyz, centers, MATCHING.num_check_views)
    factor = COARSE.range_factor
    priors = [DepthPrior.from_range(low / factor, high * factor) for low, _, high in quantiles]
    stereo = match_views(small, priors, sources, MATCHING, seed, progress)
    return without_tracks(fuse(stereo, COARSE.cell).xyz.astype(np.float64))


def without_tracks(xyz: Float64[np.ndarray, "N 3"]) -> Visibility:
    """Visibility of points by projection only, thinned evenly to ``COARSE.max_points``."""
    return Visibility(strided(xyz, COARSE.max_points), np.empty(0, np.int64), {}, {})


def prior_from_baseline(
    views: Sequence[View], i: int, sources: Int64[np.ndarray, " K"]
) -> DepthPrior | None:
    """Depth range from 0.2 px of parallax (far) to one image width (near).

    Args:
        views: The photographs.
        i: The view.
        sources: The views that it is compared with, int64 [K]; -1 = none.

    Returns:
        The prior; None without sources, or where all have the view's own centre.
    """
    others = sources[sources >= 0]
    baselines = [np.linalg.norm(views[j].camera.center - views[i].camera.center) for j in others]
    # A sideways step b moves a point at inverse depth w by focal b w pixels.
    parallax = views[i].K[0, 0] * float(np.median(baselines)) if baselines else 0.0
    if not parallax > 0:
        return None
    return DepthPrior.from_range(COARSE.min_parallax / parallax, views[i].width / parallax)


def downsampled(view: View, side: int) -> View:
    """Downsample a view by a whole factor to about ``side`` pixels on its longer side."""
    factor = max(1, round(max(view.width, view.height) / side))
    image = block_means(view.photograph, factor)
    K = scaled(view.K, 1 / factor)
    mask = None
    if view.surface is not None:
        mask = block_means(view.surface[..., None].astype(np.uint8), factor)[..., 0] > 0
    camera = Camera(K, image.shape[1], image.shape[0], view.cam_from_world)
    return View(view.name, image, camera, mask)


def _inverse_depth_quantiles(
    views: Sequence[View], seed: int, progress: Progress
) -> Float64[np.ndarray, "V 3"]:
    """The 10%, 50% and 90% quantiles of each view's inverse depth, of the nearest sampled view."""
    poses = np.stack([view.cam_from_world for view in views])
    sources = choose_by_pose(poses, MATCHING.num_sources)
    sampled = evenly_spaced(len(views), COARSE.num_sampled)
    priors: list[DepthPrior | None] = [None] * len(views)
    for i in sampled:
        priors[i] = prior_from_baseline(views, int(i), sources[i])
    stereo = match_views(views, priors, sources, MATCHING, seed, progress)
    good = [stereo.planes[i][0][stereo.costs[i] < COARSE.max_sample_cost] for i in sampled]
    found = np.array([np.quantile(w, [0.1, 0.5, 0.9]) if len(w) else [np.nan] * 3 for w in good])
    if np.isnan(found).all():
        return np.ones((len(views), 3))
    found = np.where(np.isnan(found), np.nanmedian(found, axis=0), found)
    nearest = np.abs(np.arange(len(views))[:, None] - sampled).argmin(axis=1)
    return np.asarray(found[nearest])


def _hypothetical_points(
    views: Sequence[View], quantiles: Float64[np.ndarray, "V 3"]
) -> tuple[Float64[np.ndarray, "P 3"], list[Int64[np.ndarray, " M"]]]:
    """World points at the quantiles of each view's depth, and their rows within each view."""
    points = []
    for view, inverse in zip(views, quantiles, strict=True):
        # 5 x 4 positions in the image, at three depths each.
        relative = pixel_centers(4, 5).reshape(-1, 2) / [5, 4]
        uv = np.tile(relative * [view.width, view.height], (3, 1))
        points.append(view.camera.unproject(uv, np.repeat(1 / inverse, 20)))
    xyz = np.concatenate(points)
    return xyz, [points_in_image(view.camera, xyz).point_idx for view in views]
