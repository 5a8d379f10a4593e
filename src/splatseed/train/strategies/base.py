"""The interface of all strategies."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from jaxtyping import Float
from torch import Tensor

from splatseed.train.device import Capacity
from splatseed.train.parameters import Optimizers, Parameters
from splatseed.views.view import View


class Strategy(ABC):
    """Changes the number of Gaussians.

    Attributes:
        state: What it remembers from step to step, for checkpoints.
        capacity: How many Gaussians it may make; None if it makes none.
    """

    def __init__(self, capacity: Capacity | None = None) -> None:
        self.state: dict[str, Any] = {}
        self.capacity = capacity

    def regularization(self, params: Parameters) -> Float[Tensor, ""] | None:  # noqa: ARG002  (the interface's name)
        """A term to add to the loss; none by default."""
        return None

    def before(  # noqa: B027  (most need nothing)
        self, params: Parameters, optimizers: Optimizers, step: int, info: Any
    ) -> None:
        """Called before the backward pass; does nothing by default."""

    def observe(  # noqa: B027  (likewise)
        self,
        params: Parameters,
        view: View,
        render: Float[Tensor, "H W 3"],
        photograph: Float[Tensor, "H W 3"],
        step: int,
    ) -> None:
        """Called after the optimisers, with the result of the step; does nothing by default."""

    @abstractmethod
    def after(self, params: Parameters, optimizers: Optimizers, step: int, info: Any) -> None:
        """Called after ``observe``; may replace parameters and their moments."""
