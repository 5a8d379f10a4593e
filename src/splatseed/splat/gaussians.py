"""Gaussians as the optimiser sees them, made from seeds, and the frame that they are trained in.

Notation: N Gaussians; ``means`` [N, 3], ``scales`` [N, 3] as logarithms, ``quats`` [N, 4] wxyz of
any length, ``opacities`` [N] as logits, ``sh0`` [N, 1, 3], ``shN`` [N, 15, 3]: gsplat's names and
conventions. In the training frame the cameras' centroid is at 0 and the farthest camera at distance
1, ``x_train = scale (x_world - origin)``; a *stray* camera, of a wrong pose, has no part in it
(``views.sight``). The *near plane* is a length of its own: it follows from the depths that cameras
see, not from how far they stand apart, which on a walk is a thousand times as much. Promise: no
PyTorch; equal seeds and views give equal Gaussians, whatever the number of threads. The frame
depends on the training cameras alone, strays and near plane also on the scene's own points, so that
runs from different seeds are compared in one frame; only without points do new ones tell. Single
precision suffices there for distant origins.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int64
from numpy.lib.stride_tricks import sliding_window_view

from splatseed.errors import PointCloudError
from splatseed.frozen import read_only
from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file
from splatseed.photos.sight import camera_centers, sight_of
from splatseed.photos.view import NEAR_PLANE, View
from splatseed.pointcloud import PointCloud
from splatseed.splat.ply_layout import encode_layout

PARAMETERS = ("means", "scales", "quats", "opacities", "sh0", "shN")
"""The names of a Gaussian's arrays, in order."""
SH_C0 = 0.28209479177387814
"""The spherical harmonic of degree 0, 1 / (2 sqrt(pi)); colour = 0.5 + SH_C0 * sh0."""
SH_C1 = 0.4886025119029199  # of degree 1, sqrt(3 / (4 pi))
SCENE_SCALE = 1.1
"""Scene size for the strategies and the learning rate of positions: the cameras' extent plus a
tenth, as in 3DGS."""
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
NEAR_SHARE = 0.01
"""The near plane, as a share of the near depth of what the cameras see (``views.sight``): a hundred
times nearer than nine tenths of the points of any view. What a camera really sees is seldom ten
times nearer than that; a Gaussian a hundred times nearer sits in the lens, where it covers the
picture of one view and is seen by no other."""
VISIBLE = -2.2  # logit of the least opacity, a tenth, of Gaussians that show where a scene is
NOWHERE = np.empty((0, 3), np.float32)  # no points are known


@dataclass(frozen=True, eq=False)
class Gaussians:
    """N Gaussians, as 3DGS's .ply and gsplat's parameter dict hold them; float32, read-only.

    ``ss.read_gaussians`` reads them, ``ss.render`` renders them; ``dataclasses.replace`` and
    ``select`` make others. Spherical harmonics have degree 0 to 3: K = 0, 3, 8 or 15.
    """

    means: Float32[np.ndarray, "N 3"]  # positions
    scales: Float32[np.ndarray, "N 3"]  # logarithms of standard deviations
    quats: Float32[np.ndarray, "N 4"]  # wxyz, of any length but 0
    opacities: Float32[np.ndarray, " N"]  # logits: 1 / (1 + exp(-x)) is the opacity
    sh0: Float32[np.ndarray, "N 1 3"]  # of harmonics: 0.5 + 0.2821 sh0 is the mean sRGB colour
    shN: Float32[np.ndarray, "N K 3"]  # noqa: N815  (gsplat's name)  # of higher degrees
    antialiased: bool = False  # trained, and to be rendered, with ``rasterize_mode="antialiased"``

    def __post_init__(self) -> None:
        for name in PARAMETERS:
            object.__setattr__(self, name, read_only(getattr(self, name)))

    def __len__(self) -> int:
        return len(self.means)

    def __repr__(self) -> str:
        blur = ", antialiased" if self.antialiased else ""
        return f"Gaussians({len(self):,}, SH degree {self.sh_degree}{blur})"

    @property
    def sh_degree(self) -> int:
        """The degree of the spherical harmonics."""
        return math.isqrt(1 + self.shN.shape[1]) - 1

    @property
    def num_bytes(self) -> int:
        """Bytes of the parameters as float32: 236 per Gaussian at degree 3."""
        return sum(array.nbytes for array in self.arrays().values())

    def arrays(self) -> dict[str, Float32[np.ndarray, "N ..."]]:
        """The parameters by name, in the order above."""
        return {name: getattr(self, name) for name in PARAMETERS}

    def select(self, index: Bool[np.ndarray, " N"] | Int64[np.ndarray, " M"]) -> Gaussians:
        """Some of the Gaussians, by index or mask."""
        parts = {name: array[index] for name, array in self.arrays().items()}
        return dataclasses.replace(self, **parts)

    def write_ply(self, path: StrPath) -> None:
        """Write them as 3DGS's .ply, which every viewer and trainer reads; replaces a file there.

        Raises:
            OutputError: It cannot be written.
        """
        with atomic_file(Path(path)) as partial, partial.open("wb") as file:
            file.writelines(encode_layout(self.arrays(), self.antialiased))


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
    from scipy.spatial import cKDTree  # noqa: PLC0415  (slow to import)

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
    from splatseed.photos.zbuffer import visible_points  # noqa: PLC0415  (kernels)

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


