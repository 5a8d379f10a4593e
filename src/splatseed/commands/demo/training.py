"""The demo's training: the same few steps from seeds with and without the scene's points.

Promise: runs differ only in their seeds, and have the same number of Gaussians at most; the time to
make seeds is counted; the view that is shown is chosen before any is rendered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from splatseed.commands.demo.methods import SHOWN, upsample_by
from splatseed.console import StageClock
from splatseed.evaluate import evaluate_views
from splatseed.io import load_scene, write_scene
from splatseed.pointcloud import PointCloud
from splatseed.scores import TrainingResult
from splatseed.seeding.poses import random_start
from splatseed.splat.pictures import FULL_ERROR, error_map
from splatseed.train.run import RunOptions, prepare_run
from splatseed.train.settings import TrainSettings
from splatseed.view.page import Tile, write_grid

POSES_ALONE = {"random start": "random", f"{SHOWN}, poses alone": f"poses_{SHOWN}"}
"""Arms that know no points, and how their folders end."""


@dataclass(frozen=True)
class Arm:
    """One of the runs.

    Args:
        label: Names its seeds.
        scene: The folder of the scene with the seeds.
        output: The folder of the run.
        seconds: Time it took to make the seeds.
    """

    label: str
    scene: Path
    output: Path
    seconds: float = 0.0


@dataclass(frozen=True, eq=False)
class TrainedArm:
    """A finished run.

    Args:
        arm: The arm.
        result: The content of its metrics.json.
        photograph: The photograph of the view that is shown.
        render: The render of that view, 0 to 1.
    """

    arm: Arm
    result: TrainingResult
    photograph: UInt8[np.ndarray, "H W 3"]
    render: Float32[np.ndarray, "H W 3"]


def seed_poses_alone(folder: Path, seed: int, clock: StageClock) -> list[Arm]:
    """Scenes in the demo's folder whose seeds come from poses and photographs, not from points."""
    scene = load_scene(folder / "scene").replace(points=PointCloud.empty(), tracks=None)
    arms: list[Arm] = []
    for label, name in POSES_ALONE.items():
        before = sum(clock.seconds().values())
        clock("seed poses alone", len(arms) / len(POSES_ALONE))
        if name == "random":
            points = random_start(scene, np.random.default_rng(seed))
        else:
            points = upsample_by(SHOWN, scene, 1.0, seed)
        seconds = sum(clock.seconds().values()) - before
        path = folder / f"scene_{name}"
        write_scene(scene.replace(points=points), path, provenance={"method": label})
        arms.append(Arm(label, path, folder / f"run_{name}", seconds))
    return arms


def train_arm(arm: Arm, settings: TrainSettings, clock: StageClock) -> TrainedArm:
    """Train from an arm's seeds, and score.

    Raises:
        KeyboardInterrupt: The user interrupted; a checkpoint was saved for resuming.
        SplatseedError: As ``prepare_run``.
    """
    stage = f"train {arm.label}"
    run = prepare_run(
        load_scene(arm.scene), arm.output, settings, RunOptions(overwrite=True), progress=clock
    )
    clock(stage, 0.0)
    if not run.train(lambda step: clock(stage, step / settings.max_steps)):
        raise KeyboardInterrupt
    result = run.finish(evaluate_views, clock)
    shown = run.trainer.test_views[len(run.trainer.test_views) // 2]
    render = np.asarray(run.trainer.render(shown).cpu().numpy(), np.float32)
    return TrainedArm(arm, result, shown.photograph, render)


def total_seconds(each: TrainedArm) -> float:
    """Seconds of making the seeds and training from them."""
    return each.arm.seconds + each.result.train_seconds


def psnr_after(seconds: float, each: TrainedArm) -> float | None:
    """The last test PSNR, in dB, of an arm within ``seconds`` in all; None before its first.

    The curve's end is of the mean that a run ends with, which an arm still in training has not yet.
    """
    during = each.result.curve[:-1]
    known = [test.psnr for test in during if each.arm.seconds + test.seconds <= seconds]
    return known[-1] if known else None


def write_comparison(arms: Sequence[TrainedArm], path: Path) -> None:
    """Write the photograph and each arm's render, with its error map below.

    Raises:
        OutputError: The file cannot be written.
    """
    photograph = arms[0].photograph
    blank = np.full_like(photograph, 255)
    renders = [
        Tile(
            f"{each.arm.label}: {each.result.scores.psnr:.2f} dB over all test views",
            _bytes(each.render),
        )
        for each in arms
    ]
    errors = [
        Tile(f"error: black 0, bright {FULL_ERROR:g} or more", error_map(photograph, each.render))
        for each in arms
    ]
    tiles = [Tile("photograph, not trained on", photograph), *renders, Tile("", blank), *errors]
    write_grid(tiles, path, columns=1 + len(arms))


def _bytes(render: Float32[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W 3"]:
    return np.asarray(np.round(np.clip(render, 0.0, 1.0) * 255), np.uint8)
