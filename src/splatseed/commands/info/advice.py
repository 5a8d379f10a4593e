"""What to do with a scene before training, as ``info`` and ``upsample`` say it.

Promise: nothing is written; without ``looked_at`` no photograph is opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseed.commands.options import parse_options
from splatseed.commands.planned import Planned
from splatseed.console import OUT, print_commands, print_note, print_pairs, stage_display
from splatseed.io import load_scene
from splatseed.lens import undistort_command, undistorted
from splatseed.literal import quoted
from splatseed.scene import Scene
from splatseed.seeding.advice import (
    AS_IT_IS,
    SEEDED,
    Advice,
    advice_for,
)
from splatseed.seeding.diagnostics import empty_regions, is_distorted, untrainable
from splatseed.train.schedule import FULL_RUN

Budget = Annotated[
    str | None,
    tyro.conf.arg(
        constructor=str,
        metavar="N|Xrho",
        help_behavior_hint="(default: 1rho, as splatseed train's)",
    ),
]


def advice_rows(advice: Advice, planned: Planned) -> list[tuple[str, str]]:
    """The advice as a table's rows: what, why, and for which training."""
    layout = [("cameras stand", stand)] if (stand := advice.measured.layout) else []
    why = [("why" if i == 0 else "", reason) for i, reason in enumerate(advice.reasons)]
    plan = (
        f"{planned.budget:,} Gaussians at most, {planned.max_steps:,} steps, strategy "
        f"{planned.strategy}"
    )
    return [*layout, ("planned", plan), ("advice", advice.sentence), *why]


def advice_commands(
    path: Path, scene: Scene, advice: Advice, planned: Planned, *, refine: bool = False
) -> list[tuple[str, str]]:
    """The commands that follow the advice, each of which works on this scene.

    Args:
        path: Where the scene lies.
        scene: The scene.
        advice: The advice.
        planned: How it will be trained.
        refine: Whether its poses should be refined.
    """
    trains, first = not untrainable(scene), []
    if trains and is_distorted(scene):
        first, path = [("undistort", undistort_command(path))], undistorted(path)
    source = quoted(path)
    training = f"--cap-max {planned.budget} --max-steps {planned.max_steps} -o RUN"
    if advice.method == SEEDED:
        train = f"splatseed train {source} {planned.flags}-o RUN"
    elif advice.method == AS_IT_IS:
        train = f"splatseed train {source} --seeds scene {training}"
    else:
        how = f"--method {advice.method} --ratio 4"
        how = f"--budget {planned.most_seeds}" if advice.method == "auto" else how
        how = f"{how} --refine-poses" if refine else how
        first.append(("seeds", f"splatseed upsample {source} {how} -o OUT"))
        train = f"splatseed train OUT {training}"
    if not trains:
        return first or [("look", f"splatseed view {source}")]
    tune = ("or ask by experiment", f"splatseed tune {source} --minutes 30{planned.tuning}")
    tunes = advice.method in (AS_IT_IS, "auto") and len(scene.points)
    return [*first, ("train", train), *([tune] if tunes else [])]


@dataclass(frozen=True)
class _Options:
    """Say what to do with a scene's points before training, and why; write nothing.

    With --output or --method, points are added: see splatseed upsample --help.
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """The scene."""
    budget: Budget = None
    """Most Gaussians at the end of training: a number, or per pixel of a photograph."""
    max_steps: int = FULL_RUN
    """Steps that you plan to train."""


ADVICE_OPTIONS = ("--budget", "--max-steps")


def run_advice(arguments: list[str]) -> None:
    """``splatseed upsample SCENE`` without a method and without an output.

    Args:
        arguments: The words after the verb.
    """
    options = parse_options(_Options, "upsample", arguments)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        planned = Planned.of(scene, options.budget, options.max_steps)
        regions = empty_regions(scene, clock)
        empty = None if regions is None else regions.mean
        advice = advice_for(
            scene, planned.most_seeds, strategy=planned.strategy, empty=empty, progress=clock
        )
    print_pairs(str(options.scene), advice_rows(advice, planned))
    commands = advice_commands(options.scene, scene, advice, planned)
    tunes = any("splatseed tune" in command for _, command in commands)
    tests = "; splatseed tune tests this very scene" if tunes else ""
    OUT.print(f"\nThe rules rest on runs of a few scenes (docs/methods.md){tests}.", soft_wrap=True)
    if missing := untrainable(scene):
        print_note(missing)
    print_commands("next", commands)