@dataclass(frozen=True, eq=False)
class TrainingFrame:
    """A similarity without rotation."""

    origin: Float64[np.ndarray, " 3"]  # the point of the world that becomes 0
    scale: float  # training units per world unit
    near: float = NEAR_PLANE  # the near plane, in training units
    strays: tuple[str, ...] = ()  # names of the views that set neither scale nor near plane

    @property
    def near_depth(self) -> float:
        """The depth at which what cameras see begins (``views.sight``), in training units."""
        return self.near / NEAR_SHARE

    def points_from_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float32[np.ndarray, "N 3"]:
        """World points in the training frame."""
        return np.asarray((xyz.astype(np.float64) - self.origin) * self.scale, np.float32)

    def cloud_from_world(self, cloud: PointCloud) -> PointCloud:
        """A cloud of the world in the training frame: positions and sizes change, normals stay."""
        moved = cloud.replace(xyz=self.points_from_world(cloud.xyz))
        if cloud.sizes is None:
            return moved
        limits = np.finfo(np.float32)
        sizes = np.clip(cloud.sizes.astype(np.float64) * self.scale, limits.tiny, limits.max)
        return moved.replace(sizes=sizes)

    def gaussians_from_world(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the world in the training frame."""
        return dataclasses.replace(
            gaussians,
            means=self.points_from_world(gaussians.means),
            scales=gaussians.scales + np.float32(np.log(self.scale)),  # logarithms
        )

    def points_to_world(self, xyz: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
        """Points of the training frame in the world."""
        return np.asarray(xyz.astype(np.float64) / self.scale + self.origin)

    def gaussians_to_world(self, gaussians: Gaussians) -> Gaussians:
        """Gaussians of the training frame in the world, float32 there; harmonics do not turn."""
        return dataclasses.replace(
            gaussians,
            means=self.points_to_world(gaussians.means).astype(np.float32),
            scales=gaussians.scales - np.float32(np.log(self.scale)),
        )

    def view(self, view: View) -> View:
        """The same view, its camera posed in the training frame, with the frame's near plane."""
        cam_from_train = np.array(view.cam_from_world)
        rotation, translation = view.cam_from_world[:3, :3], view.cam_from_world[:3, 3]
        # x_cam = R x + t = (R x_train + s (R o + t)) / s: the same image, depths times s.
        cam_from_train[:3, 3] = self.scale * (rotation @ self.origin + translation)
        return dataclasses.replace(view.posed(cam_from_train), near=self.near)


def frame_of_model(
    views: Sequence[View], points: Float[np.ndarray, "P 3"], gaussians: Gaussians | None
) -> TrainingFrame:
    """The training frame that a model is rendered in; without points its Gaussians replace them."""
    if len(points) or gaussians is None:
        return training_frame(views, points)
    shown = gaussians.opacities > VISIBLE
    return training_frame(views, gaussians.means[shown & np.isfinite(gaussians.means).all(axis=1)])


def training_frame(
    views: Sequence[View], points: Float[np.ndarray, "P 3"] = NOWHERE
) -> TrainingFrame:
    """The frame of these cameras without the strays; only a translation if all are in one place.

    ``points`` are finite and show where the scene is: ``PointCloud.references``, or Gaussians.
    """
    centers, sight = camera_centers(views), sight_of(views, points)
    usual = centers[~sight.strays]
    origin = usual.mean(axis=0)
    extent = float(np.linalg.norm(usual - origin, axis=1).max())
    rounding = 1e-9 * float(np.abs(usual).max())  # of which the extent of one place may be
    scale = 1.0 / extent if extent > rounding else 1.0
    near = NEAR_PLANE if sight.near is None else NEAR_SHARE * sight.near * scale
    names = (view.name for view, stray in zip(views, sight.strays, strict=True) if stray)
    return TrainingFrame(origin, scale, near, tuple(names))
