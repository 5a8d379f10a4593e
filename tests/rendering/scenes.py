"""Small random scenes, and the slow reference called as ``rasterization`` is.

Notation: N Gaussians, C cameras, D channels, K coefficients. A scene is a dictionary of
``rasterization``'s arguments; ``losses`` weights every output with fixed random numbers, so that
one backward pass asks for every gradient at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics
from torch import Tensor

from splatseed.rendering import rasterization
from splatseed.rendering.reference import rasterize_reference

DIFFERENTIABLE = ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds")
PER_GAUSSIAN = ("means", "quats", "scales", "opacities", "colors")
Scene = dict[str, Any]


def random_scene(
    rng: np.random.Generator,
    n: int = 60,
    *,
    cameras: int = 1,
    size: tuple[int, int] = (29, 21),
    channels: int = 3,
    coefficients: int | None = None,
) -> Scene:
    """Gaussians of all shapes in front of cameras that look at them, some outside of the image."""
    width, height = size
    shape = (n, channels) if coefficients is None else (n, coefficients, 3)
    arrays = {
        "means": rng.uniform(-1.2, 1.2, (n, 3)),
        "quats": rng.normal(size=(n, 4)) * rng.uniform(0.3, 3.0, (n, 1)),
        "scales": np.exp(rng.uniform(-4.5, -0.7, (n, 3))),
        "opacities": rng.uniform(0.02, 0.98, n),
        "colors": rng.uniform(0.0, 1.0, shape) if coefficients is None else rng.normal(size=shape),
        "viewmats": np.stack([_viewmat(rng) for _ in range(cameras)]),
        "Ks": np.stack([_intrinsics(rng, width, height) for _ in range(cameras)]),
        "backgrounds": rng.uniform(0.0, 1.0, (cameras, shape[-1])),
    }
    tensors = {name: torch.tensor(array, dtype=torch.float32) for name, array in arrays.items()}
    return {**tensors, "width": width, "height": height}


def _viewmat(rng: np.random.Generator) -> np.ndarray:
    """A camera three units away from the origin, turned a little off it."""
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, [*rng.uniform(-0.3, 0.3, 2), 3.0]
    return viewmat


def _intrinsics(rng: np.random.Generator, width: int, height: int) -> np.ndarray:
    focal = max(width, height) * rng.uniform(0.9, 1.3, 2)
    center = np.array([width, height]) * rng.uniform(0.4, 0.6, 2)
    return np.array([[focal[0], 0, center[0]], [0, focal[1], center[1]], [0, 0, 1]])


def slow_rasterization(
    *,
    viewmats: Tensor,
    Ks: Tensor,
    colors: Tensor,
    backgrounds: Tensor | None = None,
    sh_degree: int | None = None,
    render_mode: str = "RGB",
    rasterize_mode: str = "classic",
    packed: bool = True,
    **rest: Any,
) -> tuple[Tensor, Tensor]:
    """``rasterize_reference`` for C cameras, all colour models and modes: images and alphas."""
    images, alphas = [], []
    for camera, viewmat in enumerate(viewmats):
        shades = _shades(colors, rest["means"], viewmat, camera, sh_degree)
        depths = (rest["means"] @ viewmat[:3, :3].T + viewmat[:3, 3])[:, 2:]
        background = None if backgrounds is None else backgrounds[camera]
        if "D" in render_mode:
            parts = [shades, depths] if "RGB" in render_mode else [depths]
            shades = torch.cat(parts, dim=1)
            if background is not None:
                background = torch.cat([background, background[:1] * 0.0])[-shades.shape[1] :]
        image, alpha, _ = rasterize_reference(
            colors=shades, viewmat=viewmat, K=Ks[camera], background=background,
            antialiased=rasterize_mode == "antialiased", **rest,
        )  # fmt: skip
        if "ED" in render_mode:
            expected = image[..., -1:] / alpha[..., None].clamp(min=1e-10)
            image = torch.cat([image[..., :-1], expected], dim=-1)
        images.append(image)
        alphas.append(alpha[..., None])
    return torch.stack(images), torch.stack(alphas)


def _shades(
    colors: Tensor, means: Tensor, viewmat: Tensor, camera: int, sh_degree: int | None
) -> Tensor:
    axes = 2 if sh_degree is None else 3
    own = colors if colors.dim() == axes else colors[camera]
    if sh_degree is None:
        return own
    directions = means - torch.linalg.inv(viewmat)[:3, 3]
    return torch.clamp_min(_spherical_harmonics(sh_degree, directions, own) + 0.5, 0.0)


def gradients(
    scene: Scene, *, slow: bool = False, of: Iterable[str] = DIFFERENTIABLE, **options: Any
) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
    """Image, alpha and the gradient of each input, the loss being a fixed random weighting of both.

    With ``slow``, of the reference in float64.
    """
    dtype = torch.float64 if slow else torch.float32
    inputs = {
        name: value.to(dtype).detach().clone().requires_grad_(name in of)
        if isinstance(value, Tensor)
        else value
        for name, value in scene.items()
    }
    run = slow_rasterization if slow else rasterization
    image, alpha = run(**inputs, **options)[:2]
    weights = np.random.default_rng(1)
    loss = (image * torch.tensor(weights.normal(size=tuple(image.shape)), dtype=dtype)).sum()
    loss = loss + (alpha * torch.tensor(weights.normal(size=tuple(alpha.shape)), dtype=dtype)).sum()
    loss.backward()
    by_name = {
        name: torch.zeros_like(inputs[name]) if inputs[name].grad is None else inputs[name].grad
        for name in of
        if inputs.get(name) is not None
    }
    return image.detach(), alpha.detach(), by_name
