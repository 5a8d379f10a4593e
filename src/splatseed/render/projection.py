"""Projection of 3D Gaussians to the image plane (EWA splatting), and its gradient.

Specification (``reference.py`` is its readable form). With W, t the camera's rotation and translation,
m_c = W m + t = (x, y, z), M = R(q) diag(s) and J the Jacobian of the pinhole projection at m_c (its
x / z and y / z held within 15% of the image's size beyond its edges), the 2D covariance is
P P' + eps2d I with P = J W M; its inverse is the conic (a, b, c).
(M. Zwicker et al., EWA Splatting, 2002; conventions and cut-offs as gsplat 1.5.3 publishes them.)

Culled, with a radius of 0: z outside of the near and far planes, opacity under 1/255, nothing of the
bounding box in the image, and whatever is not finite.
Arithmetic is float64 inside, float32 in and out.
"""

# mypy: disable-error-code="no-untyped-def, no-untyped-call"

from __future__ import annotations

import math

import numpy as np

from splatseed.jit import always_inline, kernel, parallel_range

__all__ = ["project", "project_vjp"]

MIN_ALPHA = 1.0 / 255.0
MAX_SIGMAS = 3.33
EDGE = 0.3
CHUNKS = 16
"""Pieces whose camera gradients are summed apart, whatever the number of threads."""


