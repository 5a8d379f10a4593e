"""Voronoi upsampling (paper, eq. 6): new points where originals are sparse.

A cell is drawn with probability proportional to its volume, and the point is uniform in the ball
(c_i, r_i / 2) about the cell's centre; its colour comes from 5 neighbours.

Default: cells are clamped to half the distance of the 25th neighbour (``_kernels.cells``), and the
probability is the volume relative to the median of the neighbours', capped at 8: otherwise all new
points go to the sparse background, most of them outside the scene. The 5 neighbours are the
cell's: its points lie close to them.
Paper: SciPy's Voronoi cells of the originals and the corners of the bounding box enlarged by 10%,
which bound them, drawn by the volume vol_i = E[|v - c_i|]^3 of their vertices v. Most of it lies in
the cells of a few outer points and reaches far outside the scene (``docs/paper.md``). The 5
neighbours are those of the new point.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import QhullError, Voronoi as Diagram

from splatseed.errors import PointCloudError
from splatseed.methods._kernels import cells as kernels
from splatseed.methods._kernels.cells import MAX_NEIGHBORS
from splatseed.methods.nearest import Aux, NearestMethod, colors_of_nearest, interpolate_colors
from splatseed.methods.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.methods.patches import local_frames
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.settings import Range

BLOCK = 1 << 14
ENLARGE = 0.1  # the paper's 10%


@dataclass(frozen=True)
class Voronoi(NearestMethod):
    """Points in the Voronoi cells of the originals, more where cells are large (eq. 6)."""

    k: Annotated[int, Range(4, MAX_NEIGHBORS)] = 25
    """Neighbours that shape a cell; half the distance of the last bounds it."""
    cells: Literal["clamped", "box"] = "clamped"
    """Cells clamped to their neighbourhood, or SciPy's in the enlarged bounding box (paper:
    box)."""
    ball: Annotated[float, Range(above=0, maximum=1)] = 0.5
    """Radius of the ball for new points, as a fraction of the cell's radius (paper: 0.5)."""
    color_k: Annotated[int, Range(1, "k")] = 5
    """Nearest originals that colour a new point (paper: 5)."""
    max_weight: Annotated[float, Range(1)] = 8.0
    """Cap on a cell's volume relative to the median of its neighbours' (clamped cells only)."""

    name: ClassVar[str] = "voronoi"
    min_points: ClassVar[int] = 4

    @classmethod
    def paper(cls) -> Self:
        """Return cells in the bounding box enlarged by 10%, drawn by equation 6's volume."""
        return cls(cells="box", reject_isolated=False)

    @property
    def num_neighbors(self) -> int:
        """Neighbours that shape a cell."""
        return self.k

    def base_weights(
        self, cloud: PreparedCloud, neighbors: Neighbors, progress: Progress
    ) -> tuple[Float64[np.ndarray, " n"], Aux]:
        """Return weights by volume, and the cells' centres [n, 3] and radii [n]."""
        weight, _ = super().base_weights(cloud, neighbors, progress)
        neighbors = neighbors.nearest(self.k)
        if self.cells == "box":
            center, radius, volume = box_cells(cloud, progress)
            return weight * volume, {"center": center, "radius": radius}
        center, radius, volume, _ = _clamped_cells(cloud, neighbors, progress)
        relative = np.empty(len(cloud))
        kernels.relative_volume(volume, neighbors.idx, float(self.max_weight), relative)
        weight = weight * relative
        return weight, {"center": center, "radius": radius}

    def sample(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        aux: Aux,
        bases: Bases,
        rng: np.random.Generator,
        progress: Progress,
    ) -> PointCloud:
        """Draw the points of all bases in the balls of their cells."""
        frames, _ = local_frames(cloud.xyz, neighbors.idx)
        xyz = rng.random((bases.total, 3), dtype=np.float32)
        local = xyz.copy() if self.cells == "box" else xyz[:0]
        balls = aux["center"], self.ball * aux["radius"], frames, bases.start, bases.count
        kernels.sample_balls(cloud.xyz, cloud.center, *balls, xyz)
        if self.cells == "box":
            kernels.sample_balls(cloud.xyz, np.zeros(3), *balls, local)
            rgb = colors_of_nearest(cloud, neighbors, local, self.color_k, progress)
        else:
            rgb = interpolate_colors(cloud, neighbors.nearest(self.color_k), bases, xyz)
        return PointCloud(xyz, rgb)


def _clamped_cells(cloud: PreparedCloud, neighbors: Neighbors, progress: Progress) -> Cells:
    frames, _ = local_frames(cloud.xyz, neighbors.idx)
    n = len(neighbors.idx)
    cells = Cells(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, bool))
    for first, last in blocks(n, BLOCK, "voronoi", progress):
        kernels.build_cells(
            cloud.xyz, neighbors.idx, neighbors.distance, frames, first, last, *cells
        )
    return cells


class Cells(NamedTuple):
    """Meshless cells of n sites, relative to the site.

    Vertices are clamped to half the distance of the k-th neighbour.
    """

    center: Float64[np.ndarray, "n 3"]  # mean of the vertices
    radius: Float64[np.ndarray, " n"]  # largest distance of a vertex from the centre
    volume: Float64[np.ndarray, " n"]  # within the cube
    closed: Bool[np.ndarray, " n"]  # whether it is the true Voronoi cell


def box_cells(
    cloud: PreparedCloud, progress: Progress
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Compute each cell's centre relative to the site, radius and volume (equation 6).

    The centre c_i is the mean of the vertices, the radius the largest distance of one from it.

    Raises:
        PointCloudError: Qhull fails, as it can on coplanar input.
    """
    progress("voronoi", 0.0)
    try:
        diagram = Diagram(np.concatenate([cloud.xyz, _corners(cloud.xyz)]))
    except QhullError as error:
        raise PointCloudError(
            "a cloud that Qhull can build a Voronoi diagram of",
            found=str(error).splitlines()[0],
            fix='Use the default profile (voronoi.cells "clamped"), which has no such limit.',
        ) from error
    progress("voronoi", 0.6)
    n = len(cloud)
    # A site that Qhull merges with another has no region (-1).
    regions = [
        diagram.regions[region] if region >= 0 else [] for region in diagram.point_region[:n]
    ]
    site = np.repeat(np.arange(n), [len(region) for region in regions])
    vertex = np.fromiter(itertools.chain.from_iterable(regions), np.int64, len(site))
    site, vertex = site[vertex >= 0], vertex[vertex >= 0]  # -1: the one at infinity
    xyz = diagram.vertices[vertex] - cloud.xyz[site]
    count = np.maximum(np.bincount(site, minlength=n), 1)
    center = np.stack([np.bincount(site, axis, n) for axis in xyz.T], axis=1) / count[:, None]
    distance = np.linalg.norm(xyz - center[site], axis=1)
    radius = np.zeros(n)
    np.maximum.at(radius, site, distance)
    progress("voronoi", 1.0)
    return center, radius, (np.bincount(site, distance, n) / count) ** 3


def _corners(xyz: np.ndarray) -> np.ndarray:
    """Return the corners [8, 3] of the bounding box enlarged by 10%."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    # A flat cloud gets a box of some thickness, or the corners would coincide.
    half = np.maximum((high - low) / 2, 1e-3 * (high - low).max()) * (1 + ENLARGE)
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return np.asarray((low + high) / 2 + signs * half)
