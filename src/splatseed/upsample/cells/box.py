"""The paper's Voronoi cells: those of the originals and the corners of an enlarged bounding box.

The eight corners of the bounding box, enlarged by 10%, are added as sites so that the cells of the
originals are bounded. Most of the volume then lies in the cells of a few outer points and reaches
far outside the scene; ``docs/paper.md`` measures it. For reproducing the paper only.

The cells come from Qhull's Delaunay tetrahedra, whose circumcentres are the Voronoi vertices. A
cell's volume is the signed sum, over the tetrahedra at its site i and the ways to pick an edge ij
and a face ijk of each, of the tetrahedra (i, middle of ij, circumcentre of ijk, circumcentre).
"""

from __future__ import annotations

import itertools

import numpy as np
from jaxtyping import Float64
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import Delaunay, QhullError

from splatseed.errors import PointCloudError
from splatseed.kernels.jit import inline
from splatseed.progress import Progress
from splatseed.upsample.neighbors import PreparedCloud

ENLARGE = 0.1
"""The paper's 10%."""
FLAT = 1e-14
"""Tetrahedra flatter than this, relative to their edges, have no usable circumcentre."""
SAME = 1e-9
"""Circumcentres of neighbours closer than this, in circumradii, are one Voronoi vertex."""


def box_cells(
    cloud: PreparedCloud, progress: Progress
) -> tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, " n"], Float64[np.ndarray, " n"]]:
    """Centre relative to the site [n, 3], radius [n] and volume [n] of each original's cell.

    The centre is the mean of the cell's vertices, the radius the largest distance of a vertex from
    it.

    Raises:
        PointCloudError: Qhull fails, as it can on coplanar input.
    """
    progress("voronoi", 0.0)
    sites = np.concatenate([cloud.xyz, _corners(cloud.xyz)])
    try:
        delaunay = Delaunay(sites)
    except QhullError as error:
        raise PointCloudError(
            "a cloud that Qhull can build a Voronoi diagram of",
            found=str(error).splitlines()[0],
            fix='Use the default profile (voronoi.cells "clamped"), which has no such limit.',
        ) from error
    progress("voronoi", 0.6)
    tetrahedra = delaunay.simplices
    vertex = _circumcenters(sites, tetrahedra)
    once = _count_once(sites, tetrahedra, delaunay.neighbors, vertex)
    center, radius, volume = _cells(sites, tetrahedra, vertex, once)
    progress("voronoi", 1.0)
    n = len(cloud)
    return center[:n] - cloud.xyz, radius[:n], np.maximum(volume[:n], 0.0)


def _corners(xyz: np.ndarray) -> np.ndarray:
    """Corners [8, 3] of the bounding box enlarged by 10% about its middle."""
    low, high = xyz.min(axis=0), xyz.max(axis=0)
    # A flat cloud gets a box of some thickness, or the corners would coincide.
    half = np.maximum((high - low) / 2, 1e-3 * (high - low).max()) * (1 + ENLARGE)
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    return np.asarray((low + high) / 2 + signs * half)


def _count_once(
    sites: np.ndarray, tetrahedra: np.ndarray, neighbors: np.ndarray, vertex: np.ndarray
) -> np.ndarray:
    """Where a cell meets a vertex for the first time, 1.0 or 0.0 for every corner [T, 4].

    Qhull cuts cospherical sites, such as four corners of the box and a point, into tetrahedra that
    share one Voronoi vertex; a cell's mean must not count it twice.
    """
    here, there = np.repeat(np.arange(len(vertex)), 4), neighbors.ravel()
    gap = np.linalg.norm(vertex[here] - vertex[there], axis=1)
    circumradius = np.linalg.norm(vertex - sites[tetrahedra[:, 0]], axis=1)
    same = (there >= 0) & (gap <= SAME * circumradius[here])
    links = coo_array((same[same], (here[same], there[same])), shape=(len(vertex), len(vertex)))
    label = connected_components(links, directed=False)[1]
    meeting = tetrahedra.astype(np.int64) * len(vertex) + label[:, None]
    once = np.zeros(meeting.size)
    once[np.unique(meeting, return_index=True)[1]] = 1.0
    return once.reshape(-1, 4)


