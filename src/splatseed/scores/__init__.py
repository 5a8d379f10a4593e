"""Scores: how well test views were rendered; the types of results wherever there are any."""

from splatseed.scores.results import (
    NOT_ASKED,
    CurvePoint,
    EvalResult,
    TrainingResult,
    ViewScore,
)

__all__ = ["NOT_ASKED", "CurvePoint", "EvalResult", "TrainingResult", "ViewScore"]
