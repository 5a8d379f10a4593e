"""Everything that changes during a run, and its checkpoints.

Promise: on the CPU a resumed run repeats, bit for bit, the steps of an uninterrupted one:
randomness depends only on the seed and the step, so no generator is stored. Checkpoints are written
atomically, and loading one executes nothing in it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from splatseed.errors import SceneFormatError
from splatseed.io.staging import atomic_file
from splatseed.splat.gaussians import Gaussians
from splatseed.training.device import Capacity
from splatseed.training.exposure import Exposures
from splatseed.training.folder import Record
from splatseed.training.parameters import (
    Optimizers,
    Parameters,
    as_parameters,
    make_optimizers,
    make_parameters,
)
from splatseed.training.schedule import Schedule
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.base import Strategy


class Stopwatch:
    """Seconds spent training; paused during everything else."""

    def __init__(self, seconds: float = 0.0) -> None:
        self.seconds = seconds
        self._since: float | None = None

    def start(self) -> None:
        """Start or resume."""
        self._since = time.perf_counter()

    def stop(self) -> None:
        """Pause."""
        if self._since is not None:
            self.seconds += time.perf_counter() - self._since
            self._since = None


@dataclass
class TrainState:
    """A run after ``step`` steps."""

    params: Parameters
    optimizers: Optimizers
    strategy: Strategy
    step: int = 0
    records: list[Record] = field(default_factory=list)
    """The curve so far."""
    watch: Stopwatch = field(default_factory=Stopwatch)
    losses: list[Tensor] = field(default_factory=list)
    """Of the steps since the last record."""
    mean: dict[str, Any] = field(default_factory=dict)
    """Of the Gaussians over the end of the run; see ``add_to_mean``."""
    exposures: Exposures | None = None
    """Of the training photographs, if they are learnt."""


def make_strategy(
    settings: TrainSettings,
    device: torch.device | None = None,
    depths: Mapping[str, Float32[np.ndarray, "h w"]] = MappingProxyType({}),
    share: float = 1.0,
) -> Strategy:
    """Make the strategy of the settings.

    The memory of ``device``, by default the CPU, limits growth; see ``Strategy.of`` for ``depths``
    and ``share``.
    """
    device = device or torch.device("cpu")
    maps = {name: torch.as_tensor(each).to(device) for name, each in depths.items()}
    file, _, name = settings.traits.implementation.partition(":")
    kind: type[Strategy] = getattr(import_module(f"splatseed.training.strategies.{file}"), name)
    return kind.of(settings, Capacity(settings.cap, device), maps, share)


def first_state(
    first: tuple[Gaussians, Float32[np.ndarray, " N"]],
    num_views: int,
    settings: TrainSettings,
    strategy: Strategy,
    device: torch.device,
) -> TrainState:
    """Return the state before the first step of a run with ``num_views`` training views.

    ``first`` are Gaussians in the training frame and their min view depths.
    """
    gaussians, depths = first
    schedule = settings.schedule
    params = make_parameters(gaussians, device, depths if schedule.depth_units else None)
    state = TrainState(params, make_optimizers(params, schedule), strategy)
    if settings.exposure == "affine":
        state.exposures = Exposures.identity(num_views, device)
    return state


def save_checkpoint(path: Path, state: TrainState) -> None:
    """Write the state of a run, replacing an older checkpoint."""
    content = {
        "step": state.step,
        "seconds": state.watch.seconds,
        "records": [tuple(record) for record in state.records],
        "losses": state.losses,
        "params": {name: value.detach() for name, value in state.params.items()},
        "optimizers": {name: each.state_dict() for name, each in state.optimizers.items()},
        "strategy": state.strategy.state,
        "held_at": state.strategy.capacity.held_at,
        "mean": state.mean,
    }
    if state.exposures is not None:
        content["exposures"] = state.exposures.transforms
    with atomic_file(path) as partial, partial.open("wb") as file:
        try:
            torch.save(content, file)
        except RuntimeError as error:  # PyTorch's own, that its file is cut off, hides the disk's
            disk = error.__context__
            raise (disk if isinstance(disk, OSError) else error) from None


def load_checkpoint(
    path: Path, strategy: Strategy, schedule: Schedule, device: torch.device
) -> TrainState:
    """Read the state that ``save_checkpoint`` wrote to a device, and the strategy's own.

    Raises:
        SceneFormatError: The file is damaged.
        torch.cuda.OutOfMemoryError: It does not fit on the GPU.
    """
    try:
        with warnings.catch_warnings(action="ignore"):  # about what a foreign file might be
            content = torch.load(path, map_location=device, weights_only=True)
        params = as_parameters(content["params"])
        optimizers = make_optimizers(params, schedule)
        for name, optimizer in optimizers.items():
            optimizer.load_state_dict(content["optimizers"][name])
        strategy.state = content["strategy"]
        strategy.capacity.held_at = content["held_at"]
        records = [Record(*row) for row in content["records"]]
        watch, losses = Stopwatch(float(content["seconds"])), list(content["losses"])
        run, step = (params, optimizers, strategy), int(content["step"])
        exposures = Exposures(content["exposures"]) if "exposures" in content else None
        return TrainState(*run, step, records, watch, losses, content["mean"], exposures)
    except torch.cuda.OutOfMemoryError:
        raise
    except Exception as error:  # noqa: BLE001  (PyTorch raises anything for a damaged file)
        raise SceneFormatError(
            f"{path} to be a checkpoint of splatseed",
            found=f"a damaged file ({type(error).__name__})",
            fix="Start again with `overwrite=True`.",
        ) from None
