"""Training: from a scene and its seeds to Gaussians that look like the photographs.

``prepare_run`` reads what a run needs and opens its folder; the ``TrainingRun`` it returns trains
and writes the results. Settings and requests can be used without PyTorch: the rest is imported when
first accessed (``pip install ".[train]"``).
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from splatseed.requirements import require
from splatseed.training.request import PrepareOptions, TrainRequest
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:
    from splatseed.training.prepare import prepare_run
    from splatseed.training.run import TrainingRun

__all__ = ["PrepareOptions", "TrainRequest", "TrainSettings", "TrainingRun", "prepare_run"]


def __getattr__(name: str) -> Any:
    """The parts that need PyTorch and gsplat.

    Raises:
        MissingDependencyError: One of them, or flip-evaluator, is absent.
    """
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    require("torch", "gsplat", "flip_evaluator")
    return getattr(import_module("splatseed.training.prepare"), name)
