"""Scores: how well test views were rendered, and the types in which all rooms hand results on."""

from splatseed.scores.results import (
    NOT_ASKED,
    CurvePoint,
    EvalResult,
    TrainingResult,
    ViewScore,
)

__all__ = ["NOT_ASKED", "CurvePoint", "EvalResult", "TrainingResult", "ViewScore"]
