"""Rendering Gaussians from a view, and the photographs that renders are compared with.

Notation: gsplat's parameter dict as tensors: ``means``, ``scales`` (logarithms), ``quats``,
``opacities`` (logits), ``sh0``, ``shN``. Promise: one rasteriser serves training, scoring and
viewing on CPU and CUDA alike; no step waits for what is copied to a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from torch import Tensor

from splatseed.io.files import StrPath
from splatseed.io.staging import atomic_file
from splatseed.photos.view import View
from splatseed.rendering import rasterization
from splatseed.runtime.torch_device import free_bytes
from splatseed.splat.gaussians import Gaussians, TrainingFrame

SHARE = 0.25  # most of a GPU's free memory that photographs may take
LEAST_ALPHA = 0.05  # below which a pixel has no depth
GAP = 4  # white columns between the pictures of a row


class CameraTensors(NamedTuple):
    """A view's camera on a device: as the rasteriser takes it, and its pose in float64."""

    viewmats: Float[Tensor, "1 4 4"]
    Ks: Float[Tensor, "1 3 3"]
    cam_from_world: Float[Tensor, "4 4"]


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
    """The render of a view, in the frame of its camera, and the rasteriser's ``info``.

    Coefficients of harmonics beyond ``sh_degree`` are ignored.
    """
    images, _, info = _rasterize(params, view, sh_degree)
    return images, info


def render_features(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    features: Float[Tensor, "N D"],
) -> Float[Tensor, "H W D"]:
    """The Gaussians rendered with arbitrary features in place of colours."""
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


def opacities_of(logits: Float[Tensor, "*N"]) -> Float[Tensor, "*N"]:
    """1 / (1 + exp(-x)), differentiable, and the same whatever the number of threads.

    On the CPU ``torch.sigmoid`` is not: it rounds differently at the ends of each thread's part.
    """
    opacities: Tensor = _Opacity.apply(logits)  # type: ignore[no-untyped-call]
    return opacities


def _rasterize(
    params: Mapping[str, Tensor] | torch.nn.ParameterDict,
    view: View,
    shown: Tensor | int,
    mode: Literal["RGB", "ED"] = "RGB",
    *,
    antialiased: bool = False,
) -> tuple[Float[Tensor, "H W D"], Float[Tensor, "H W 1"], dict[str, Any]]:
    """Render features, or harmonics up to a degree: image, alphas, ``info``."""
    colors: Tensor | tuple[Tensor, Tensor]
    if isinstance(shown, Tensor):
        colors, degree = shown, None
    else:  # unused coefficients would cost copies and optimiser steps for nothing
        colors = (params["sh0"], params["shN"]) if shown else params["sh0"]
        degree = shown
    camera = camera_of(view, params["means"].device)
    images, alphas, info = rasterization(
        params["means"], params["quats"], torch.exp(params["scales"]),
        opacities_of(params["opacities"]), colors, camera.viewmats, camera.Ks,
        view.width, view.height, near_plane=view.near, sh_degree=degree, packed=False,
        render_mode=mode, rasterize_mode="antialiased" if antialiased else "classic",
    )  # fmt: skip
    # Unlike indexing, squeeze's backward allocates no image of zeros.
    return images.squeeze(0), alphas.squeeze(0), info


class ModelRenderer:
    """Renders Gaussians of the world, without gradients, on a device, by default the CPU.

    In ``frame`` near planes and single precision work. Antialiased Gaussians are rendered so.
    """

    def __init__(
        self, gaussians: Gaussians, frame: TrainingFrame, device: torch.device | None = None
    ) -> None:
        self.frame, self.count = frame, len(gaussians)
        self._antialiased = gaussians.antialiased
        arrays = frame.gaussians_from_world(gaussians).arrays()
        self._params = {name: torch.tensor(array, device=device) for name, array in arrays.items()}

    def image(self, view: View) -> Float[Tensor, "H W 3"]:
        """The render of a view of the world, about 0 to 1; the background is black."""
        return self._images(view, "RGB")[0]

    def color(self, view: View) -> Float32[np.ndarray, "H W 3"]:
        """Likewise, clamped to [0, 1]."""
        return np.asarray(self.image(view).clamp_(0, 1).cpu().numpy())

    def depth(self, view: View) -> Float32[np.ndarray, "H W"]:
        """Expected planar depth in world units; 0 where there is none."""
        image, alphas = self._images(view, "ED")
        depth = torch.where(alphas > LEAST_ALPHA, image, 0)[..., 0] / self.frame.scale
        return np.asarray(depth.cpu().numpy())

    @torch.no_grad()
    def _images(self, view: View, mode: Literal["RGB", "ED"]) -> tuple[Tensor, Tensor]:
        degree = math.isqrt(1 + self._params["shN"].shape[1]) - 1
        return _rasterize(
            self._params, self.frame.view(view), degree, mode, antialiased=self._antialiased
        )[:2]


