"""What to do with a scene before training, as ``info`` says it.

Promise: nothing is written, and no photograph is opened.
"""

from __future__ import annotations

from pathlib import Path

from splatseed.commands.planned import Planned
from splatseed.lens import undistort_command, undistorted
from splatseed.literal import quoted
from splatseed.scene import Scene
from splatseed.seeding.advice import (
    AS_IT_IS,
    SEEDED,
    Advice,
)
from splatseed.seeding.diagnostics import is_distorted, untrainable


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
    training = f"--budget {planned.budget} --max-steps {planned.max_steps} -o RUN"
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
