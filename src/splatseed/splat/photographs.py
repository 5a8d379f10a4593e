"""Photographs and masks of views as tensors, for comparison with renders."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseed.photos.view import View
from splatseed.runtime.torch_device import free_bytes

MAX_MEMORY_SHARE = 0.25  # of a GPU's free memory, for photographs


class PhotographCache:
    """Photographs of views on the device of the Gaussians.

    A GPU keeps all photographs as bytes if they fit into a share of its free memory; otherwise each
    call copies one.
    """

    def __init__(self, views: Sequence[View], device: torch.device) -> None:
        self._device = device
        self._cached: dict[View, UInt8[Tensor, "H W 3"]] | None = None
        if device.type == "cuda":
            free = free_bytes(device)
            arrays = [each for view in views for each in (view.photograph, view.mask)]
            total = sum(each.nbytes for each in arrays if each is not None)
            if free is None or total <= MAX_MEMORY_SHARE * free:
                self._cached = {}

    def get(self, view: View) -> Float[Tensor, "H W 3"]:
        """Return the view's photograph as float32 from 0 to 1."""
        if self._cached is None:
            return photograph_tensor(view, self._device)
        if view not in self._cached:
            self._cached[view] = _bytes_of(view, self._device)
        return self._cached[view].to(torch.float32).div_(255.0)


def photograph_tensor(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """Return the view's photograph as float32 from 0 to 1."""
    return _bytes_of(view, device).to(torch.float32).div_(255.0)


def _bytes_of(view: View, device: torch.device) -> UInt8[Tensor, "H W 3"]:
    # torch.tensor copies: from_numpy warns about read-only arrays.
    pixels = torch.tensor(view.photograph)
    if device.type == "cuda":  # makes the copy asynchronous
        pixels = pixels.pin_memory()
    return pixels.to(device, non_blocking=True)


_MASKS: WeakKeyDictionary[View, dict[torch.device, Bool[Tensor, "H W"]]] = WeakKeyDictionary()
_OPACITIES: WeakKeyDictionary[View, dict[torch.device, UInt8[Tensor, "H W"]]] = WeakKeyDictionary()


def mask_tensor(view: View, device: torch.device) -> Bool[Tensor, "H W"] | None:
    """Return the mask of a view's valid pixels, None for all; cached while the view lives."""
    return None if view.mask is None else _cached(_MASKS, view, view.mask, device)


def over_background(
    photograph: Float[Tensor, "H W 3"], view: View, background: Float[Tensor, " 3"]
) -> Float[Tensor, "H W 3"]:
    """Composite a view's photograph, which is over black, over a colour."""
    if view.opacity is None:
        return photograph
    opacity = _cached(_OPACITIES, view, view.opacity, photograph.device)
    return photograph + (1.0 - opacity[..., None] / 255.0) * background


def _cached(
    kept: WeakKeyDictionary[View, dict[torch.device, Tensor]],
    view: View,
    pixels: np.ndarray,
    device: torch.device,
) -> Tensor:
    """Return pixels of a view as a tensor; kept while the view lives."""
    cached = kept.setdefault(view, {})
    if device not in cached:
        cached[device] = torch.tensor(pixels).to(device)
    return cached[device]


def fill_masked(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None,
) -> Float[Tensor, "H W 3"]:
    """Replace masked pixels of a render by the photograph's: they get no error and no gradient."""
    return render if mask is None else torch.where(mask[..., None], render, photograph)
