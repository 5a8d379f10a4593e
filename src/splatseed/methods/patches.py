"""Height-field patches: the steps of a method that fits a surface around every base point.

Around a base point p with k neighbours stands a frame: the rows e_u, e_v (the tangent plane, widest
axis first) and e_n (the normal) of ``frames[i]`` [3, 3], right-handed. A surface is a height
z = S(u, v) over the plane through p, and the new point at (u, v) is p + u e_u + v e_v + z e_n.
u, v and z are in scene units. The steps are frames, places (u, v), heights (a method's own
``heights``), the lift back to 3D, and colours.
Promise: principal axes and their signs follow from the neighbourhood's shape alone, so they rotate
with the cloud; a collinear neighbourhood is reported, as its tangent plane is arbitrary, and gets
v = 0.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from jaxtyping import Bool, Float32, Float64, Int32

from splatseed.methods.contract import NewPoints
from splatseed.methods.nearest import Aux, NearestMethod, interpolate_colors
from splatseed.methods.neighbors import Bases, Neighbors, PreparedCloud
from splatseed.progress import Progress, blocks
from splatseed.runtime.jit import inline, kernel, parallel_range
from splatseed.settings import Range

COLLINEAR = 1e-9
"""Ratio of the two largest variances below which a neighbourhood counts as collinear."""


def local_frames(
    xyz: Float64[np.ndarray, "n 3"], idx: Int32[np.ndarray, "m k"]
) -> tuple[Float64[np.ndarray, "m 3 3"], Bool[np.ndarray, " m"]]:
    """Axes e_u, e_v, e_n of the first m rows and their neighbours, and which are collinear."""
    frames, collinear = np.empty((len(idx), 3, 3)), np.empty(len(idx), bool)
    _frames(xyz, idx, frames, collinear, COLLINEAR)
    return frames, collinear


@kernel
def _frames(xyz, idx, frames, collinear, tolerance):  # type: ignore[no-untyped-def]  # Numba's types
    for i in parallel_range(len(idx)):
        covariance = _covariance(xyz, i, idx[i])
        collinear[i] = _principal_axes(covariance, frames[i]) < tolerance
        _fix_signs(xyz, i, idx[i], frames[i])


@inline
def coordinate(xyz, i, j, axis_vector):  # type: ignore[no-untyped-def]  # Numba's types
    """Coordinate of row j along a unit vector, relative to row i."""
    return (
        (xyz[j, 0] - xyz[i, 0]) * axis_vector[0]
        + (xyz[j, 1] - xyz[i, 1]) * axis_vector[1]
        + (xyz[j, 2] - xyz[i, 2]) * axis_vector[2]
    )


@inline
def _covariance(xyz, i, rows):  # type: ignore[no-untyped-def]  # Numba's types
    """Covariance of row i and its neighbours, scaled to a trace of 1: (xx, xy, xz, yy, yz, zz)."""
    mx = my = mz = 0.0
    for j in rows:
        mx += xyz[j, 0] - xyz[i, 0]
        my += xyz[j, 1] - xyz[i, 1]
        mz += xyz[j, 2] - xyz[i, 2]
    count = rows.size + 1
    mx, my, mz = mx / count, my / count, mz / count
    # The base itself lies at -mean from the mean.
    xx, xy, xz, yy, yz, zz = mx * mx, mx * my, mx * mz, my * my, my * mz, mz * mz
    for j in rows:
        x, y, z = xyz[j, 0] - xyz[i, 0] - mx, xyz[j, 1] - xyz[i, 1] - my, xyz[j, 2] - xyz[i, 2] - mz
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    scale = 1.0 / (xx + yy + zz)
    return xx * scale, xy * scale, xz * scale, yy * scale, yz * scale, zz * scale


@inline
def _principal_axes(covariance, frame):  # type: ignore[no-untyped-def]  # Numba's types
    """Fill ``frame`` with e_u, e_v, e_n; return the middle variance over the largest.

    The eigenvalue that lies farthest from the others gives a well-conditioned first axis; the
    other two come from the 2x2 problem in its plane, which has a stable closed form.
    (D. Eberly, A Robust Eigensolver for 3x3 Symmetric Matrices, Geometric Tools.)
    """
    xx, xy, xz, yy, yz, zz = covariance
    # The trace is 1: without a third of it the eigenvalues sum to 0 and are 2 p cos(angle).
    a, b, c = xx - 1.0 / 3.0, yy - 1.0 / 3.0, zz - 1.0 / 3.0
    p = math.sqrt((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0)
    if p < 1e-12:
        _set_rows(frame, (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        return 1.0
    det = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz)
    half_det = min(max(det / (2.0 * p * p * p), -1.0), 1.0)
    angle = math.acos(half_det) / 3.0
    largest = 2.0 * p * math.cos(angle)
    smallest = 2.0 * p * math.cos(angle + 2.0 * math.pi / 3.0)
    largest_is_isolated = half_det >= 0.0
    first = largest if largest_is_isolated else smallest
    wx, wy, wz = _null_vector(a - first, xy, xz, b - first, yz, c - first)
    major, minor, major_variance = _plane_axes(covariance, wx, wy, wz)
    if largest_is_isolated:
        _set_rows(frame, (wx, wy, wz), major, minor)
        return major_variance / (largest + 1.0 / 3.0)
    _set_rows(frame, major, minor, (wx, wy, wz))
    # Middle variance = trace - largest - smallest, and the smallest is ``smallest`` + 1/3.
    return (2.0 / 3.0 - major_variance - smallest) / major_variance


@inline
def _set_rows(frame, first, second, third):  # type: ignore[no-untyped-def]  # Numba's types
    # One by one: assigning a tuple to a row makes Numba compile 5 s of its own checks and messages.
    for axis in range(3):
        frame[0, axis], frame[1, axis], frame[2, axis] = first[axis], second[axis], third[axis]


@inline
def _null_vector(xx, xy, xz, yy, yz, zz):  # type: ignore[no-untyped-def]  # Numba's types
    """Unit null vector of a symmetric matrix of rank 2: the longest cross product of its rows."""
    x0, y0, z0 = xy * yz - xz * yy, xz * xy - xx * yz, xx * yy - xy * xy
    x1, y1, z1 = xy * zz - xz * yz, xz * xz - xx * zz, xx * yz - xy * xz
    x2, y2, z2 = yy * zz - yz * yz, yz * xz - xy * zz, xy * yz - yy * xz
    s0, s1, s2 = (
        x0 * x0 + y0 * y0 + z0 * z0,
        x1 * x1 + y1 * y1 + z1 * z1,
        x2 * x2 + y2 * y2 + z2 * z2,
    )
    if s0 >= s1 and s0 >= s2:
        s = 1.0 / math.sqrt(s0)
        return x0 * s, y0 * s, z0 * s
    if s1 >= s2:
        s = 1.0 / math.sqrt(s1)
        return x1 * s, y1 * s, z1 * s
    s = 1.0 / math.sqrt(s2)
    return x2 * s, y2 * s, z2 * s


@inline
def _plane_axes(covariance, wx, wy, wz):  # type: ignore[no-untyped-def]  # Numba's types
    """Principal axes in the plane orthogonal to w: (major, minor, variance along major)."""
    xx, xy, xz, yy, yz, zz = covariance
    # a and b are orthogonal to w; only the longer of two pairs of its components is divided by.
    if abs(wx) > abs(wy):
        s = 1.0 / math.sqrt(wx * wx + wz * wz)
        ax, ay, az = -wz * s, 0.0, wx * s
    else:
        s = 1.0 / math.sqrt(wy * wy + wz * wz)
        ax, ay, az = 0.0, wz * s, -wy * s
    bx, by, bz = wy * az - wz * ay, wz * ax - wx * az, wx * ay - wy * ax
    cax, cay, caz = (
        xx * ax + xy * ay + xz * az,
        xy * ax + yy * ay + yz * az,
        xz * ax + yz * ay + zz * az,
    )
    cbx, cby, cbz = (
        xx * bx + xy * by + xz * bz,
        xy * bx + yy * by + yz * bz,
        xz * bx + yz * by + zz * bz,
    )
    aa, ab, bb = (
        ax * cax + ay * cay + az * caz,
        ax * cbx + ay * cby + az * cbz,
        bx * cbx + by * cby + bz * cbz,
    )
    # The rotation that makes [[aa, ab], [ab, bb]] diagonal, larger variance first.
    theta = 0.5 * math.atan2(2.0 * ab, aa - bb)
    co, si = math.cos(theta), math.sin(theta)
    major = (co * ax + si * bx, co * ay + si * by, co * az + si * bz)
    minor = (co * bx - si * ax, co * by - si * ay, co * bz - si * az)
    return major, minor, co * co * aa + 2.0 * co * si * ab + si * si * bb


@inline
def _fix_signs(xyz, i, rows, frame):  # type: ignore[no-untyped-def]  # Numba's types
    """Point e_u and e_v to the neighbour farthest along each; e_n makes the frame right-handed."""
    far_u = far_v = 0.0
    for j in rows:
        u = v = 0.0
        for axis in range(3):
            u += (xyz[j, axis] - xyz[i, axis]) * frame[0, axis]
            v += (xyz[j, axis] - xyz[i, axis]) * frame[1, axis]
        if abs(u) > abs(far_u):
            far_u = u
        if abs(v) > abs(far_v):
            far_v = v
    for axis in range(3):
        frame[0, axis] *= math.copysign(1.0, far_u)
        frame[1, axis] *= math.copysign(1.0, far_v)
    e_u, e_v = frame[0], frame[1]
    frame[2, 0] = e_u[1] * e_v[2] - e_u[2] * e_v[1]
    frame[2, 1] = e_u[2] * e_v[0] - e_u[0] * e_v[2]
    frame[2, 2] = e_u[0] * e_v[1] - e_u[1] * e_v[0]


TRIANGLE_NEIGHBORS = 8  # neighbours from which the other two corners are drawn


def place_on_disc(
    neighbors: Neighbors,
    bases: Bases,
    collinear: Bool[np.ndarray, " n"],
    radius: float,
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the disc of ``radius`` times the base point's spacing."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    _disc(radius * neighbors.spacing, collinear, bases.start, bases.count, uv)
    return uv


def place_in_triangle(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the triangle of the base and two of its 8 nearest, drawn at random."""
    draws = rng.random((bases.total, 3), dtype=np.float32)
    uv = np.empty((bases.total, 2), np.float32)
    _triangle(cloud.xyz, neighbors.idx[:, :TRIANGLE_NEIGHBORS].copy(), frames,
              bases.start, bases.count, draws, uv)  # fmt: skip
    return uv


