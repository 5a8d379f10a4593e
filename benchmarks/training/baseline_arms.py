"""The arms of ``baseline.py``: strategies, and what a schedule is with one choice undone.

Promise: an arm is the trainer's own run but for the numbers that stand here; the views that it is
scored on are held out of the training views, after the test views were taken out.
"""

from __future__ import annotations

import dataclasses
import hashlib
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from splatseed import load_scene
from splatseed.splat.evaluate import evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.schedule import LEARNING_RATES, Schedule

__all__ = ["ARMS", "CAPS", "Arm", "fingerprint", "train"]

CAPS: Mapping[str, int] = {"fern": 40_000, "treehill": 80_000, "fox": 38_000, "bonsai": 150_000}
"""Most Gaussians: 0.33, 1.2, 0.42 and 1.4 of the pixels of a photograph at half size."""
TEST_EVERY = 8

Change = Callable[[Schedule], Schedule]


def _as_it_is(schedule: Schedule) -> Schedule:
    return schedule


@dataclass(frozen=True)
class Arm:
    """A strategy, and what is changed in its schedule and settings."""

    strategy: str
    change: Change = _as_it_is
    opacity_reset: bool = False


def _set(**values: Any) -> Change:
    return lambda schedule: dataclasses.replace(schedule, **values)


def _times(**factors: float) -> Change:
    """Learning rates as multiples of 3DGS's."""

    def change(schedule: Schedule) -> Schedule:
        rates = {name: LEARNING_RATES[name] * factor for name, factor in factors.items()}
        return dataclasses.replace(schedule, learning_rates={**schedule.learning_rates, **rates})

    return change


def _falling(to: float) -> Change:
    """All learning rates fall, not positions' alone."""

    def change(schedule: Schedule) -> Schedule:
        decays = {**dict.fromkeys(LEARNING_RATES, to), **schedule.decays}
        return dataclasses.replace(schedule, decays=decays)

    return change


def _parts(first: float, last: float) -> Change:
    """Densification from one part of the run to another."""

    def change(schedule: Schedule) -> Schedule:
        steps = schedule.max_steps
        return dataclasses.replace(
            schedule, refine_start=int(first * steps), refine_stop=int(last * steps)
        )

    return change


def _late_harmonics(schedule: Schedule) -> Schedule:
    """One degree more each fifth of the run, not each thirtieth."""
    return dataclasses.replace(schedule, sh_every=schedule.max_steps // 5)


def _before(prune_size: float = 0.1) -> Change:
    """As splatseed's ``default`` was: in 3DGS's conventions, but for rounds of 100 steps."""

    def change(schedule: Schedule) -> Schedule:
        every = max(schedule.refine_every, min(100, schedule.refine_stop // 6))
        return dataclasses.replace(schedule, refine_every=every, prune_size=prune_size)

    return change


OTHERS = {"scales": 1.0, "quats": 1.0, "sh0": 1.0, "shN": 1.0}
UNBOUNDED = float("inf")
ARMS: Mapping[str, Arm] = {
    "default-3dgs": Arm("default-3dgs"),
    "default as it was": Arm("default-3dgs", _before()),
    "the same, nothing pruned by size": Arm("default-3dgs", _before(UNBOUNDED)),
    "default": Arm("default"),
    "- near depths": Arm("default", _set(depth_units=False)),
    "+ pruning by size": Arm("default", _set(prune_size=0.1)),
    "- faster harmonics": Arm("default", _times(shN=4.0)),
    "- faster positions": Arm("default", _times(means=1.0)),
    "- faster scales, rotations, colours": Arm("default", _times(**OTHERS)),
    "- faster forgetting of gradients": Arm("default", _set(beta2=0.999)),
    "+ faster opacities": Arm("default", _times(opacities=4.0)),
    "+ all rates fall to 0.3": Arm("default", _falling(0.3)),
    "- bound on first sizes": Arm("default", _set(max_size=UNBOUNDED)),
    "densified from 1/6 to 3/5 of the run": Arm("default", _parts(1 / 6, 3 / 5)),
    "densified up to 3/4 of the run": Arm("default", _parts(1 / 60, 3 / 4)),
    "harmonics each fifth of the run": Arm("default", _late_harmonics),
    "opacities reset each tenth of the run": Arm("default", opacity_reset=True),
    "mcmc-3dgs": Arm("mcmc-3dgs"),
    "mcmc": Arm("mcmc"),
    "mcmc begun at a tenth of the size": Arm("mcmc", _set(scale_factor=0.1)),
    "mcmc begun at opacity 0.1": Arm("mcmc", _set(opacity=0.1)),
    "mcmc without noise": Arm("mcmc", _set(noise=0.0)),
    "mcmc with a tenth of the penalties": Arm("mcmc", _set(penalty=0.001)),
    "mcmc that grows by 1.05": Arm("mcmc", _set(growth=1.05)),
    "grow": Arm("grow"),
    "grow - faster forgetting of gradients": Arm("grow", _set(beta2=0.999)),
    "none-3dgs": Arm("none-3dgs"),
    "none": Arm("none"),
}
"""By what the table calls them; - and + are ``default`` with a choice undone or added."""


def fingerprint(scene: str, arm: str, max_steps: int) -> str:
    """Of the numbers that an arm's run is made of: what was measured with others is another run."""
    chosen = ARMS[arm]
    schedule = chosen.change(TrainSettings(strategy=chosen.strategy, max_steps=max_steps).schedule)
    return hashlib.blake2b(f"{CAPS[scene]} {schedule}".encode(), digest_size=8).hexdigest()


def train(
    scene: str, arm: str, max_steps: int, data_factor: int, seed: int, cap_max: int
) -> dict[str, float]:
    """One run of an arm on a capture's folder; scores, number of Gaussians, seconds of training."""
    chosen = ARMS[arm]

    class Altered(TrainSettings):
        @property
        def schedule(self) -> Schedule:
            return chosen.change(super().schedule)

    settings = Altered(
        strategy=chosen.strategy, max_steps=max_steps, data_factor=data_factor, seed=seed,
        cap_max=cap_max, test_every=TEST_EVERY, backend="cpu", opacity_reset=chosen.opacity_reset,
    )  # fmt: skip
    whole = load_scene(Path(scene))
    validation = whole.replace(images=whole.split(TEST_EVERY)[0])
    with tempfile.TemporaryDirectory() as folder:
        run = prepare_run(validation, Path(folder) / "run", settings)
        run.train()
    scores = evaluate_views(run.trainer.render, run.trainer.test_views)
    return {
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "gaussians": len(run.state.params["means"]),
        "seconds": run.state.watch.seconds,
    }
