"""Render Gaussians from a view, on CPU or CUDA; training, scoring and viewing share this code.

Parameters are gsplat's dict of tensors: ``means``, ``scales`` (logarithms), ``quats``,
``opacities`` (logits), ``sh0``, ``shN``. Copies to a GPU are asynchronous.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from splatseed.photos.view import View
from splatseed.rendering import rasterization
from splatseed.scene import BLACK, Color
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.training_frame import TrainingFrame

MIN_ALPHA = 0.05  # a pixel of lower alpha has no depth


class CameraTensors(NamedTuple):
    """A view's camera on a device: the rasteriser's arguments, and the pose in float64."""

    viewmats: Float[Tensor, "1 4 4"]
    Ks: Float[Tensor, "1 3 3"]
    cam_from_world: Float[Tensor, "4 4"]


_CAMERAS: WeakKeyDictionary[View, dict[torch.device, CameraTensors]] = WeakKeyDictionary()


def camera_tensors(view: View, device: torch.device) -> CameraTensors:
    """Return the view's camera on a device; cached while the view lives."""
    cached = _CAMERAS.setdefault(view, {})
    if device not in cached:
        pose, K = (torch.from_numpy(np.array(each)) for each in (view.cam_from_world, view.K))
        viewmats, Ks = (each.to(torch.float32)[None].to(device) for each in (pose, K))
        cached[device] = CameraTensors(viewmats, Ks, pose.to(device))
    return cached[device]


def render_view(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict, view: View, sh_degree: int
) -> tuple[Float[Tensor, "H W 3"], dict[str, Any]]:
    """Render a view; return the image and the rasteriser's ``info``.

    Harmonics beyond ``sh_degree`` are ignored. Gaussians and pose are in one frame.
    """
    images, _, info = _rasterize(params, view, sh_degree)
    return images, info


def render_features(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    features: Float[Tensor, "N D"],
) -> Float[Tensor, "H W D"]:
    """Render features of the Gaussians in place of their colours."""
    return _rasterize(params, view, features)[0]


class _Opacity(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, logits: Tensor) -> Tensor:
        opacities = logits.neg().exp_().add_(1.0).reciprocal_()
        ctx.save_for_backward(opacities)
        return opacities

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> Tensor:
        opacities: Tensor = ctx.saved_tensors[0]
        return upstream[0] * opacities * (1.0 - opacities)


def opacity_from_logits(logits: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """Return 1 / (1 + exp(-x)), differentiable and independent of the number of threads.

    ``torch.sigmoid`` on the CPU rounds differently at the ends of each thread's part.
    """
    opacities: Tensor = _Opacity.apply(logits)
    return opacities


def _rasterize(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    features: Tensor | int,
    mode: Literal["RGB", "ED"] = "RGB",
    *,
    antialiased: bool = False,
    background: Float[Tensor, "1 3"] | None = None,
) -> tuple[Float[Tensor, "H W D"], Float[Tensor, "H W 1"], dict[str, Any]]:
    """Render features, or harmonics up to a degree; return image, alphas and ``info``."""
    colors: Tensor | tuple[Tensor, Tensor]
    if isinstance(features, Tensor):
        colors, degree = features, None
    else:  # unused coefficients would cost copies and optimiser steps for nothing
        colors = (params["sh0"], params["shN"]) if features else params["sh0"]
        degree = features
    camera = camera_tensors(view, params["means"].device)
    images, alphas, info = rasterization(
        params["means"], params["quats"], torch.exp(params["scales"]),
        opacity_from_logits(params["opacities"]), colors, camera.viewmats, camera.Ks,
        view.width, view.height, near_plane=view.near, sh_degree=degree, packed=False,
        render_mode=mode, rasterize_mode="antialiased" if antialiased else "classic",
        backgrounds=background,
    )  # fmt: skip
    # Unlike indexing, squeeze's backward allocates no image of zeros.
    return images.squeeze(0), alphas.squeeze(0), info


class ModelRenderer:
    """Renders Gaussians in world coordinates without gradients, by default on the CPU.

    ``frame`` provides the near plane, and coordinates that suit single precision. Antialiasing
    follows ``Gaussians.antialiased``. ``background`` is behind all Gaussians.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        frame: TrainingFrame,
        device: torch.device | None = None,
        background: Color = BLACK,
    ) -> None:
        self.frame, self.count = frame, len(gaussians)
        self._antialiased = gaussians.antialiased
        arrays = frame.gaussians_from_world(gaussians).arrays()
        self._params = {name: torch.tensor(array, device=device) for name, array in arrays.items()}
        self._behind = None
        if any(background):
            self._behind = torch.tensor([background], dtype=torch.float32, device=device) / 255

    def image(self, view: View) -> Float[Tensor, "H W 3"]:
        """Render a view: about 0 to 1, black or ``background`` behind."""
        return self._images(view, "RGB")[0]

    def color(self, view: View) -> Float32[np.ndarray, "H W 3"]:
        """Render a view as an array, clamped to [0, 1]."""
        return np.asarray(self.image(view).clamp_(0, 1).cpu().numpy())

    def depth(self, view: View) -> Float32[np.ndarray, "H W"]:
        """Render expected planar depth in world units; 0 where alpha is too low."""
        image, alphas = self._images(view, "ED")
        depth = torch.where(alphas > MIN_ALPHA, image, 0)[..., 0] / self.frame.scale
        return np.asarray(depth.cpu().numpy())

    @torch.no_grad()
    def _images(self, view: View, mode: Literal["RGB", "ED"]) -> tuple[Tensor, Tensor]:
        degree = math.isqrt(1 + self._params["shN"].shape[1]) - 1
        return _rasterize(
            self._params, self.frame.view(view), degree, mode, antialiased=self._antialiased,
            background=self._behind if mode == "RGB" else None,
        )[:2]  # fmt: skip
