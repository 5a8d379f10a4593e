"""Initialise Gaussians from seeds, without PyTorch.

Equal seeds and views give equal Gaussians for any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.sampling import evenly_spaced
from splatseed.splat.gaussians import SH_C0, SH_C1, Gaussians


@dataclass(frozen=True)
class InitializationSettings:
    """Constants of the first sizes and colours of Gaussians."""

    num_neighbors: int = 3  # whose mean square distance gives the first size, as in 3DGS
    min_size: float = 1e-2  # of the median size: a smaller Gaussian would stay invisible
    max_size: float = 10.0  # of the median size: a seed with a larger gap is isolated
    color_weight: float = 0.3  # of a seed's own colour, in photographs
    smoothness_weight: float = 1.0  # of the prior against view dependence, in photographs
    occlusion_cell: float = 4.0  # px; side of the cells within which seeds occlude each other
    min_views: int = 16  # used to fit colours, whatever the number of seeds
    max_projections: int = (
        50_000_000  # seeds times views; beyond it an even subset of views is used
    )


INITIALIZATION = InitializationSettings()


def initial_gaussians(
    seeds: PointCloud,
    *,
    sh_degree: int = 3,
    opacity: float = 0.1,
    scale_factor: float = 1.0,
    max_sizes: Float[np.ndarray, " N"] | None = None,
    flatness: float = 0.1,
    harmonics: Float32[np.ndarray, "N 4 3"] | None = None,
) -> Gaussians:
    """Make one Gaussian per finite seed, as large as the seed.

    A seed of unknown size takes the gap to its 3 nearest neighbours. A seed with a normal becomes a
    disc perpendicular to it, ``flatness`` times as thick as wide; others become spheres. Sizes are
    multiplied by ``scale_factor`` and bounded by ``max_sizes``. ``harmonics`` of degree 1 replace
    the seeds' constant colours.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    count, rest = len(seeds), (sh_degree + 1) ** 2 - 1
    sizes = neighbor_distances(seeds.xyz)
    if seeds.sizes is not None:
        sizes = np.where(np.isnan(seeds.sizes), sizes, seeds.sizes.astype(np.float64))
    sizes = sizes * scale_factor
    if max_sizes is not None:
        sizes = np.minimum(sizes, max_sizes)
    scales = np.repeat(np.log(sizes)[:, None], 3, axis=1)
    quats = np.tile(np.array([1.0, 0, 0, 0]), (count, 1))
    if seeds.normals is not None:
        known = ~np.isnan(seeds.normals[:, 0])
        # The third axis is the normal's.
        scales[known, 2] += np.log(flatness)
        quats[known] = _quats_to(seeds.normals[known])
    # colour = 1/2 + C0 sh0, independent of the direction
    sh0, sh_rest = (seeds.rgb / 255.0 - 0.5) / SH_C0, np.zeros((count, rest, 3), np.float32)
    if harmonics is not None:
        sh0, first = harmonics[:, 0], harmonics[:, 1 : rest + 1]
        sh_rest[:, : first.shape[1]] = first
    return Gaussians(
        means=np.array(seeds.xyz, np.float32),
        scales=scales.astype(np.float32),
        quats=quats.astype(np.float32),
        # logit, the inverse of the sigmoid
        opacities=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh0=sh0.astype(np.float32)[:, None],
        shN=sh_rest,
    )


def _quats_to(normals: Float32[np.ndarray, "M 3"]) -> Float64[np.ndarray, "M 4"]:
    """Return unit wxyz quaternions of the shortest rotations from the z axis to ± each normal."""
    # From z to n: (1 + n_z, z x n), normalised. A disc has no front, so n_z >= 0 can be chosen, for
    # which the quaternion never vanishes.
    front = normals.astype(np.float64) * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    x, y, z = (front / np.linalg.norm(front, axis=1, keepdims=True)).T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))


