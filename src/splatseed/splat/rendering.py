"""Rendering Gaussians from a view, and the photographs that renders are compared with.

Notation: gsplat's parameter dict as tensors: ``means``, ``scales`` (logarithms), ``quats``,
``opacities`` (logits), ``sh0``, ``shN``. Promise: one rasteriser call serves training and scoring
on CPU and CUDA alike; a view's camera is copied to a GPU once, and no step waits for its
photograph. As bytes all photographs mostly fit on a GPU, and each is copied once; otherwise each
step sends its own from pinned memory, which the GPU fetches while it works on the step before.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatseed.render import rasterization
from splatseed.runtime.torch_device import free_bytes
from splatseed.views.view import View

SHARE = 0.25
"""Most of a GPU's free memory that photographs may take."""


class CameraTensors(NamedTuple):
    """A view's camera on a device."""

    viewmats: Float[Tensor, "1 4 4"]
    """cam_from_world, as the rasteriser takes it, float32."""
    Ks: Float[Tensor, "1 3 3"]
    """Pinhole matrix, likewise."""
    cam_from_world: Float[Tensor, "4 4"]
    """In full, float64."""


_CAMERAS: WeakKeyDictionary[View, dict[torch.device, CameraTensors]] = WeakKeyDictionary()


def camera_of(view: View, device: torch.device) -> CameraTensors:
    """The view's camera on a device, copied there once as long as the view lives."""
    kept = _CAMERAS.setdefault(view, {})
    if device not in kept:
        pose, K = (torch.from_numpy(np.array(each)) for each in (view.cam_from_world, view.K))
        viewmats, Ks = (each.to(torch.float32)[None].to(device) for each in (pose, K))
        kept[device] = CameraTensors(viewmats, Ks, pose.to(device))
    return kept[device]


def render_view(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict, view: View, sh_degree: int
) -> tuple[Float[Tensor, "H W 3"], dict[str, Any]]:
    """The render of a view, and the rasteriser's ``info``.

    Args:
        params: The parameter dict, in the frame of the view's camera.
        view: The view whose camera is used.
        sh_degree: Degree of spherical harmonics in use; coefficients beyond it are ignored.
    """
    images, info = _rasterize(params, view, _harmonics(params, sh_degree), sh_degree)
    return images, info


def render_features(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    features: Float[Tensor, "N D"],
) -> Float[Tensor, "H W D"]:
    """The Gaussians rendered with arbitrary features in place of colours."""
    return _rasterize(params, view, features, None)[0]


def _rasterize(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    colors: Tensor | tuple[Tensor, Tensor],
    sh_degree: int | None,
) -> tuple[Float[Tensor, "H W D"], dict[str, Any]]:
    means = params["means"]
    camera = camera_of(view, means.device)
    images, _, info = rasterization(
        means=means,
        quats=params["quats"],
        scales=torch.exp(params["scales"]),
        opacities=torch.sigmoid(params["opacities"]),
        colors=colors,
        viewmats=camera.viewmats,
        Ks=camera.Ks,
        width=view.width,
        height=view.height,
        sh_degree=sh_degree,
        packed=False,
    )
    return images.squeeze(0), info  # unlike indexing, its backward allocates no image of zeros


def _harmonics(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict, sh_degree: int
) -> Tensor | tuple[Tensor, Tensor]:
    """The coefficients in use; unused ones would cost copies and optimiser steps for nothing."""
    return params["sh0"] if sh_degree == 0 else (params["sh0"], params["shN"])


class Photographs:
    """Photographs of views on a device.

    Args:
        views: The views to learn from.
        device: Where the Gaussians are.
    """

    def __init__(self, views: Sequence[View], device: torch.device) -> None:
        self._device = device
        self._held: dict[View, UInt8[Tensor, "H W 3"]] | None = None
        if device.type == "cuda":
            free = free_bytes(device)
            total = sum(view.photograph.nbytes for view in views)
            if free is None or total <= SHARE * free:
                self._held = {}

    def of(self, view: View) -> Float[Tensor, "H W 3"]:
        """The view's photograph as float32 from 0 to 1."""
        if self._held is None:
            return photograph_of(view, self._device)
        if view not in self._held:
            self._held[view] = _pixels_of(view, self._device)
        return self._held[view].to(torch.float32).div_(255.0)


def photograph_of(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """The view's photograph as float32 from 0 to 1."""
    return _pixels_of(view, device).to(torch.float32).div_(255.0)


def _pixels_of(view: View, device: torch.device) -> UInt8[Tensor, "H W 3"]:
    """The view's photograph in bytes."""
    # A copy: PyTorch warns on stderr about read-only arrays, which a view's may be.
    pixels = torch.tensor(view.photograph)
    if device.type == "cuda":  # from pinned memory a GPU fetches it while it works on earlier steps
        pixels = pixels.pin_memory()
    return pixels.to(device, non_blocking=True)
