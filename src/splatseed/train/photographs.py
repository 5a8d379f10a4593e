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

from splatseed.splat.rendering import photograph_of, pixels_of
from splatseed.train.device import free_bytes
from splatseed.views.view import View

__all__ = ["Photographs"]

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
            self._held[view] = pixels_of(view, self._device)
        return self._held[view].to(torch.float32).div_(255.0)
