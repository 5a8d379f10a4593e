"""Initialise Gaussians from seeds, without PyTorch.

Equal seeds and views give equal Gaussians for any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float32, Float64
from numpy.lib.stride_tricks import sliding_window_view
from scipy.spatial import cKDTree

from splatseed.errors import PointCloudError
from splatseed.photos.camera_check import camera_centers
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.splat.gaussians import SH_C0, SH_C1, Gaussians

NEIGHBORS = 3  # whose mean square distance is a Gaussian's first size, as in 3DGS
COINCIDENT, GAP = 1e-2, 10.0
"""Bounds of a first size, relative to the median: beyond the second a point is isolated, and below
the first it would stay invisible."""
OWN, EVEN = 0.3, 1.0
"""Weights, in photographs, of a seed's own colour, and of the prior against view dependence, which
few views do not determine."""
CELL = 4.0  # side in pixels of the cells within which seeds occlude each other
LEAST_VIEWS, MOST_PROJECTIONS = 16, 50_000_000
"""An even subset of the views, but never fewer than the first, is used beyond as many seeds times
views as the second."""


def initial_gaussians(
    seeds: PointCloud,
    *,
    sh_degree: int = 3,
    opacity: float = 0.1,
    scale_factor: float = 1.0,
    largest: Float[np.ndarray, " N"] | None = None,
    flatness: float = 0.1,
    harmonics: Float32[np.ndarray, "N 4 3"] | None = None,
) -> Gaussians:
    """One Gaussian per seed, as large as the seed or, if that is unknown, the gap to 3 neighbours.

    It is round, or a disc perpendicular to the seed's normal if that is known, ``flatness`` of its
    size thick. Sizes are multiplied by ``scale_factor`` and bounded by ``largest``. Seeds are
    finite; ``harmonics`` of degree 1 replace their constant colours.

    Raises:
        PointCloudError: Fewer than two distinct finite points.
    """
    count, rest = len(seeds), (sh_degree + 1) ** 2 - 1
    sizes = neighbor_distances(seeds.xyz)
    if seeds.sizes is not None:
        sizes = np.where(np.isnan(seeds.sizes), sizes, seeds.sizes.astype(np.float64))
    sizes = sizes * scale_factor
    if largest is not None:
        sizes = np.minimum(sizes, largest)
    scales = np.repeat(np.log(sizes)[:, None], 3, axis=1)
    quats = np.tile(np.array([1.0, 0, 0, 0]), (count, 1))
    if seeds.normals is not None:
        known = ~np.isnan(seeds.normals[:, 0])
        # The third axis is the normal's.
        scales[known, 2] += np.log(flatness)
        quats[known] = _quats_to(seeds.normals[known])
    # colour = 1/2 + C0 sh0; no dependence on direction at first
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
    """Unit wxyz quaternions of the shortest rotations of the z axis onto normals or opposites."""
    # From z to n it is (1 + n_z, z x n), normalised; a disc has no front: that never vanishes for
    # the n with n_z >= 0.
    front = normals.astype(np.float64) * np.where(normals[:, 2:] < 0, -1.0, 1.0)
    x, y, z = (front / np.linalg.norm(front, axis=1, keepdims=True)).T
    quats = np.stack([1.0 + z, -y, x, np.zeros_like(z)], axis=1)
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True))


def neighbor_distances(xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, " N"]:
    """Root mean square distance to the 3 nearest as in 3DGS, bounded relative to the median."""
    squares = np.zeros(len(xyz))
    if len(xyz) > 1:
        # An unbalanced tree is built several times faster and queried as fast.
        tree = cKDTree(xyz, balanced_tree=False, compact_nodes=False)
        distances, _ = tree.query(xyz, k=min(NEIGHBORS, len(xyz) - 1) + 1, workers=-1)
        squares = (distances[:, 1:] ** 2).mean(axis=1)
    if not (squares > 0).any():
        raise PointCloudError(
            "at least 2 distinct finite points to start from",
            found=f"{len(xyz)} points in one place",
            fix="Check that the scene was read correctly (splatseed info SCENE).",
        )
    median = np.sqrt(np.median(squares[squares > 0]))
    return np.asarray(np.clip(np.sqrt(squares), COINCIDENT * median, GAP * median))


def fit_harmonics(seeds: PointCloud, views: Sequence[View]) -> Float32[np.ndarray, "N 4 3"]:
    """Coefficients h of each seed: ridge regression over the views that see it.

    Along the unit direction d from a camera, the colour is 1/2 + sum_k y_k(d) h_k with the real
    spherical harmonics up to degree 1 in 3DGS's order and signs, y = (C0, -C1 d_y, C1 d_z, -C1
    d_x). With the colours p_v seen along d_v, and the seed's own colour p, h is the least of
    sum_v |1/2 + y(d_v) h - p_v|^2 + OWN |1/2 + C0 h_0 - p|^2 + EVEN |C1 h_1..3|^2 in each colour
    channel. A seed that no view sees keeps its colour. Views are in the seeds' frame.
    """
    # Loads Numba, for which `upsample --help` would wait.
    from splatseed.photos.zbuffer import visible_points  # noqa: PLC0415

    xyz = np.ascontiguousarray(seeds.xyz, np.float32)
    # Normal equations; OWN and EVEN make them regular even for a seed that no view sees.
    normal = np.tile(np.diag([OWN * SH_C0**2, *[EVEN * SH_C1**2] * 3]), (len(xyz), 1, 1))
    right = np.zeros((len(xyz), 4, 3))
    right[:, 0] = OWN * SH_C0 * (seeds.rgb / 255.0 - 0.5)
    most = max(LEAST_VIEWS, MOST_PROJECTIONS // max(1, len(xyz)))
    asked = np.linspace(0, len(views) - 1, min(most, len(views))).round().astype(int)
    for view in [views[i] for i in np.unique(asked)]:
        index, uv, _ = visible_points(view.camera, xyz, CELL, view.mask)
        column, row = uv.astype(np.int64).T
        sight = xyz[index].astype(np.float64) - camera_centers([view])[0]
        d = sight / np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-12)
        ones = np.full(len(d), SH_C0)
        basis = np.stack([ones, -SH_C1 * d[:, 1], SH_C1 * d[:, 2], -SH_C1 * d[:, 0]], axis=1)
        # Mean colours of the 3 x 3 pixels around; border pixels are repeated.
        framed = np.pad(view.photograph, ((1, 1), (1, 1), (0, 0)), "edge")
        around = sliding_window_view(framed, (3, 3), axis=(0, 1))[row, column]
        colors = around.sum(axis=(2, 3)) / (9 * 255.0) - 0.5
        normal[index] += basis[:, :, None] * basis[:, None, :]
        right[index] += basis[:, :, None] * colors[:, None, :]
    return np.linalg.solve(normal, right).astype(np.float32)
