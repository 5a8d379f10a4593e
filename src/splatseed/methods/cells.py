"""Voronoi cells of the originals: meshless ones (``_kernels.cells``), and the paper's in a box.

The paper's are SciPy's. The eight corners of the bounding box, enlarged by 10%, are further sites,
so that the cells of the originals are bounded. The volume of a cell is equation 6's, vol_i = E[|v -
c_i|]^3 over its vertices v and their mean c_i. Most of it lies in the cells of a few outer points
and reaches far outside the scene (``docs/paper.md``).
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import QhullError, Voronoi

from splatseed.errors import PointCloudError
from splatseed.methods.neighbors import PreparedCloud
from splatseed.progress import Progress


class Cells(NamedTuple):
    """Meshless cells of n sites, relative to the site.

    Vertices are clamped to half the distance of the k-th neighbour.
    """

    center: Float64[np.ndarray, "n 3"]  # mean of the vertices
    radius: Float64[np.ndarray, " n"]  # largest distance of a vertex from the centre
    volume: Float64[np.ndarray, " n"]  # within the cube
    closed: Bool[np.ndarray, " n"]  # whether it is the true Voronoi cell


ENLARGE = 0.1  # the paper's 10%


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
        diagram = Voronoi(np.concatenate([cloud.xyz, _corners(cloud.xyz)]))
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