def neighbor_distances(xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
    """Return the RMS distance to the 3 nearest neighbours, as in 3DGS, bounded by the median."""
    squares = np.zeros(len(xyz))
    if len(xyz) > 1:
        # An unbalanced tree is built several times faster and queried as fast.
        tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
        order = tree.indices  # of its leaves: a query near the last one finds them in the cache
        k = min(INITIALIZATION.num_neighbors, len(xyz) - 1) + 1
        distances, _ = tree.query(xyz[order], k=k, workers=-1)
        squares[order] = (distances[:, 1:] ** 2).mean(axis=1)
    if not (squares > 0).any():
        raise PointCloudError(
            "at least 2 distinct finite points to start from",
            found=f"{len(xyz)} points in one place",
            fix="Check that the scene was read correctly (splatseed info SCENE).",
        )
    median = np.sqrt(np.median(squares[squares > 0]))
    return np.asarray(
        np.clip(
            np.sqrt(squares), INITIALIZATION.min_size * median, INITIALIZATION.max_size * median
        )
    )


def fit_harmonics(seeds: PointCloud, views: Sequence[View]) -> Float32[np.ndarray, "N 4 3"]:
    """Fit harmonics h of degree 1 to each seed by ridge regression over the views that see it.

    Along the unit direction d from a camera, the colour is 1/2 + sum_k y_k(d) h_k with the real
    spherical harmonics up to degree 1 in 3DGS's order and signs, y = (C0, -C1 d_y, C1 d_z, -C1
    d_x). With the colours p_v seen along d_v, and the seed's own colour p, h minimises
    sum_v |1/2 + y(d_v) h - p_v|^2 + w_c |1/2 + C0 h_0 - p|^2 + w_s |C1 h_1..3|^2 in each colour
    channel, with w_c ``color_weight`` and w_s ``smoothness_weight``. A seed that no view sees keeps
    its colour. Views are in the seeds' frame.
    """
    # Loads Numba, for which `upsample --help` would wait.
    from splatseed.photos.zbuffer import visible_points  # noqa: PLC0415

    xyz = np.ascontiguousarray(seeds.xyz, np.float32)
    # Normal equations; the priors make them regular even for a seed that no view sees.
    priors = [
        INITIALIZATION.color_weight * SH_C0**2,
        *[INITIALIZATION.smoothness_weight * SH_C1**2] * 3,
    ]
    normal = np.tile(np.diag(priors), (len(xyz), 1, 1))
    right = np.zeros((len(xyz), 4, 3))
    right[:, 0] = INITIALIZATION.color_weight * SH_C0 * (seeds.rgb / 255.0 - 0.5)
    limit = max(INITIALIZATION.min_views, INITIALIZATION.max_projections // max(1, len(xyz)))
    for view in [views[i] for i in evenly_spaced(len(views), limit)]:
        index, uv, _ = visible_points(view.camera, xyz, INITIALIZATION.occlusion_cell, view.surface)
        column, row = uv.astype(np.int64).T
        offsets = xyz[index].astype(np.float64) - view.camera.center
        d = offsets / np.maximum(np.linalg.norm(offsets, axis=1, keepdims=True), 1e-12)
        ones = np.full(len(d), SH_C0)
        basis = np.stack([ones, -SH_C1 * d[:, 1], SH_C1 * d[:, 2], -SH_C1 * d[:, 0]], axis=1)
        # Mean colours of 3 x 3 pixels; border pixels are repeated.
        padded = np.pad(view.photograph, ((1, 1), (1, 1), (0, 0)), "edge")
        windows = sliding_window_view(padded, (3, 3), axis=(0, 1))[row, column]
        colors = windows.sum(axis=(2, 3)) / (9 * 255.0) - 0.5
        normal[index] += basis[:, :, None] * basis[:, None, :]
        right[index] += basis[:, :, None] * colors[:, None, :]
    return np.linalg.solve(normal, right).astype(np.float32)
