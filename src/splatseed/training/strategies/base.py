"""The interface of densification strategies, which change the number of Gaussians in training.

Promise: ``state`` is all that a checkpoint must hold; both backends run the same classes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from jaxtyping import Float
from torch import Tensor

from splatseed.photos.view import View
from splatseed.training.device import Capacity
from splatseed.training.parameters import Optimizers, Parameters
from splatseed.training.settings import TrainSettings


class Strategy:
    """Base strategy; on its own (``none``) it keeps the Gaussians."""

    def __init__(self, capacity: Capacity) -> None:
        self.state: dict[str, Any] = {}
        self.capacity = capacity

    @classmethod
    def of(
        cls,
        settings: TrainSettings,  # noqa: ARG003  (the interface's names)
        capacity: Capacity,
        depths: Mapping[str, Float[Tensor, "h w"]],  # noqa: ARG003
        share: float,  # noqa: ARG003
    ) -> Self:
        """Make the strategy of a run.

        Args:
            settings: The run's.
            capacity: How many Gaussians it may grow to.
            depths: For strategies that use stereo: planar depth of training views by name, in
                training units, 0 where unknown.
            share: The fraction of the training views that have depths.
        """
        return cls(capacity)

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
