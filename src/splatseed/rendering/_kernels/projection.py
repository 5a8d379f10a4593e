"""Project 3D Gaussians to the image plane (EWA splatting), and compute the gradient.

Specification (``reference.py`` is its readable form). With W, t the camera's rotation and
translation, m_c = W m + t = (x, y, z), R = R(q / |q|), s the scales and J the Jacobian of the
pinhole projection at m_c (its x / z and y / z clamped to 15% of the image's size beyond its edges),
the 2D covariance is P P' + eps2d I with P = U diag(s), U = T R and T = J W; its inverse is the
conic (a, b, c). (M. Zwicker et al., EWA Splatting, 2002; conventions and cut-offs of gsplat 1.5.3.)

Culled (radius 0) are Gaussians with z outside the near and far planes, an opacity under 1/255, a
bounding box outside the image, or any number that is not finite. Inputs and outputs are float32,
arithmetic is float64. Gaussians are processed in blocks, a row per quantity, so that the compiler
vectorises over them; results do not depend on the blocks.
"""

from __future__ import annotations

import math

import numpy as np

from splatseed.runtime.jit import always_inline, kernel, parallel_range

MIN_ALPHA = 1.0 / 255.0
"""Smallest alpha that is drawn."""
MAX_SIGMAS = 3.33
"""Largest half-size of the bounding box in sigmas: exp(-3.33^2 / 2) is 1/255."""
EDGE = 0.15
"""Margin around the image within which J is not clamped, as a fraction of the image's size."""
CHUNKS = 16
"""Parts whose camera gradients are summed separately; independent of the thread count."""
BLOCK = 32
"""Gaussians per block."""
X, Q, S, EXTRA = 0, 3, 7, 10
"""First rows of a block: the mean in the world, the quaternion, the scales, further inputs."""
U, V, DEPTH, A, B, C, COMPENSATION, SIGMA_X, SIGMA_Y, INVERSE_DET, OPACITY = range(11)
"""Rows of a projected block: mean, z, conic, standard deviations, 1 / det of the covariance."""
DU, DV, DDEPTH, DCOMPENSATION, DCONIC = range(EXTRA, EXTRA + 5)
"""Rows of a block that hold the gradients of the outputs."""


