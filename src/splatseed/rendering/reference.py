"""Specify the rasteriser: a slow, dense, readable renderer, float64 if its inputs are.

It evaluates every Gaussian at every pixel; PyTorch's autograd gives all gradients. Tests compare
the kernels with this file; where they disagree, this file is right. Conventions: OpenCV camera
axes, pixel centres at +0.5, quaternions wxyz. Cut-offs are those of gsplat 1.5.3.
"""

from __future__ import annotations

import torch
from torch import Tensor

from splatseed.rendering._kernels.projection import EDGE, MAX_SIGMAS, MIN_ALPHA

MAX_ALPHA = 0.999
"""Largest alpha: see ``_kernels.blending``."""
MIN_TRANSMITTANCE = 1e-4
"""Transmittance at which a pixel is finished."""


def rasterize_reference(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    background: Tensor | None = None,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor]:
    """Render one camera.

    Args:
        means: [N, 3], world.
        quats: [N, 4].
        scales: [N, 3].
        opacities: [N].
        colors: [N, D].
        viewmat: cam_from_world, [4, 4].
        K: [3, 3], px.
        width: Pixels.
        height: Pixels.
        near_plane: Smallest z.
        far_plane: Largest z.
        eps2d: Blur added to the 2D covariance, px^2.
        background: [D].
        antialiased: Whether opacities are compensated for the blur.

    Returns:
        Image [H, W, D], alpha [H, W], and 2D means [N, 2].
    """
    # m_c = W m + t
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    in_range = (points[:, 2] >= near_plane) & (points[:, 2] <= far_plane)
    # Culled Gaussians are moved far in front of the camera: their gradients must not be NaN.
    points = torch.where(in_range[:, None], points, torch.tensor([0.0, 0.0, 1.0]).to(points))
    means2d = points[:, :2] / points[:, 2:] * _focal(K) + K[:2, 2]
    covariance, raw = _covariance2d(points, quats, scales, viewmat, K, width, height, eps2d)
    if antialiased:
        # The blur widens a Gaussian; its opacity falls by the ratio of the areas.
        ratio = torch.linalg.det(raw) / torch.linalg.det(covariance)
        opacities = opacities * ratio.clamp(min=0.0).sqrt()
    visible = in_range & _touches_image(means2d, covariance, opacities, width, height)
    # Front to back, visible Gaussians first.
    order = torch.argsort(torch.where(visible, points[:, 2], torch.inf), stable=True)[
        : int(visible.sum())
    ]
    image, transmittance = _blend(
        means2d[order], torch.linalg.inv(covariance[order]), opacities[order], colors[order],
        width, height,
    )  # fmt: skip
    if background is not None:
        image = image + transmittance[..., None] * background
    return image, 1.0 - transmittance, means2d


def _focal(K: Tensor) -> Tensor:
    return torch.stack([K[0, 0], K[1, 1]])


def _rotations(quats: Tensor) -> Tensor:
    """Return the rotations [N, 3, 3] of wxyz quaternions [N, 4] of any length."""
    w, x, y, z = torch.unbind(quats / quats.norm(dim=-1, keepdim=True), dim=-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).reshape(-1, 3, 3)


def _covariance2d(
    points: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float,
) -> tuple[Tensor, Tensor]:
    """Return the 2D covariances [N, 2, 2] with the blur, and without."""
    factor = _rotations(quats) * scales[:, None, :]
    x, y, z = torch.unbind(points, dim=-1)
    focal, center = _focal(K), K[:2, 2]
    size = torch.tensor([width, height]).to(points)
    low, high = -center - EDGE * size, size - center + EDGE * size
    u = torch.maximum(torch.minimum(x / z, high[0] / focal[0]), low[0] / focal[0])
    v = torch.maximum(torch.minimum(y / z, high[1] / focal[1]), low[1] / focal[1])
    zero = torch.zeros_like(z)
    # J of (fx x / z, fy y / z), with x / z and y / z clamped as u and v
    jacobian = torch.stack(
        [focal[0] / z, zero, -focal[0] * u / z, zero, focal[1] / z, -focal[1] * v / z], dim=-1
    ).reshape(-1, 2, 3)
    # J W R S, whose product with its transpose is the covariance J W (R S S' R') W' J'
    half = jacobian @ viewmat[:3, :3] @ factor
    raw = half @ half.mT
    return raw + eps2d * torch.eye(2).to(raw), raw


def _touches_image(
    means2d: Tensor, covariance: Tensor, opacities: Tensor, width: int, height: int
) -> Tensor:
    """Test whether the box of alpha >= 1/255, at most 3.33 sigmas, overlaps the image, bool [N]."""
    # opacity exp(-sigmas^2 / 2) = 1/255
    sigmas = (
        (2 * torch.log(opacities.clamp(min=MIN_ALPHA) / MIN_ALPHA)).sqrt().clamp(max=MAX_SIGMAS)
    )
    radii = torch.ceil(sigmas[:, None] * torch.diagonal(covariance, dim1=1, dim2=2).sqrt())
    size = torch.tensor([width, height]).to(means2d)
    inside = ((means2d + radii > 0) & (means2d - radii < size)).all(dim=-1)
    return inside & (opacities >= MIN_ALPHA) & (radii > 0).all(dim=-1)


def _blend(
    means2d: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians in depth order: return image [H, W, D] and final transmittance [H, W]."""
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    pixels = torch.stack([x, y], dim=-1).to(means2d) + 0.5
    transmittance = torch.ones(height, width).to(means2d)
    unfinished = torch.ones(height, width, dtype=torch.bool)
    image = torch.zeros(height, width, colors.shape[1]).to(means2d)
    for mean, conic, opacity, color in zip(means2d, conics, opacities, colors, strict=True):
        d = mean - pixels
        # sigma = d' conic d / 2; alpha = opacity exp(-sigma)
        sigma = 0.5 * (d[..., None, :] @ conic @ d[..., :, None])[..., 0, 0]
        alpha = (opacity * torch.exp(-sigma)).clamp(max=MAX_ALPHA)
        counts = unfinished & (sigma >= 0) & (alpha >= MIN_ALPHA)
        after = torch.where(counts, transmittance * (1 - alpha), transmittance)
        # The Gaussian that would finish a pixel is not drawn.
        unfinished = unfinished & ~(counts & (after <= MIN_TRANSMITTANCE))
        weight = torch.where(counts & unfinished, alpha * transmittance, torch.zeros_like(alpha))
        image = image + weight[..., None] * color
        transmittance = torch.where(unfinished, after, transmittance)
    return image, transmittance