def place_in_box(
    cloud: PreparedCloud,
    neighbors: Neighbors,
    bases: Bases,
    frames: Float64[np.ndarray, "n 3 3"],
    rng: np.random.Generator,
) -> Float32[np.ndarray, "M 2"]:
    """Uniform in the bounding box of the neighbourhood along e_u and e_v (the paper's text)."""
    uv = rng.random((bases.total, 2), dtype=np.float32)
    _box(cloud.xyz, neighbors.idx, frames, bases.start, bases.count, uv)
    return uv


@kernel
def _disc(radius, collinear, start, count, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """Polar coordinates with a square-root radius, in place of the draws in ``uv``."""
    turn = np.float32(2.0 * math.pi)  # float32 sine and cosine are twice as fast
    for i in parallel_range(len(radius)):
        reach_u = np.float32(radius[i])
        reach_v = np.float32(0.0) if collinear[i] else reach_u
        for m in range(start[i], start[i] + count[i]):
            # The square root makes the area, not the radius, uniform.
            r, angle = np.sqrt(uv[m, 0]), turn * uv[m, 1]
            uv[m, 0] = reach_u * r * np.cos(angle)
            uv[m, 1] = reach_v * r * np.sin(angle)


@kernel
def _triangle(xyz, idx, frames, start, count, draws, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """The square-root map on the triangle of the base and a random pair of its neighbours."""
    pairs = idx.shape[1] * (idx.shape[1] - 1) // 2
    for i in parallel_range(len(idx)):
        for m in range(start[i], start[i] + count[i]):
            pick = min(int(draws[m, 2] * pairs), pairs - 1)
            # Pairs are counted (0,1), (0,2), (1,2), (0,3), ...: second (second - 1) / 2 precede.
            second = int((1.0 + math.sqrt(1.0 + 8.0 * pick)) / 2.0)
            first = pick - second * (second - 1) // 2
            # Weights 1 - sqrt(r1) of the base, at 0, sqrt(r1) (1 - r2) and sqrt(r1) r2.
            root = math.sqrt(np.float64(draws[m, 0]))
            b2 = root * np.float64(draws[m, 1])
            for axis in range(2):
                p = coordinate(xyz, i, idx[i, first], frames[i, axis])
                q = coordinate(xyz, i, idx[i, second], frames[i, axis])
                uv[m, axis] = (root - b2) * p + b2 * q


@kernel
def _box(xyz, idx, frames, start, count, uv):  # type: ignore[no-untyped-def]  # Numba's types
    """Stretch the draws in ``uv`` over the neighbourhood's bounding box."""
    for i in parallel_range(len(idx)):
        for axis in range(2):
            low = high = 0.0
            for j in idx[i]:
                at = coordinate(xyz, i, j, frames[i, axis])
                low, high = min(low, at), max(high, at)
            for m in range(start[i], start[i] + count[i]):
                uv[m, axis] = low + uv[m, axis] * (high - low)


BLOCK = 1 << 13  # base points that are fitted between two updates of the progress bar
MIN_NEIGHBORS = 3  # points other than the base that determine a plane with room for a height
FitSize = Annotated[int, Range(MIN_NEIGHBORS)]


@dataclass(frozen=True, eq=False)
class Patches:
    """One patch per row, with its axes, and the places on it where new points go."""

    cloud: PreparedCloud
    neighbors: Neighbors
    bases: Bases
    frames: Float64[np.ndarray, "n 3 3"]
    uv: Float32[np.ndarray, "M 2"]


@dataclass(frozen=True)
class PatchMethod(NearestMethod, ABC):
    """Base of the methods that fit a height field to the neighbours of a base point."""

    k: FitSize = 16
    """Neighbours in a fit."""
    frame: Literal["local", "world"] = "local"
    """Axes of the fit: the neighbourhood's principal axes, or the world's (paper: world)."""
    placement: Literal["disc", "triangle", "box"] = "disc"
    """Where points are placed: a disc (best coverage), a triangle of neighbours (most exact), a
    box (paper: box)."""
    disc_radius: Annotated[float, Range(above=0)] = 1.5
    """Radius of the disc in units of the base point's spacing."""
    clamp: Annotated[float | None, Range(0)] = 0.25
    """How far a height may leave the neighbours' range, as a fraction of it (paper: no limit)."""

    min_points: ClassVar[int] = 4
    name: ClassVar[str]

    @abstractmethod
    def heights(
        self, patches: Patches, first: int, last: int, out: Float32[np.ndarray, " M"]
    ) -> None:
        """Fit rows ``first:last`` and write S(u, v) of all their new points into ``out`` [M]."""

    @property
    def num_neighbors(self) -> int:
        """Neighbours in a fit."""
        return self.k

    def sample(
        self,
        cloud: PreparedCloud,
        neighbors: Neighbors,
        aux: Aux,
        bases: Bases,
        rng: np.random.Generator,
        progress: Progress,
    ) -> NewPoints:
        """Fit a patch to every base and put its points on it."""
        patches = self._patches(cloud, neighbors, bases, rng)
        height = np.empty(bases.total, np.float32)
        for first, last in blocks(len(cloud), BLOCK, self.name, progress):
            self.heights(patches, first, last, height)
        xyz = lift(patches, height, self.clamp)
        return NewPoints(xyz, interpolate_colors(cloud, neighbors, bases, xyz))

    def _patches(
        self, cloud: PreparedCloud, neighbors: Neighbors, bases: Bases, rng: np.random.Generator
    ) -> Patches:
        """Put a patch on every row and choose where its new points go."""
        if self.frame == "local":
            frames, collinear = local_frames(cloud.xyz, neighbors.idx)
        else:
            n = len(neighbors.idx)
            frames, collinear = np.tile(np.eye(3), (n, 1, 1)), np.zeros(n, bool)
        if self.placement == "disc":
            uv = place_on_disc(neighbors, bases, collinear, self.disc_radius, rng)
        elif self.placement == "triangle":
            uv = place_in_triangle(cloud, neighbors, bases, frames, rng)
        else:
            uv = place_in_box(cloud, neighbors, bases, frames, rng)
        return Patches(cloud, neighbors, bases, frames, uv)


def lift(
    patches: Patches, height: Float32[np.ndarray, " M"], clamp: float | None
) -> Float32[np.ndarray, "M 3"]:
    """World positions of the new points at heights S(u, v).

    Heights are clamped to the neighbours' range, widened on both sides by the fraction ``clamp`` of
    it; None leaves them unchanged.
    """
    cloud, bases = patches.cloud, patches.bases
    out = np.empty((bases.total, 3), np.float32)
    margin = np.inf if clamp is None else float(clamp)
    _lift(
        cloud.xyz, cloud.center, patches.neighbors.idx, patches.frames,
        bases.start, bases.count, patches.uv, height, margin, out,
    )  # fmt: skip
    return out


@kernel
def _lift(xyz, center, idx, frames, start, count, uv, height, margin, out):  # type: ignore[no-untyped-def]  # Numba's types
    """Compute p + u e_u + v e_v + clamp(z) e_n for all new points of all rows."""
    for i in parallel_range(len(count)):
        if count[i] > 0:
            e_u, e_v, e_n = frames[i, 0], frames[i, 1], frames[i, 2]
            low, high = _height_range(xyz, i, idx[i], e_n)
            # No fit is trusted far beyond the heights it was made from.
            slack = margin * (high - low) if margin < np.inf else np.inf
            for m in range(start[i], start[i] + count[i]):
                u, v = np.float64(uv[m, 0]), np.float64(uv[m, 1])
                z = min(max(np.float64(height[m]), low - slack), high + slack)
                for axis in range(3):
                    # p + u e_u + v e_v + z e_n, relative to the centroid until the last sum
                    local = u * e_u[axis] + v * e_v[axis] + z * e_n[axis]
                    out[m, axis] = center[axis] + (xyz[i, axis] + local)


@inline
def _height_range(xyz, i, rows, e_n):  # type: ignore[no-untyped-def]  # Numba's types
    """Lowest and highest of the neighbours and the base (at 0) along the normal."""
    low = high = 0.0
    for j in rows:
        z = coordinate(xyz, i, j, e_n)
        low = min(low, z)
        high = max(high, z)
    return low, high