@kernel
def project(  # type: ignore[no-untyped-def]
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
        near: Least z.
        far: Greatest z.
        eps2d: Blur added to the covariance, px^2.
        radius_clip: Gaussians whose radii are no larger are culled, px.
        antialiased: Whether the opacity is to be compensated for the blur.
        radii: Written, int32 [N, 2]; 0 = culled.
        means2d: Written, float32 [N, 2], px.
        depths: Written, float32 [N], z.
        conics: Written, float32 [N, 3].
        compensations: Written, float32 [N].
    """
    for chunk in parallel_range(CHUNKS):
        # One allocation a chunk: one a Gaussian takes as long as all of the arithmetic.
        R, M, V, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
        stretch = _stretch(view)
        for i in range(chunk * len(means) // CHUNKS, (chunk + 1) * len(means) // CHUNKS):
            radii[i, 0] = radii[i, 1] = 0
            x, y, z = _to_camera(means[i], view)
            if not near <= z <= far:
                continue
            J = _jacobian(x, y, z, K, width, height)
            u, v = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
            if _far_outside(u, v, J, stretch, scales[i], eps2d, width, height):
                continue
            _rotation(quats[i], R)
            _factors(R, scales[i], view, J, M, V, P)
            xx, xy, yy = _covariance(P)
            det = (xx + eps2d) * (yy + eps2d) - xy * xy
            compensation = math.sqrt(max((xx * yy - xy * xy) / det, 0.0))
            xx, yy = xx + eps2d, yy + eps2d
            opacity = opacities[i] * compensation if antialiased else np.float64(opacities[i])
            if det > 0.0 and det < np.inf and MIN_ALPHA <= opacity < np.inf:
                sigmas = min(MAX_SIGMAS, math.sqrt(2.0 * math.log(opacity / MIN_ALPHA)))
                rx, ry = np.ceil(sigmas * math.sqrt(xx)), np.ceil(sigmas * math.sqrt(yy))
                inside = u + rx > 0 and u - rx < width and v + ry > 0 and v - ry < height
                if inside and (rx > radius_clip or ry > radius_clip):
                    radii[i, 0], radii[i, 1] = min(rx, 1e9), min(ry, 1e9)
                    means2d[i, 0], means2d[i, 1], depths[i] = u, v, z
                    conics[i, 0], conics[i, 1], conics[i, 2] = yy / det, -xy / det, xx / det
                    compensations[i] = compensation


@always_inline
def _to_camera(mean, view):  # type: ignore[no-untyped-def]
    m0, m1, m2 = np.float64(mean[0]), np.float64(mean[1]), np.float64(mean[2])
    return (
        view[0, 0] * m0 + view[0, 1] * m1 + view[0, 2] * m2 + view[0, 3],
        view[1, 0] * m0 + view[1, 1] * m1 + view[1, 2] * m2 + view[1, 3],
        view[2, 0] * m0 + view[2, 1] * m1 + view[2, 2] * m2 + view[2, 3],
    )


@always_inline
def _stretch(view):  # type: ignore[no-untyped-def]
    """At least the spectral norm of the camera's rotation, which need not be quite one."""
    total = 0.0
    for r in range(3):
        for c in range(3):
            total += np.float64(view[r, c]) * view[r, c]
    return math.sqrt(total)


@always_inline
def _far_outside(u, v, J, stretch, scale, eps2d, width, height):  # type: ignore[no-untyped-def]
    """Whether not even a ball of the greatest scale would reach the image.

    It spares most of those beside the image the rest. Any NaN is false, and left to what follows.
    """
    size = stretch * max(scale[0], scale[1], scale[2])
    across = MAX_SIGMAS * math.sqrt((J[0] * J[0] + J[1] * J[1]) * size * size + eps2d) + 1.0
    along = MAX_SIGMAS * math.sqrt((J[2] * J[2] + J[3] * J[3]) * size * size + eps2d) + 1.0
    return u + across < 0 or u - across > width or v + along < 0 or v - along > height


@always_inline
def _rotation(quat, R):  # type: ignore[no-untyped-def]
    """Fill R(q / |q|); return |q|."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return norm


@always_inline
def _jacobian(x, y, z, K, width, height):  # type: ignore[no-untyped-def]
    """(J00, J02, J11, J12), and whether x / z and y / z were held back."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    beyond_x, beyond_y = EDGE * 0.5 * width / fx, EDGE * 0.5 * height / fy
    u = min(max(x / z, -(cx / fx + beyond_x)), (width - cx) / fx + beyond_x)
    v = min(max(y / z, -(cy / fy + beyond_y)), (height - cy) / fy + beyond_y)
    return fx / z, -fx * u / z, fy / z, -fy * v / z, u != x / z, v != y / z


@always_inline
def _factors(R, scale, view, J, M, V, P):  # type: ignore[no-untyped-def]
    """M = R diag(s), V = W M and P = J V."""
    for r in range(3):
        for c in range(3):
            M[r, c] = R[r, c] * scale[c]
    for r in range(3):
        for c in range(3):
            V[r, c] = view[r, 0] * M[0, c] + view[r, 1] * M[1, c] + view[r, 2] * M[2, c]
    for c in range(3):
        P[0, c] = J[0] * V[0, c] + J[1] * V[2, c]
        P[1, c] = J[2] * V[1, c] + J[3] * V[2, c]


@always_inline
def _covariance(P):  # type: ignore[no-untyped-def]
    xx = P[0, 0] * P[0, 0] + P[0, 1] * P[0, 1] + P[0, 2] * P[0, 2]
    xy = P[0, 0] * P[1, 0] + P[0, 1] * P[1, 1] + P[0, 2] * P[1, 2]
    yy = P[1, 0] * P[1, 0] + P[1, 1] * P[1, 1] + P[1, 2] * P[1, 2]
    return xx, xy, yy


@kernel
def project_vjp(  # type: ignore[no-untyped-def]
    means, quats, scales, view, K, width, height, eps2d, radii,
    d_means2d, d_depths, d_conics, d_compensations, d_means, d_quats, d_scales, d_view,
):  # fmt: skip
    """Gradients of ``project``.

    Args:
        means: As in ``project``, and so on to ``radii``.
        quats: [N, 4].
        scales: [N, 3].
        view: [4, 4].
        K: [3, 3].
        width: Pixels.
        height: Pixels.
        eps2d: px^2.
        radii: [N, 2]; culled Gaussians get no gradient.
        d_means2d: d loss / d means2d, [N, 2], and so on.
        d_depths: [N].
        d_conics: [N, 3].
        d_compensations: [N].
        d_means: Written, float32 [N, 3]; must hold 0.
        d_quats: Written, float32 [N, 4]; must hold 0.
        d_scales: Written, float32 [N, 3]; must hold 0.
        d_view: Written, float64 [CHUNKS, 4, 4]; must hold 0.
    """
    for chunk in parallel_range(CHUNKS):
        R, M, V, P = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((2, 3))
        dP, dV, dM, dt = np.empty((2, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
        for i in range(chunk * len(means) // CHUNKS, (chunk + 1) * len(means) // CHUNKS):
            if radii[i, 0] > 0:
                x, y, z = _to_camera(means[i], view)
                norm = _rotation(quats[i], R)
                J = _jacobian(x, y, z, K, width, height)
                _factors(R, scales[i], view, J, M, V, P)
                _covariance_vjp(P, eps2d, d_conics[i], np.float64(d_compensations[i]), dP)
                _camera_vjp(x, y, z, K, J, V, dP, d_means2d[i], d_depths[i], dV, dt)
                _world_vjp(means[i], view, M, dV, dt, dM, d_means[i], d_view[chunk])
                _shape_vjp(quats[i], norm, R, scales[i], dM, d_quats[i], d_scales[i])


@always_inline
def _covariance_vjp(P, eps2d, d_conic, d_compensation, dP):  # type: ignore[no-untyped-def]
    """From the conic and the compensation to P."""
    raw_xx, xy, raw_yy = _covariance(P)
    xx, yy = raw_xx + eps2d, raw_yy + eps2d
    det = xx * yy - xy * xy
    a, b, c = yy / det, -xy / det, xx / det
    da, half_db, dc = np.float64(d_conic[0]), 0.5 * d_conic[1], np.float64(d_conic[2])
    # d covariance = -X G X for the inverse X and the symmetric gradient G
    ga, gb = da * a + half_db * b, da * b + half_db * c
    ha, hb = half_db * a + dc * b, half_db * b + dc * c
    d_xx, d_xy, d_yy = -(a * ga + b * ha), -2.0 * (a * gb + b * hb), -(b * gb + c * hb)
    raw_det = raw_xx * raw_yy - xy * xy
    if d_compensation != 0.0 and raw_det > 0.0:
        compensation = math.sqrt(raw_det / det)
        by_raw = 0.5 * d_compensation * compensation / raw_det
        by_det = -0.5 * d_compensation * compensation / det
        d_xx += by_raw * raw_yy + by_det * yy
        d_yy += by_raw * raw_xx + by_det * xx
        d_xy -= 2.0 * (by_raw + by_det) * xy
    for c_ in range(3):
        dP[0, c_] = 2.0 * d_xx * P[0, c_] + d_xy * P[1, c_]
        dP[1, c_] = 2.0 * d_yy * P[1, c_] + d_xy * P[0, c_]


@always_inline
def _camera_vjp(x, y, z, K, J, V, dP, d_mean2d, d_depth, dV, dt):  # type: ignore[no-untyped-def]
    """From P, the 2D mean and the depth to V and the mean in camera axes."""
    fx, fy = np.float64(K[0, 0]), np.float64(K[1, 1])
    d00 = d02 = d11 = d12 = 0.0
    for c in range(3):
        dV[0, c], dV[1, c] = J[0] * dP[0, c], J[2] * dP[1, c]
        dV[2, c] = J[1] * dP[0, c] + J[3] * dP[1, c]
        d00 += dP[0, c] * V[0, c]
        d02 += dP[0, c] * V[2, c]
        d11 += dP[1, c] * V[1, c]
        d12 += dP[1, c] * V[2, c]
    du, dv = np.float64(d_mean2d[0]), np.float64(d_mean2d[1])
    dt[0], dt[1] = du * fx / z, dv * fy / z
    dt[2] = d_depth - (du * fx * x + dv * fy * y) / (z * z)
    dt[2] -= (d00 * J[0] + d11 * J[2] + d02 * J[1] + d12 * J[3]) / z
    if not J[4]:  # within the image's surroundings J02 also follows x / z
        dt[0] -= d02 * fx / (z * z)
        dt[2] += d02 * fx * x / (z * z * z)
    if not J[5]:
        dt[1] -= d12 * fy / (z * z)
        dt[2] += d12 * fy * y / (z * z * z)


@always_inline
def _world_vjp(mean, view, M, dV, dt, dM, d_mean, d_view):  # type: ignore[no-untyped-def]
    """From camera axes to the world, and to the camera's pose."""
    for r in range(3):
        d_mean[r] = view[0, r] * dt[0] + view[1, r] * dt[1] + view[2, r] * dt[2]
        for c in range(3):
            dM[r, c] = view[0, r] * dV[0, c] + view[1, r] * dV[1, c] + view[2, r] * dV[2, c]
            d_view[r, c] += dt[r] * mean[c]
            d_view[r, c] += dV[r, 0] * M[c, 0] + dV[r, 1] * M[c, 1] + dV[r, 2] * M[c, 2]
        d_view[r, 3] += dt[r]


@always_inline
def _shape_vjp(quat, norm, R, scale, dM, d_quat, d_scale):  # type: ignore[no-untyped-def]
    """From M = R(q / |q|) diag(s) to the scales and the unnormalised quaternion."""
    for c in range(3):
        d_scale[c] = dM[0, c] * R[0, c] + dM[1, c] * R[1, c] + dM[2, c] * R[2, c]
        for r in range(3):
            dM[r, c] *= scale[c]
    w, x, y, z = quat[0] / norm, quat[1] / norm, quat[2] / norm, quat[3] / norm
    skew_x, skew_y, skew_z = dM[2, 1] - dM[1, 2], dM[0, 2] - dM[2, 0], dM[1, 0] - dM[0, 1]
    xy, xz, yz = dM[0, 1] + dM[1, 0], dM[0, 2] + dM[2, 0], dM[1, 2] + dM[2, 1]
    dw = 2.0 * (x * skew_x + y * skew_y + z * skew_z)
    dx = 2.0 * (w * skew_x + y * xy + z * xz - 2.0 * x * (dM[1, 1] + dM[2, 2]))
    dy = 2.0 * (w * skew_y + x * xy + z * yz - 2.0 * y * (dM[0, 0] + dM[2, 2]))
    dz = 2.0 * (w * skew_z + x * xz + y * yz - 2.0 * z * (dM[0, 0] + dM[1, 1]))
    along = dw * w + dx * x + dy * y + dz * z  # the length of q changes nothing
    d_quat[0], d_quat[1] = (dw - along * w) / norm, (dx - along * x) / norm
    d_quat[2], d_quat[3] = (dy - along * y) / norm, (dz - along * z) / norm
