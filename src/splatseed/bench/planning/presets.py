"""Ready-made plans: the paper's two data sets, and two that a laptop can run.

Notation: a preset's scenes are folders of one folder, the data set. Promise: scenes, folders of
photographs, ratios and steps of the paper's presets are those of its tables 1 and 2
(docs/paper.md), and every eighth image is held out for testing; photographs are taken as the data
set provides them, not downsampled anew. ``laptop`` compares arms at one number of Gaussians.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

from splatseed.bench.planning.plan import DEMO, Plan, PlannedScene
from splatseed.bench.planning.records import SFM
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.train.settings import TrainSettings

PresetName = Literal["mipnerf360", "replica", "laptop", "quick"]
PRESETS: tuple[PresetName, ...] = ("mipnerf360", "replica", "laptop", "quick")

OUTDOOR = ("bicycle", "flowers", "garden", "stump", "treehill")
INDOOR = ("bonsai", "counter", "kitchen", "room")
LAPTOP = ("fern", "fox", "bonsai", "treehill")
REPLICA = ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2")
PAPER_METHODS = (SFM, "linear", "triangle", "spline", "mls", "voronoi")


def preset_plan(name: PresetName, data: Path | None) -> tuple[Plan, tuple[str, ...]]:
    """A preset's plan for the scenes that exist.

    Args:
        name: The preset.
        data: The folder of the data set's scenes; not for ``quick``, which has the synthetic room.

    Returns:
        The plan, and the names of missing scenes.

    Raises:
        ParameterError: The folder is not given, or given for ``quick``.
        SceneNotFoundError: None of the scenes is in it.
    """
    if name == "quick":
        if data is not None:
            raise ParameterError(
                "--scenes for the preset quick", found="--data", fix="Name scenes, or none."
            )
        return _quick(), ()
    if data is None:
        raise ParameterError(
            f"--data DIR, the folder of the scenes of {name}", found="none", fix="Name it."
        )
    makers = {"mipnerf360": _mipnerf360, "replica": _replica, "laptop": _laptop}
    wanted = makers[name](data)
    there = tuple(scene for scene in wanted.scenes if Path(scene.path).is_dir())
    missing = tuple(scene.label for scene in wanted.scenes if scene not in there)
    if not there:
        raise SceneNotFoundError(
            f"scenes of {name} in {data}: {', '.join(missing)}",
            found="none of them",
            fix="Name the folder that holds them.",
        )
    return replace(wanted, scenes=there), missing


def _mipnerf360(data: Path) -> Plan:
    folders = {**dict.fromkeys(OUTDOOR, "images_4"), **dict.fromkeys(INDOOR, "images_2")}
    scenes = tuple(
        PlannedScene(str(data / name), name, images=folders[name]) for name in sorted(folders)
    )
    return Plan(scenes=scenes, methods=PAPER_METHODS, ratios=(4, 8, 16))


def _replica(data: Path) -> Plan:
    scenes = tuple(PlannedScene(str(data / name), name) for name in REPLICA)
    return Plan(scenes=scenes, methods=(*PAPER_METHODS, "depth"), ratios=(16, 32))


def _laptop(data: Path) -> Plan:
    return Plan(
        scenes=tuple(PlannedScene(str(data / name), name) for name in LAPTOP),
        methods=(SFM, "mls", "auto"),
        ratios=(),
        budgets=("0.25rho",),
        strategies=("default", "grow"),
        repeats=2,
        training=TrainSettings(max_steps=1500),
        long_side=400,
    )


def _quick() -> Plan:
    return Plan(
        scenes=(PlannedScene(DEMO),),
        methods=(SFM, "linear", "mls"),
        ratios=(8,),
        strategies=("none", "default"),
        repeats=2,
        training=TrainSettings(max_steps=500, data_factor=2),
    )