# Photographs --------------------------------------------------------------------------------------


class Photographs:
    """Photographs of views on a device, where the Gaussians are.

    As bytes all mostly fit on a GPU, and each is copied once; otherwise each step sends its own.
    """

    def __init__(self, views: Sequence[View], device: torch.device) -> None:
        self._device = device
        self._held: dict[View, UInt8[Tensor, "H W 3"]] | None = None
        if device.type == "cuda":
            free = free_bytes(device)
            held = [each for view in views for each in (view.photograph, view.mask)]
            total = sum(each.nbytes for each in held if each is not None)
            if free is None or total <= SHARE * free:
                self._held = {}

    def of(self, view: View) -> Float[Tensor, "H W 3"]:
        """The view's photograph as float32 from 0 to 1."""
        if self._held is None:
            return photograph_of(view, self._device)
        if view not in self._held:
            self._held[view] = _bytes_of(view, self._device)
        return self._held[view].to(torch.float32).div_(255.0)


def photograph_of(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """The view's photograph as float32 from 0 to 1."""
    return _bytes_of(view, device).to(torch.float32).div_(255.0)


def _bytes_of(view: View, device: torch.device) -> UInt8[Tensor, "H W 3"]:
    # A copy: PyTorch warns on stderr about read-only arrays, which a view's may be.
    pixels = torch.tensor(view.photograph)
    if device.type == "cuda":  # from pinned memory a GPU fetches it while it works on earlier steps
        pixels = pixels.pin_memory()
    return pixels.to(device, non_blocking=True)


_MASKS: WeakKeyDictionary[View, dict[torch.device, Bool[Tensor, "H W"]]] = WeakKeyDictionary()


def mask_of(view: View, device: torch.device) -> Bool[Tensor, "H W"] | None:
    """The view's pixels that count, None: all; copied to the device once as long as it lives."""
    if view.mask is None:
        return None
    kept = _MASKS.setdefault(view, {})
    if device not in kept:
        kept[device] = torch.tensor(view.mask).to(device)
    return kept[device]


def fill_masked(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None,
) -> Float[Tensor, "H W 3"]:
    """The render with the photograph's own pixels where these do not count: no error, no gradient.

    Without a mask it is the render itself.
    """
    return render if mask is None else torch.where(mask[..., None], render, photograph)


# Pictures -----------------------------------------------------------------------------------------


def error_picture(errors: Float32[np.ndarray, "H W"]) -> UInt8[np.ndarray, "H W 3"]:
    """FLIP of each pixel in the colours of its authors: black is 0, the brightest 1."""
    from matplotlib import colormaps  # noqa: PLC0415  (slow to import)

    return np.asarray(colormaps["magma"](errors, bytes=True)[..., :3], np.uint8)


def as_bytes(image: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    """Colours in [0, 1] as 8-bit integers; others are clamped."""
    return np.asarray(np.rint(np.clip(image, 0, 1) * 255), np.uint8)


def write_render(
    path: StrPath,
    photograph: UInt8[np.ndarray, "H W 3"],
    render: Float32[np.ndarray, "H W 3"],
    errors: Float32[np.ndarray, "H W"],
) -> None:
    """Write a PNG of photograph, render and FLIP in a row."""
    path = Path(path)
    from PIL import Image  # noqa: PLC0415  (slow to import)

    gap = np.full((len(photograph), GAP, 3), 255, np.uint8)
    row = [photograph, gap, as_bytes(render), gap, error_picture(errors)]
    with atomic_file(path) as partial:
        Image.fromarray(np.concatenate(row, axis=1)).save(partial)


def picture_names(image_names: Iterable[str]) -> dict[str, str]:
    """The file name of each image's picture; folders in an image's name become part of it.

    Where a.jpg and a.jpeg would have the same, the later one becomes a-2.png.

    Example:
        >>> picture_names(["a/b.jpg", "a_b.jpg", "a/c.jpg"])
        {'a/b.jpg': 'a_b.png', 'a_b.jpg': 'a_b-2.png', 'a/c.jpg': 'a_c.png'}
    """
    pictures: dict[str, str] = {}  # the image of each picture
    for name in image_names:
        stem = Path(name).with_suffix("").as_posix().replace("/", "_")
        picture, number = f"{stem}.png", 1
        while picture in pictures:
            number += 1
            picture = f"{stem}-{number}.png"
        pictures[picture] = name
    return {name: picture for picture, name in pictures.items()}
