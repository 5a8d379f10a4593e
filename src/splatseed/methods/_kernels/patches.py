"""Patches: principal axes of neighbourhoods, positions (u, v) on them, and the lift to the world.

``frames[i]`` [3, 3] has the rows e_u, e_v (the tangent plane, widest axis first) and e_n (the
normal), right-handed. Signs follow from the neighbourhood's shape, so axes rotate with the cloud.
Row i makes the new points ``start[i] : start[i] + count[i]``.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import inline, kernel, parallel_range

# Frames -------------------------------------------------------------------------------------------


@kernel
def fill_frames(xyz, idx, frames, collinear, tolerance):
    """Fill ``frames`` [n, 3, 3] and ``collinear`` [n]: second variance / first < tolerance."""
    for i in parallel_range(len(idx)):
        covariance = _covariance(xyz, i, idx[i])
        collinear[i] = _principal_axes(covariance, frames[i]) < tolerance
        _fix_signs(xyz, i, idx[i], frames[i])


@inline
def coordinate(xyz, i, j, axis_vector):
    """Coordinate of row j along a unit vector, relative to row i."""
    return (
        (xyz[j, 0] - xyz[i, 0]) * axis_vector[0]
        + (xyz[j, 1] - xyz[i, 1]) * axis_vector[1]
        + (xyz[j, 2] - xyz[i, 2]) * axis_vector[2]
    )


@inline
def _covariance(xyz, i, rows):
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
def _principal_axes(covariance, frame):
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
def _set_rows(frame, first, second, third):
    # One by one: assigning a tuple to a row makes Numba compile 5 s of its own checks and messages.
    for axis in range(3):
        frame[0, axis], frame[1, axis], frame[2, axis] = first[axis], second[axis], third[axis]


@inline
def _null_vector(xx, xy, xz, yy, yz, zz):
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
def _plane_axes(covariance, wx, wy, wz):
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
def _fix_signs(xyz, i, rows, frame):
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


# Positions ----------------------------------------------------------------------------------------


@kernel
def sample_disc(radius, collinear, start, count, uv):
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
def sample_triangle(xyz, idx, frames, start, count, draws, uv):
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
def sample_box(xyz, idx, frames, start, count, uv):
    """Stretch the draws in ``uv`` over the neighbourhood's bounding box."""
    for i in parallel_range(len(idx)):
        for axis in range(2):
            low = high = 0.0
            for j in idx[i]:
                at = coordinate(xyz, i, j, frames[i, axis])
                low, high = min(low, at), max(high, at)
            for m in range(start[i], start[i] + count[i]):
                uv[m, axis] = low + uv[m, axis] * (high - low)


@kernel
def lift(xyz, center, idx, frames, start, count, uv, height, margin, out):
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
def _height_range(xyz, i, rows, e_n):
    """Lowest and highest of the neighbours and the base (at 0) along the normal."""
    low = high = 0.0
    for j in rows:
        z = coordinate(xyz, i, j, e_n)
        low = min(low, z)
        high = max(high, z)
    return low, high
