"""The interface of densification strategies, which change the number of Gaussians in training.

A checkpoint stores only ``state``: keep there whatever changes in training. CPU and CUDA use the
same classes. Draw random numbers from PyTorch's generator, which is seeded before each step.
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
            capacity: How many Gaussians it may grow to: adding none beyond ``capacity.limit`` is
                up to the strategy.
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
        """Add, remove or move Gaussians, after the optimisers have taken step ``step`` (from 0).

        Change their number with ``remove``, ``split`` and the other functions of
        ``gsplat.strategy.ops``: they also change the parameter ``min_view_depth``, the optimisers'
        moments, and the tensors in the state that is passed to them, which must be [N, ...]. Never
        remove all Gaussians, or nothing is left to render. From step ``Schedule.mean_from`` on
        (``refine_stop`` or later) a changed number restarts the mean that becomes the result.
        """
