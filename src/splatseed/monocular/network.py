"""The interface of depth networks, whatever runs them.

Notation: a *prediction* is float32 [H, W], one value for each pixel of a photograph. Promise: the
meaning of its values is stated with the evidence for it; if there is none, the user is asked.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError

DeviceName = Literal["auto", "cpu", "cuda"]

_METRIC = {
    "depth_pro": "Depth Pro",
    "glpn": "GLPN",
    "tipsv2_dpt": "TIPSv2",
    "zoedepth": "ZoeDepth",
}
"""Model types that always predict metres, and their common names."""


@dataclass(frozen=True)
class Meaning:
    """What a network's values are.

    Args:
        kind: As in ``DepthMap``.
        reason: The evidence, in a few words.
    """

    kind: DepthKind
    reason: str


class DepthNetwork(Protocol):
    """A network with its weights, ready to run."""

    @property
    def meaning(self) -> Meaning:
        """What it predicts."""
        ...

    @property
    def device(self) -> str:
        """Where it runs, in words."""
        ...

    def __call__(
        self, images: Sequence[UInt8[np.ndarray, "H W 3"]]
    ) -> list[Float32[np.ndarray, "H W"]]:
        """Predict for photographs of one size (sRGB), at their size.

        Raises:
            SplatseedError: The network cannot run on them.
        """
        ...


def meaning_of(config: Mapping[str, Any], name: str, given: DepthKind | None) -> Meaning:
    """What a network predicts, by its ``config.json`` as transformers writes it.

    Args:
        config: The file's content; empty if there is none.
        name: The network's name, for the error.
        given: What the user says, which takes precedence.

    Raises:
        ParameterError: Neither the user nor the file says.
    """
    if given is not None:
        return Meaning(given, "as --depth-kind says")
    model_type = config.get("model_type")
    if model_type in _METRIC:
        return Meaning("z", f"{_METRIC[model_type]} predicts metres")
    if model_type == "depth_anything":
        return _depth_anything(config)
    if model_type == "dpt":
        return _dpt(config)
    raise ParameterError(
        f"--depth-kind, to say what {name} predicts",
        found=f"a network of type {model_type!r}, which does not say"
        if config
        else "no config.json",
        fix="Pass --depth-kind inverse for networks that predict disparity (MiDaS, Depth Anything"
        " without 'Metric'), --depth-kind z for those that predict metres.",
    )


def _depth_anything(config: Mapping[str, Any]) -> Meaning:
    if config.get("depth_estimation_type", "relative") == "metric":
        return Meaning("z", "its config says depth_estimation_type metric")
    return Meaning("inverse", "Depth Anything is relative unless its config says metric")


def _dpt(config: Mapping[str, Any]) -> Meaning:
    """DPT was published by MiDaS, for inverse depth, and with DINOv2, for metres."""
    backbone = config.get("backbone_config") or {}
    if backbone.get("model_type") == "dinov2":
        return Meaning("z", "DPT on DINOv2 predicts metres")
    return Meaning("inverse", "DPT of MiDaS predicts inverse depth")


def one_line(error: Exception) -> str:
    """The first line of another library's error."""
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0].rstrip('.')}" if lines else type(error).__name__