@inline
def _circumcenters(sites, tetrahedra):  # type: ignore[no-untyped-def]  # Numba's types
    """Circumcentre of every tetrahedron [T, 3], NaN where it is too flat to have one."""
    vertex = np.empty((len(tetrahedra), 3))
    for t in range(len(tetrahedra)):
        if not _circumcenter(sites, tetrahedra[t], vertex[t]):
            vertex[t] = np.nan
    return vertex


@inline
def _cells(sites, tetrahedra, vertex, once):  # type: ignore[no-untyped-def]  # Numba's types
    """Centre, radius and volume of every site's cell, in one serial (so deterministic) pass."""
    n = len(sites)
    center, count = np.zeros((n, 3)), np.zeros(n)
    radius, volume = np.zeros(n), np.zeros(n)
    for t in range(len(tetrahedra)):
        if np.isfinite(vertex[t, 0]):
            for corner in range(4):
                i = tetrahedra[t, corner]
                center[i] += once[t, corner] * vertex[t]
                count[i] += once[t, corner]
            _add_volumes(sites, tetrahedra[t], vertex[t], volume)
    for i in range(n):
        center[i] /= max(count[i], 1.0)
    for t in range(len(tetrahedra)):
        if np.isfinite(vertex[t, 0]):
            for i in tetrahedra[t]:
                radius[i] = max(radius[i], np.sqrt(np.sum((vertex[t] - center[i]) ** 2)))
    return center, radius, volume


@inline
def _cross(a, b):  # type: ignore[no-untyped-def]  # Numba's types
    return np.array(
        (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
    )


@inline
def _circumcenter(sites, corners, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Write a tetrahedron's circumcentre; return whether it exists."""
    a = sites[corners[1]] - sites[corners[0]]
    b = sites[corners[2]] - sites[corners[0]]
    c = sites[corners[3]] - sites[corners[0]]
    aa, bb, cc = np.sum(a * a), np.sum(b * b), np.sum(c * c)
    bc = _cross(b, c)
    six_volumes = np.sum(a * bc)
    if six_volumes * six_volumes <= FLAT * FLAT * aa * bb * cc:
        return False
    # The x with 2 x . a = |a|^2, 2 x . b = |b|^2, 2 x . c = |c|^2
    offset = (aa * bc + bb * _cross(c, a) + cc * _cross(a, b)) / (2.0 * six_volumes)
    out[:] = sites[corners[0]] + offset
    return True


@inline
def _face_center(a, b):  # type: ignore[no-untyped-def]  # Numba's types
    """Circumcentre of the triangle 0, a, b."""
    normal = _cross(a, b)
    aa, bb = np.sum(a * a), np.sum(b * b)
    return _cross(aa * b - bb * a, normal) / (2.0 * np.sum(normal * normal))


@inline
def _add_volumes(sites, corners, vertex, volume):  # type: ignore[no-untyped-def]  # Numba's types
    """Add one tetrahedron's volume to the cells of its four corners."""
    for i in range(4):
        origin = sites[corners[i]]
        for j in range(4):
            for k in range(4):
                if len({i, j, k}) == 3:
                    edge, other = sites[corners[j]] - origin, sites[corners[k]] - origin
                    last = sites[corners[6 - i - j - k]] - origin
                    face = _face_center(edge, other)
                    # Six times the signed volume of (i, middle of ij, face's and own circumcentre).
                    signed = np.sum(0.5 * edge * _cross(face, vertex - origin))
                    inside = np.sum(edge * _cross(other, last))
                    # The sign of (j, k, last) tells on which side of the face the tetrahedron lies.
                    share = np.sign(inside) * signed / 6.0
                    if np.isfinite(share):
                        volume[corners[i]] += share
