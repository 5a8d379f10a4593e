"""Everything that changes during a run, and its checkpoints.

Promise: a run resumed from a checkpoint takes, on the CPU, bit for bit the steps that it would have
taken: randomness depends only on the seed and the step, so no generator is stored. A checkpoint
appears whole or not at all, and loading one executes nothing in it.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from splatseed.errors import SceneFormatError
from splatseed.io.staging import atomic_file
from splatseed.train.device import Capacity
from splatseed.train.growing import NOWHERE, Growing
from splatseed.train.parameters import Optimizers, Parameters, as_parameters, make_optimizers
from splatseed.train.record import Record
from splatseed.train.schedule import Schedule
from splatseed.train.settings import TrainSettings
from splatseed.train.strategies import Default, Mcmc, Strategy

FORMAT = 4
"""Version of the checkpoint's content."""


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
    """A run at a step.

    Args:
        params: The Gaussians.
        optimizers: One per parameter.
        strategy: What changes their number.
        step: Steps done.
        records: The curve so far.
        watch: Time spent training.
        losses: Losses of the steps since the last record.
        mean: Mean of the Gaussians over the end of the run; see ``add_to_mean``.
    """

    params: Parameters
    optimizers: Optimizers
    strategy: Strategy
    step: int = 0
    records: list[Record] = field(default_factory=list)
    watch: Stopwatch = field(default_factory=Stopwatch)
    losses: list[Tensor] = field(default_factory=list)
    mean: dict[str, Any] = field(default_factory=dict)


def make_strategy(
    settings: TrainSettings,
    device: torch.device | None = None,
    depths: Mapping[str, Float[Tensor, "h w"]] = NOWHERE,
) -> Strategy:
    """The strategy named by the settings, on their schedule.

    Args:
        settings: How to train.
        device: The device whose memory limits the number of Gaussians; the CPU by default.
        depths: Known depths of the training views; see ``Growing``.
    """
    capacity = Capacity(settings.cap, device or torch.device("cpu"))
    match settings.densification:
        case "default":
            return Default(settings, capacity)
        case "mcmc":
            return Mcmc(settings, capacity)
        case "grow":
            return Growing(settings, capacity, depths)
        case "none":
            return Strategy()


def save_checkpoint(path: Path, state: TrainState) -> None:
    """Write the whole state of a run, replacing an older checkpoint.

    Raises:
        OutputError: The file cannot be written.
    """
    content = {
        "format": FORMAT,
        "step": state.step,
        "seconds": state.watch.seconds,
        "records": [tuple(record) for record in state.records],
        "losses": state.losses,
        "params": {name: value.detach() for name, value in state.params.items()},
        "optimizers": {name: each.state_dict() for name, each in state.optimizers.items()},
        "strategy": state.strategy.state,
        "held_at": state.strategy.capacity and state.strategy.capacity.held_at,
        "mean": state.mean,
    }
    with atomic_file(path) as partial:
        torch.save(content, partial)


def load_checkpoint(
    path: Path, strategy: Strategy, schedule: Schedule, device: torch.device
) -> TrainState:
    """The state that ``save_checkpoint`` wrote, on a device.

    Args:
        path: The checkpoint.
        strategy: A new one from the run's settings; its state is replaced.
        schedule: The run's schedule.
        device: Where to resume.

    Raises:
        SceneFormatError: The file is no checkpoint of this version.
    """
    found = "another kind or version of file"
    try:
        with warnings.catch_warnings(action="ignore"):  # about what a foreign file might be
            content = torch.load(path, map_location=device, weights_only=True)
        if isinstance(content, dict) and content.get("format") == FORMAT:
            return _state_of(content, strategy, schedule)
    except Exception as error:  # noqa: BLE001  (PyTorch raises anything for a damaged file)
        found = f"a damaged file ({type(error).__name__})"
    raise SceneFormatError(
        f"{path} to be a checkpoint of this version of splatseed",
        found=found,
        fix="Start the run again with --overwrite.",
    )


def _state_of(content: Mapping[str, Any], strategy: Strategy, schedule: Schedule) -> TrainState:
    params = as_parameters(content["params"])
    optimizers = make_optimizers(params, schedule)
    for name, optimizer in optimizers.items():
        optimizer.load_state_dict(content["optimizers"][name])
    strategy.state = content["strategy"]
    if strategy.capacity:
        strategy.capacity.held_at = content["held_at"]
    records = [Record(*row) for row in content["records"]]
    watch = Stopwatch(float(content["seconds"]))
    step, losses = int(content["step"]), list(content["losses"])
    return TrainState(params, optimizers, strategy, step, records, watch, losses, content["mean"])
