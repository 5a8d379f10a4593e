"""Rendering a model from any camera, in colour and in depth.

Notation: the *frame* is the one the model was trained in, if its scene is known, else one fitted to
its Gaussians; depth is planar z in world units, 0 where there is none. Promise: no gradients are
computed, and renders are not cached.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32

from splatseed.render.rasterize import rasterization
from splatseed.scene import Scene
from splatseed.splat.gaussians import Gaussians, TrainingFrame, training_frame
from splatseed.views.view import View, poses_of

CORE = 0.6
"""Share of Gaussians, nearest to their median, that the frame of a lone model is fitted to."""
LEAST_ALPHA = 0.05
"""Alpha below which a pixel has no depth."""


def model_frame(gaussians: Gaussians, scene: Scene | None, test_every: int = 8) -> TrainingFrame:
    """The frame to render in: near planes and single precision work there."""
    if scene is not None and len(scene.images) > 1:
        return training_frame(poses_of(scene.split(test_every)[0]))
    origin = np.median(gaussians.means.astype(np.float64), axis=0)
    reach = np.quantile(np.linalg.norm(gaussians.means - origin, axis=1), CORE)
    return TrainingFrame(origin, 1 / float(reach) if reach > 0 else 1.0)


class ModelRenderer:
    """Renders Gaussians given in world coordinates.

    Args:
        gaussians: In world coordinates.
        frame: The frame to render in.
        device: Where to render; the CPU when left out.
    """

    def __init__(
        self, gaussians: Gaussians, frame: TrainingFrame, device: torch.device | None = None
    ) -> None:
        self.frame = frame
        self.count = len(gaussians)
        self._degree = math.isqrt(1 + gaussians.shN.shape[1]) - 1
        tensors = {name: torch.tensor(a, device=device) for name, a in gaussians.arrays().items()}
        self._means = torch.tensor(frame.points_from_world(gaussians.means), device=device)
        self._shapes: dict[str, Any] = {
            "quats": tensors["quats"],
            "scales": torch.exp(tensors["scales"] + math.log(frame.scale)),
            "opacities": torch.sigmoid(tensors["opacities"]),
        }
        colors = (tensors["sh0"], tensors["shN"]) if self._degree else tensors["sh0"]
        if isinstance(colors, tuple) and self._means.is_cuda:
            # gsplat takes them joined, our own rasteriser in two: joined once, not for every frame.
            colors = torch.cat(colors, dim=1)
        self._colors = colors

    @torch.no_grad()
    def color(self, view: View) -> Float32[np.ndarray, "H W 3"]:
        """The rendered view, in [0, 1]; the background is black."""
        return np.asarray(self._images(view, "RGB")[0].clamp_(0, 1).cpu().numpy())

    @torch.no_grad()
    def depth(self, view: View) -> Float32[np.ndarray, "H W"]:
        """Expected planar depth in world units; 0 where there is none."""
        images, alphas = self._images(view, "ED")
        depth = torch.where(alphas > LEAST_ALPHA, images, 0)[..., 0] / self.frame.scale
        return np.asarray(depth.cpu().numpy())

    def _images(self, view: View, mode: Literal["RGB", "ED"]) -> tuple[torch.Tensor, torch.Tensor]:
        posed, device = self.frame.view(view), self._means.device
        images, alphas, _ = rasterization(
            means=self._means,
            **self._shapes,
            colors=self._colors,
            sh_degree=self._degree,
            viewmats=torch.tensor(posed.cam_from_world[None], dtype=torch.float32, device=device),
            Ks=torch.tensor(posed.K[None], dtype=torch.float32, device=device),
            width=posed.width,
            height=posed.height,
            render_mode=mode,
        )
        return images[0], alphas[0]


def resized(view: View, width: int, height: int) -> View:
    """A camera with another picture size and the same vertical field of view."""
    scale = height / view.height
    K = np.diag([scale, scale, 1.0]) @ view.K
    K[0, 2] += (width - scale * view.width) / 2
    return dataclasses.replace(view, K=K, width=width, height=height)
