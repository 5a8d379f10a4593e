"""What every strategy can do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatseed.train.device import Capacity
from splatseed.train.parameters import Optimizers, Parameters
from splatseed.views.view import View

__all__ = ["Strategy"]


class Strategy(ABC):
    """What changes the number of Gaussians.

    Attributes:
        state: What it remembers from step to step: all that a checkpoint must hold of it.
        capacity: How many Gaussians it may make; None if it makes none.
    """

    def __init__(self, capacity: Capacity | None = None) -> None:
        self.state: dict[str, Any] = {}
        self.capacity = capacity

    def regularization(self, params: Parameters) -> Float[Tensor, ""] | None:  # noqa: ARG002  (the interface's name)
        """What is added to the loss; nothing by default."""
        return None

    def before(  # noqa: B027  (most have nothing to do there)
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any
    ) -> None:
        """To be called ahead of the backward pass; nothing by default."""

    def observe(  # noqa: B027  (likewise)
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        truth: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """To be called behind the optimisers, with what the step has shown; nothing by default."""

    @abstractmethod
    def after(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """To be called behind ``observe``; may replace parameters and their moments."""
