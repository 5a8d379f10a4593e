"""The training photographs where the Gaussians are.

Promise: on a GPU no step waits for its photograph. As bytes all of them mostly fit there, and each
is copied once; otherwise each step sends its own from pinned memory, which the GPU fetches while it
works on the step before.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from splatseed.process.torch_device import free_bytes
from splatseed.views.view import View

SHARE = 0.25
"""Most of a GPU's free memory that photographs may take."""


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