@kernel
def project(
    means, quats, scales, opacities, view, K, width, height, near, far, eps2d, radius_clip,
    antialiased, radii, means2d, depths, conics, compensations,
):  # fmt: skip
    """Project N Gaussians into one camera.

    Args:
        means: float32 [N, 3], world.
        quats: float32 [N, 4], wxyz, any length but zero.
        scales: float32 [N, 3], standard deviations.
        opacities: float32 [N].
        view: cam_from_world, float32 [4, 4].
        K: float32 [3, 3].
        width: Pixels.
        height: Pixels.
        near: Smallest z.
        far: Largest z.
        eps2d: Blur added to the covariance, px^2.
        radius_clip: Gaussians with both radii up to this are culled, px.
        antialiased: Whether the cut-off uses opacities compensated for the blur.
        radii: Written, px, int32 [N, 2]; 0 where culled.
        means2d: Written, px, float32 [N, 2]; 0 where culled, likewise the following.
        depths: Written, float32 [N], z.
        conics: Written, float32 [N, 3].
        compensations: Written, float32 [N].
    """
    for chunk in parallel_range(CHUNKS):
        # One allocation per chunk: one per Gaussian would take as long as the arithmetic.
        block, projected = np.ones((EXTRA + 1, BLOCK), np.float32), np.empty((11, BLOCK))
        lanes = np.empty(BLOCK, np.intp)
        pose, lens = _pose(view), _lens(K, width, height)
        end = (chunk + 1) * len(means) // CHUNKS
        for first in range(chunk * len(means) // CHUNKS, end, BLOCK):
            last = min(first + BLOCK, end)
            for i in range(first, last):
                _gather(means, quats, scales, i, block, i - first)
                block[EXTRA, i - first] = opacities[i]
            _project_block(block, pose, lens, eps2d, projected)
            _cull(block, near, far, width, height, antialiased, projected)
            # Most Gaussians are culled: clear all, then write the visible ones.
            radii[first:last] = 0
            means2d[first:last], depths[first:last] = np.float32(0.0), np.float32(0.0)
            conics[first:last], compensations[first:last] = np.float32(0.0), np.float32(0.0)
            count = 0
            # The next lane overwrites a culled one, so that no branch can be mispredicted.
            for lane in range(last - first):  # branch-free compaction
                lanes[count] = lane
                count += projected[OPACITY, lane] > 0.0
            for lane in lanes[:count]:
                i = first + lane
                rx, ry = _radii(projected, lane, width, height, radius_clip)
                if rx > 0:
                    radii[i, 0], radii[i, 1] = rx, ry
                    means2d[i, 0], means2d[i, 1] = projected[U, lane], projected[V, lane]
                    depths[i] = projected[DEPTH, lane]
                    compensations[i] = projected[COMPENSATION, lane]
                    for k in range(3):
                        conics[i, k] = projected[A + k, lane]


@always_inline
def _pose(view):
    """Return the rows of the camera's rotation and its translation, float64."""
    rows = view.T
    return _column(rows, 0, 0), _column(rows, 0, 1), _column(rows, 0, 2), _column(view, 0, 3)


@always_inline
def _lens(K, width, height):
    """Return fx, fy, cx, cy, and the bounds to which J clamps x / z and y / z."""
    fx, fy = np.float64(K[0, 0]), np.float64(K[1, 1])
    cx, cy = np.float64(K[0, 2]), np.float64(K[1, 2])
    beyond_x, beyond_y = EDGE * width / fx, EDGE * height / fy
    return (
        fx, fy, cx, cy, -(cx / fx + beyond_x), (width - cx) / fx + beyond_x,
        -(cy / fy + beyond_y), (height - cy) / fy + beyond_y,
    )  # fmt: skip


@always_inline
def _gather(means, quats, scales, i, block, lane):
    """Copy a Gaussian into a block."""
    for k in range(3):
        block[X + k, lane], block[S + k, lane] = means[i, k], scales[i, k]
    for k in range(4):
        block[Q + k, lane] = quats[i, k]


@always_inline
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@always_inline
def _times(a, b):
    """Return the elementwise product."""
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@always_inline
def _mix(wa, a, wb, b):
    """Return the weighted sum wa a + wb b of two vectors."""
    return wa * a[0] + wb * b[0], wa * a[1] + wb * b[1], wa * a[2] + wb * b[2]


@always_inline
def _row_times(weights, rows):
    """Return a row vector times a matrix."""
    a, b = _mix(weights[0], rows[0], weights[1], rows[1]), rows[2]
    return a[0] + weights[2] * b[0], a[1] + weights[2] * b[1], a[2] + weights[2] * b[2]


@always_inline
def _project_block(block, pose, lens, eps2d, projected):
    """Project all lanes of a block, used or not."""
    for lane in range(BLOCK):
        x, y, z = _in_camera(block, lane, pose)  # m_c = W m + t
        J = _jacobian(x, y, z, lens)
        # T = J W
        T0, T1 = _mix(J[0], pose[0], J[1], pose[2]), _mix(J[2], pose[1], J[3], pose[2])
        quat, _ = _quaternion(block, lane)
        R, s = _rotation(quat), _column(block, S, lane)
        # P = T R diag(s); covariance P P' + eps2d I, its inverse the conic (a, b, c)
        P0, P1 = _times(_row_times(T0, R), s), _times(_row_times(T1, R), s)
        xx, xy, yy = _dot(P0, P0), _dot(P0, P1), _dot(P1, P1)
        # Its determinant before the blur, for the compensation below; then the blur.
        raw = xx * yy - xy * xy
        xx, yy = xx + eps2d, yy + eps2d
        over = 1.0 / (xx * yy - xy * xy)
        # u = fx x / z + cx, v = fy y / z + cy
        projected[U, lane] = lens[0] * (x * (1.0 / z)) + lens[2]
        projected[V, lane] = lens[1] * (y * (1.0 / z)) + lens[3]
        projected[DEPTH, lane], projected[A, lane] = z, yy * over
        projected[B, lane], projected[C, lane] = -xy * over, xx * over
        # compensation = sqrt(det P P' / det(P P' + eps2d I))
        projected[COMPENSATION, lane] = math.sqrt(max(raw * over, 0.0))
        projected[SIGMA_X, lane], projected[SIGMA_Y, lane] = math.sqrt(xx), math.sqrt(yy)
        projected[INVERSE_DET, lane] = over


@always_inline
def _column(array, row, column):
    """Return three consecutive numbers of a column, float64."""
    a, b, c = array[row, column], array[row + 1, column], array[row + 2, column]
    return np.float64(a), np.float64(b), np.float64(c)


@always_inline
def _in_camera(block, lane, pose):
    mean, t = _column(block, X, lane), pose[3]
    return _dot(pose[0], mean) + t[0], _dot(pose[1], mean) + t[1], _dot(pose[2], mean) + t[2]


@always_inline
def _jacobian(x, y, z, lens):
    """Return J00, J02, J11, J12 of J = [fx/z, 0, -fx x/z^2; 0, fy/z, -fy y/z^2], clamped."""
    fx, fy, _, _, low_x, high_x, low_y, high_y = lens
    over = 1.0 / z
    # Clamped, because the linear approximation J fails far outside the image.
    x_z, y_z = min(max(x * over, low_x), high_x), min(max(y * over, low_y), high_y)
    return fx * over, -fx * over * x_z, fy * over, -fy * over * y_z


@always_inline
def _quaternion(block, lane):
    """Return the normalised quaternion, and 1 / |q|."""
    w, (x, y, z) = np.float64(block[Q, lane]), _column(block, Q + 1, lane)
    over = 1.0 / math.sqrt(w * w + x * x + y * y + z * z)
    return (w * over, x * over, y * over, z * over), over


@always_inline
def _rotation(quat):
    """Return the rows of R(q) for a unit quaternion."""
    w, x, y, z = quat
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@always_inline
def _cull(block, near, far, width, height, antialiased, projected):
    """Write the row OPACITY, 0 where the Gaussian is culled."""
    for lane in range(BLOCK):
        u, v, z = projected[U, lane], projected[V, lane], projected[DEPTH, lane]
        over = projected[INVERSE_DET, lane]
        # A box of 3.33 sigmas, plus a pixel as _radii rounds up; _radii decides.
        rx = MAX_SIGMAS * projected[SIGMA_X, lane] + 1.0
        ry = MAX_SIGMAS * projected[SIGMA_Y, lane] + 1.0
        opacity = np.float64(block[EXTRA, lane])
        if antialiased:
            opacity *= projected[COMPENSATION, lane]
        seen = (near <= z) & (z <= far) & (opacity >= MIN_ALPHA) & (opacity < np.inf)
        # If the determinant underflowed or is NaN, there is no ellipse.
        seen &= (over > 0.0) & (over < np.inf)
        seen &= (u + rx > 0) & (u - rx < width) & (v + ry > 0) & (v - ry < height)
        projected[OPACITY, lane] = opacity if seen else 0.0


@always_inline
def _radii(projected, lane, width, height, radius_clip):
    """Return the half-size, px, of the bounding box of alpha >= 1/255; 0 if culled."""
    u, v = projected[U, lane], projected[V, lane]
    # opacity exp(-sigmas^2 / 2) = 1/255
    sigmas = min(MAX_SIGMAS, math.sqrt(2.0 * math.log(projected[OPACITY, lane] / MIN_ALPHA)))
    rx, ry = np.ceil(sigmas * projected[SIGMA_X, lane]), np.ceil(sigmas * projected[SIGMA_Y, lane])
    inside = u + rx > 0 and u - rx < width and v + ry > 0 and v - ry < height
    if inside and (rx > radius_clip or ry > radius_clip):
        # Radii are stored as int32.
        return min(rx, 1e9), min(ry, 1e9)
    return 0.0, 0.0


@kernel
def project_vjp(
    means, quats, scales, view, K, width, height, eps2d, radii,
    d_means2d, d_depths, d_conics, d_compensations, d_means, d_quats, d_scales, d_view,
):  # fmt: skip
    """Compute the gradients of ``project``.

    Args:
        means: As in ``project``; likewise all up to ``radii``.
        quats: [N, 4].
        scales: [N, 3].
        view: [4, 4].
        K: [3, 3].
        width: Pixels.
        height: Pixels.
        eps2d: px^2.
        radii: [N, 2].
        d_means2d: d loss / d means2d, [N, 2]; likewise the following.
        d_depths: [N].
        d_conics: [N, 3].
        d_compensations: [N].
        d_means: Written, float32 [N, 3]; 0 where culled, likewise the following.
        d_quats: Written, float32 [N, 4].
        d_scales: Written, float32 [N, 3].
        d_view: Written, float64 [CHUNKS, 3, 4].
    """
    for chunk in parallel_range(CHUNKS):
        block, gradients = np.ones((EXTRA + 7, BLOCK), np.float32), np.empty((10, BLOCK))
        sums, indices = np.zeros((3, 4, BLOCK)), np.empty(BLOCK, np.intp)
        pose, lens = _pose(view), _lens(K, width, height)
        start, end = chunk * len(means) // CHUNKS, (chunk + 1) * len(means) // CHUNKS
        d_means[start:end], d_quats[start:end] = np.float32(0.0), np.float32(0.0)
        d_scales[start:end] = np.float32(0.0)
        count = 0
        for i in range(start, end):
            indices[count] = i
            count += radii[i, 0] > 0
            if count == BLOCK or (count > 0 and i == end - 1):
                for lane in range(BLOCK):
                    # The last Gaussian pads an incomplete block, with gradients of 0.
                    index, weight = indices[min(lane, count - 1)], np.float32(lane < count)
                    _gather(means, quats, scales, index, block, lane)
                    block[DU, lane] = weight * d_means2d[index, 0]
                    block[DV, lane] = weight * d_means2d[index, 1]
                    block[DDEPTH, lane] = weight * d_depths[index]
                    block[DCOMPENSATION, lane] = weight * d_compensations[index]
                    for k in range(3):
                        block[DCONIC + k, lane] = weight * d_conics[index, k]
                _block_vjp(block, pose, lens, eps2d, gradients, sums)
                for lane in range(count):
                    index = indices[lane]
                    for k in range(3):
                        d_means[index, k] = gradients[X + k, lane]
                        d_scales[index, k] = gradients[S + k, lane]
                    for k in range(4):
                        d_quats[index, k] = gradients[Q + k, lane]
                count = 0
        for k in range(12):
            # Over lanes; the caller sums over chunks: a fixed order for the same bytes.
            d_view[chunk, k // 4, k % 4] = sums[k // 4, k % 4].sum()


@always_inline
def _block_vjp(block, pose, lens, eps2d, gradients, sums):
    """Compute gradients of a block's means, quaternions and scales; accumulate the pose's."""
    for lane in range(BLOCK):
        x, y, z = _in_camera(block, lane, pose)
        J = _jacobian(x, y, z, lens)
        T0, T1 = _mix(J[0], pose[0], J[1], pose[2]), _mix(J[2], pose[1], J[3], pose[2])
        quat, over = _quaternion(block, lane)
        R, s = _rotation(quat), _column(block, S, lane)
        U0, U1 = _row_times(T0, R), _row_times(T1, R)
        P0, P1 = _times(U0, s), _times(U1, s)
        d_xx, d_xy, d_yy = _covariance_vjp(block, lane, P0, P1, eps2d)
        # dP = 2 dS P for the symmetric d covariance dS
        dP0, dP1 = _mix(2.0 * d_xx, P0, d_xy, P1), _mix(2.0 * d_yy, P1, d_xy, P0)
        for k in range(3):
            # P = U diag(s), so ds_k = sum_rows dP_rk U_rk
            gradients[S + k, lane] = dP0[k] * U0[k] + dP1[k] * U1[k]
        # dU = dP diag(s), dR = T' dU, dT = dU R', dJ = dT W', dW = J' dT
        dU0, dU1 = _times(dP0, s), _times(dP1, s)
        dR = (
            _mix(T0[0], dU0, T1[0], dU1), _mix(T0[1], dU0, T1[1], dU1), _mix(T0[2], dU0, T1[2], dU1)
        )  # fmt: skip
        d_quat = _rotation_vjp(quat, dR)
        along = (
            d_quat[0] * quat[0] + d_quat[1] * quat[1] + d_quat[2] * quat[2] + d_quat[3] * quat[3]
        )
        for k in range(4):  # d (q / |q|): the component along q vanishes
            gradients[Q + k, lane] = (d_quat[k] - along * quat[k]) * over
        # dT = dU R', row by row; dJ = dT W' for the four entries of J that are not 0
        dT0 = _dot(R[0], dU0), _dot(R[1], dU0), _dot(R[2], dU0)
        dT1 = _dot(R[0], dU1), _dot(R[1], dU1), _dot(R[2], dU1)
        dJ = _dot(dT0, pose[0]), _dot(dT0, pose[2]), _dot(dT1, pose[1]), _dot(dT1, pose[2])
        dt = _mean_vjp(block, lane, x, y, z, lens, J, dJ)
        # m_c = W m + t: d m = W' d m_c
        d_mean, mean = _row_times(dt, pose), _column(block, X, lane)
        # dW = J' dT + d m_c m': T = J W and m_c = W m + t both depend on W
        dW0, dW1 = _mix(J[0], dT0, dt[0], mean), _mix(J[2], dT1, dt[1], mean)
        dW2 = _mix(J[1], dT0, J[3], dT1)
        for k in range(3):
            gradients[X + k, lane] = d_mean[k]
            # A sum per lane, so that the loop over lanes vectorises.
            sums[0, k, lane] += dW0[k]
            sums[1, k, lane] += dW1[k]
            sums[2, k, lane] += dW2[k] + dt[2] * mean[k]
            sums[k, 3, lane] += dt[k]


@always_inline
def _covariance_vjp(block, lane, P0, P1, eps2d):
    """Return the gradient of the covariance (xx, xy, yy), from d conic and d compensation."""
    raw_xx, xy, raw_yy = _dot(P0, P0), _dot(P0, P1), _dot(P1, P1)
    xx, yy = raw_xx + eps2d, raw_yy + eps2d
    over = 1.0 / (xx * yy - xy * xy)
    # Recomputing the conic is cheaper than loading it.
    a, b, c = yy * over, -xy * over, xx * over
    da, db, dc = _column(block, DCONIC, lane)
    # d covariance = -X G X for the inverse X and the symmetric gradient G
    ga, gb = da * a + 0.5 * db * b, da * b + 0.5 * db * c
    ha, hb = 0.5 * db * a + dc * b, 0.5 * db * b + dc * c
    # compensation c = sqrt(raw over), so d c = c / 2 (d raw / raw + d over / over)
    raw = raw_xx * raw_yy - xy * xy
    scaled = 0.5 * block[DCOMPENSATION, lane] * math.sqrt(max(raw * over, 0.0))
    by_raw = scaled / raw if raw > 0.0 else 0.0
    by_det = -scaled * over if raw > 0.0 else 0.0
    return (
        by_raw * raw_yy + by_det * yy - (a * ga + b * ha),
        -2.0 * ((by_raw + by_det) * xy + a * gb + b * hb),
        by_raw * raw_xx + by_det * xx - (b * gb + c * hb),
    )


@always_inline
def _rotation_vjp(quat, dR):
    """Return the gradient of the quaternion from dR, before projection to unit quaternions."""
    w, x, y, z = quat
    (d00, d01, d02), (d10, d11, d12), (d20, d21, d22) = dR
    # R is quadratic in q; skew and (xy, xz, yz) are dR's antisymmetric and symmetric parts.
    skew_x, skew_y, skew_z = d21 - d12, d02 - d20, d10 - d01
    xy, xz, yz = d01 + d10, d02 + d20, d12 + d21
    return (
        2.0 * (x * skew_x + y * skew_y + z * skew_z),
        2.0 * (w * skew_x + y * xy + z * xz - 2.0 * x * (d11 + d22)),
        2.0 * (w * skew_y + x * xy + z * yz - 2.0 * y * (d00 + d22)),
        2.0 * (w * skew_z + x * xz + y * yz - 2.0 * z * (d00 + d11)),
    )


@always_inline
def _mean_vjp(block, lane, x, y, z, lens, J, dJ):
    """Return the gradient of the mean (x, y, z) in camera axes, from dJ, d mean2d and d depth."""
    _, _, _, _, low_x, high_x, low_y, high_y = lens
    over = 1.0 / z
    x_z, y_z = x * over, y * over
    # J02 = -J00 x / z depends on x only where x / z is not clamped; J12 likewise.
    by_x = dJ[1] * J[0] * over if low_x <= x_z <= high_x else 0.0
    by_y = dJ[3] * J[2] * over if low_y <= y_z <= high_y else 0.0
    # u = fx x / z + cx has the derivative fx / z = J00 by x; v likewise
    du, dv = block[DU, lane] * J[0], block[DV, lane] * J[2]
    # All four entries of J are proportional to 1 / z (with x / z held): d J / dz = -J / z.
    by_depth = dJ[0] * J[0] + dJ[1] * J[1] + dJ[2] * J[2] + dJ[3] * J[3]
    dz = block[DDEPTH, lane] - (du * x_z + dv * y_z) - by_depth * over + by_x * x_z + by_y * y_z
    return du - by_x, dv - by_y, dz
