"""Photographs and masks of views as tensors, for comparison with renders."""

from __future__ import annotations

from collections.abc import Sequence
from weakref import WeakKeyDictionary

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from splatseed.photos.view import View
from splatseed.runtime.torch_device import free_bytes

MAX_MEMORY_SHARE = 0.25  # of a GPU's free memory, for photographs


class PhotographCache:
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
            if free is None or total <= MAX_MEMORY_SHARE * free:
                self._held = {}

    def get(self, view: View) -> Float[Tensor, "H W 3"]:
        """The view's photograph as float32 from 0 to 1."""
        if self._held is None:
            return photograph_tensor(view, self._device)
        if view not in self._held:
            self._held[view] = _bytes_of(view, self._device)
        return self._held[view].to(torch.float32).div_(255.0)


def photograph_tensor(view: View, device: torch.device) -> Float[Tensor, "H W 3"]:
    """The view's photograph as float32 from 0 to 1."""
    return _bytes_of(view, device).to(torch.float32).div_(255.0)


def _bytes_of(view: View, device: torch.device) -> UInt8[Tensor, "H W 3"]:
    # A copy: PyTorch warns on stderr about read-only arrays, which a view's may be.
    pixels = torch.tensor(view.photograph)
    if device.type == "cuda":  # from pinned memory a GPU fetches it while it works on earlier steps
        pixels = pixels.pin_memory()
    return pixels.to(device, non_blocking=True)


_MASKS: WeakKeyDictionary[View, dict[torch.device, Bool[Tensor, "H W"]]] = WeakKeyDictionary()


def mask_tensor(view: View, device: torch.device) -> Bool[Tensor, "H W"] | None:
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
