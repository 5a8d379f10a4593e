"""Evaluation: how close renders come to photographs that were not used for training.

``evaluate_views`` scores any function from a view to an image; ``load_model`` and
``evaluate_model`` a trained .ply in the world of its scene, whoever trained it. Needs PyTorch
(``pip install ".[train]"``).
"""

from splatseed.requirements import require

require("torch")  # first, for one clear error if it is absent

from splatseed.evaluate.lpips import LPIPS_NETS, Lpips, LpipsNet, load_lpips  # noqa: E402  (after the check that PyTorch is there)
from splatseed.evaluate.metrics import Covisible, Render, evaluate_views  # noqa: E402  (after the check that PyTorch is there)
from splatseed.evaluate.model import (  # noqa: E402  (after the check that PyTorch is there)
    TrainedModel,
    evaluate_model,
    load_model,
    write_renders,
)
from splatseed.scores import EvalResult, TrainingResult, ViewScore  # noqa: E402  (after the check that PyTorch is there)

__all__ = [
    "LPIPS_NETS",
    "Covisible",
    "EvalResult",
    "Lpips",
    "LpipsNet",
    "Render",
    "TrainedModel",
    "TrainingResult",
    "ViewScore",
    "evaluate_model",
    "evaluate_views",
    "load_lpips",
    "load_model",
    "write_renders",
]
