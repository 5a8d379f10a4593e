"""Voronoi upsampling (paper, eq. 6): new points where originals are sparse.

A cell is drawn with probability proportional to its volume, and the point is uniform in the ball
(c_i, r_i / 2) about the cell's centre; its colour comes from 5 neighbours.

Default: cells are clamped to half the distance of the 25th neighbour (``cells``), and the
probability is the volume relative to the median of the neighbours', capped at 8: otherwise all new
points go to the sparse background, most of them outside the scene. The 5 neighbours are the
cell's: its points lie close to them.
Paper: SciPy's Voronoi cells of the originals and the corners of the bounding box enlarged by 10%,
drawn by the volume vol_i = E[|v - c_i|]^3 of their vertices v (``cells``). The 5 neighbours are
those of the new point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from jaxtyping import Float64

from splatseed.methods._kernels import cells as kernels
from splatseed.methods._kernels.cells import MAX_NEIGHBORS
from splatseed.methods.cells import Cells, box_cells
from splatseed.methods.nearest import Aux, NearestMethod, colors_of_nearest, interpolate_colors
from splatseed.methods.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.methods.patches import local_frames
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, blocks
from splatseed.settings import Range

BLOCK = 1 << 14


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
    """Build the cells of all rows, block by block."""
    frames, _ = local_frames(cloud.xyz, neighbors.idx)
    n = len(neighbors.idx)
    cells = Cells(np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(n, bool))
    for first, last in blocks(n, BLOCK, "voronoi", progress):
        kernels.build_cells(
            cloud.xyz, neighbors.idx, neighbors.distance, frames, first, last, *cells
        )
    return cells
