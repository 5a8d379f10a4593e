"""The interface of densification strategies, which change the number of Gaussians in training.

Promise: ``state`` is all that a checkpoint must hold; both backends run the same classes.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatseed.photos.view import View
from splatseed.training.device import Capacity
from splatseed.training.parameters import Optimizers, Parameters


class Strategy:
    """Base strategy; on its own (``none``) it keeps the Gaussians."""

    def __init__(self, capacity: Capacity) -> None:
        self.state: dict[str, Any] = {}
        self.capacity = capacity

    def regularization(self, params: Parameters) -> Float[Tensor, ""] | None:  # noqa: ARG002  (the interface's name)
        """Return a term to add to the loss; None for no term."""
        return None

    def before_backward(
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any
    ) -> None:
        """Prepare for the backward pass; ``info`` is the rasteriser's."""

    def observe(
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Measure the result of a step, after the optimisers and before ``after_step``."""

    def after_step(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Add, remove or move Gaussians; may replace parameters and their moments."""
