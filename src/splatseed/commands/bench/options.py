"""The options of ``splatseed bench``, and the plan that they make.

Notation: an option that is not given leaves the plan unchanged: that of a preset, of a file, of the
folder to resume, or the default one.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro

from splatseed.bench.planning.plan import DEMO, Plan, PlannedScene
from splatseed.bench.planning.plan_file import read_plan
from splatseed.bench.planning.presets import PRESETS, PresetName, preset_plan
from splatseed.bench.running.folder import PLAN
from splatseed.commands.options import check_least, parse_options
from splatseed.errors import ParameterError
from splatseed.train.settings import StrategyName, TrainSettings
from splatseed.upsample import Profile

"""The name of the plan in the folder of a benchmark."""
DEFAULT = Plan()


def _hint(default: str) -> Any:
    """An option that is empty or None when not given, with its default in words."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {default})")


def _one(kind: type, default: str) -> Any:
    """A number, text or path that is None when it is not given."""
    return tyro.conf.arg(
        constructor=kind,
        metavar=kind.__name__.upper(),
        help_behavior_hint=f"(default: {default})",
    )


def _listed(values: Sequence[object]) -> str:
    return " ".join(f"{x:g}" if isinstance(x, float) else f"{x}" for x in values)


@dataclass(frozen=True)
class PlanTraining(TrainSettings):
    """What all runs of a plan share; --strategies and --repeats determine the rest."""

    strategy: tyro.conf.Suppress[StrategyName] = "default"
    seed: tyro.conf.Suppress[int] = 0
    cap_max: int | None = None
    """Most Gaussians, by default 1000000 for grow and mcmc; if there are more seeds, they are
    thinned."""

    @classmethod
    def of(cls, settings: TrainSettings) -> Self:
        """The same settings as options."""
        return cls(**vars(settings))

    @property
    def settings(self) -> TrainSettings:
        """The settings as a plan has them."""
        return TrainSettings(**vars(self))


@dataclass(frozen=True)
class Options:
    """Train from every method's seeds, several times each, on one machine or many, and compare.

    Stop it at any time: the same command, or ``splatseed bench -o BENCH`` alone, resumes. Then see
    ``splatseed bench report BENCH``, and ``splatseed bench compare A B`` for two benchmarks.
    """

    output: Annotated[
        Path | None,
        tyro.conf.arg(aliases=["-o"], constructor=Path, metavar="DIR", help_behavior_hint=""),
    ] = None
    """The folder of the benchmark, new or to be resumed."""
    scenes: Annotated[tuple[str, ...], _hint("the plan's")] = ()
    """Scenes with photographs; demo: is a synthetic room."""
    methods: Annotated[tuple[str, ...], _hint(_listed(DEFAULT.methods))] = ()
    """Upsampling methods; sfm is the original cloud, with which the others are compared."""
    ratios: Annotated[tuple[float, ...], _hint(_listed(DEFAULT.ratios))] = ()
    """Points in all, per original."""
    budgets: Annotated[tuple[str, ...], _hint("none")] = ()
    """Most Gaussians at the end, the same for every arm: such as 50k, or 0.25rho, per pixel of a
    photograph at training size. Methods then fill the budget, unless --ratios are given too."""
    strategies: Annotated[tuple[StrategyName, ...], _hint(_listed(DEFAULT.strategies))] = ()
    """Densification strategies; -3dgs: in 3DGS's own conventions of rates and schedules."""
    profiles: Annotated[tuple[Profile, ...], _hint(_listed(DEFAULT.profiles))] = ()
    """Parameter sets of the methods: improved ones, and those of the paper's text."""
    repeats: Annotated[int | None, _one(int, f"{DEFAULT.repeats}")] = None
    """Number of repeats, with another seed each time; error bars need at least 2."""
    training: Annotated[PlanTraining, tyro.conf.arg(name="")] = PlanTraining()
    """How each run is trained: its fields are options of their own."""
    long_side: Annotated[int | None, _one(int, "none")] = None
    """Downsample photographs by a whole factor, per scene, to at most this many pixels on their
    longer side; instead of --data-factor."""
    depth: Annotated[tuple[Path, ...], _hint("the scene's")] = ()
    """For method depth: a folder of maps per scene, or one folder with a subfolder of each one's
    name."""
    clouds: Annotated[tuple[Path, ...], _hint("the plan's")] = ()
    """For methods cloud and cloud+auto: the scan of each scene, in its frame (docs/scans.md)."""
    preset: Annotated[
        PresetName | None,
        tyro.conf.arg(metavar="|".join(PRESETS), help_behavior_hint="(default: none)"),
    ] = None
    """A ready-made plan: the paper's data sets, laptop (four real scenes in half an hour on one
    core), both with --data; or quick, on a synthetic room."""
    data: Annotated[Path | None, _one(Path, "none")] = None
    """The folder of a preset's scenes."""
    plan: Annotated[Path | None, _one(Path, "none")] = None
    """A plan as printed by --dry-run; other options change it."""
    dry_run: bool = False
    """Print the plan, the number of runs, and an estimate of hours and disk; run nothing."""
    executor: Literal["local", "ray"] = "local"
    """Processes on this machine, or tasks on a Ray cluster (extra cluster)."""
    jobs: Annotated[int | None, _one(int, "one per GPU, else 1; ray: what fits")] = None
    """Runs at a time."""
    threads: Annotated[int | None, _one(int, "an equal share of the cores")] = None
    """Threads of each run on the CPU."""
    address: Annotated[str | None, _one(str, "a cluster on this machine alone")] = None
    """The Ray cluster's, such as auto on its head node."""
    retry_failed: bool = False
    """Retry failed runs."""
    keep_models: bool = False
    """Keep trained models: some 236 bytes per Gaussian."""
    lpips: bool = False
    """Refuse to run without LPIPS, which is otherwise measured if its weights are available (see
    splatseed evaluate)."""


@dataclass(frozen=True)
class Asked:
    """What the options ask for.

    Args:
        plan: The plan.
        missing: Scenes of a preset that do not exist.
        lenient: Whether unusable scenes are skipped.
    """

    plan: Plan
    missing: tuple[str, ...] = ()
    lenient: bool = False


def parse_plan(arguments: Sequence[str]) -> tuple[Options, Asked]:
    """The options of a command line, and the plan that they ask for.

    The options are parsed twice: the first pass only determines which plan to change, and the
    second, with that plan's training as defaults, what the user wants changed.

    Raises:
        ParameterError: Options contradict each other, or a value is out of its range.
        SceneNotFoundError: A plan or a preset's scenes are not there.
        SceneFormatError: The plan's file is not one.
    """
    options = parse_options(Options, "bench", arguments)
    _check(options)
    asked = _base(options)
    begun = Options(training=PlanTraining.of(asked.plan.training))
    options = parse_options(Options, "bench", arguments, begun)
    plan = dataclasses.replace(asked.plan, **_changes(options))
    if options.depth:
        plan = dataclasses.replace(plan, scenes=_with_depth(plan.scenes, options.depth))
    if options.clouds:
        plan = dataclasses.replace(plan, scenes=_with_clouds(plan.scenes, options.clouds))
    if not plan.scenes:
        raise ParameterError(
            "--scenes DIR..., --preset or --plan",
            found="none of them",
            fix="splatseed bench --preset quick -o BENCH tries it on a synthetic room.",
        )
    return options, dataclasses.replace(asked, plan=plan)


def _check(options: Options) -> None:
    if options.output is None and not options.dry_run:
        raise ParameterError(
            "-o BENCH, the folder of the benchmark", found="none", fix="Name one, or --dry-run."
        )
    if options.plan is not None and options.preset is not None:
        raise ParameterError("--plan or --preset", found="both", fix="Leave one of them out.")
    if options.preset is None and options.data is not None:
        raise ParameterError("--preset with --data", found="none", fix="Name the preset.")
    if options.preset not in {None, "quick"} and options.scenes:
        raise ParameterError(
            f"the scenes of the preset {options.preset}",
            found="--scenes",
            fix="Leave --scenes out, or take --plan: --dry-run prints the preset's.",
        )
    check_least(options, 1, "jobs", "threads", "repeats", "long_side")
    if options.address is not None and options.executor != "ray":
        raise ParameterError("--executor ray with --address", found="local", fix="Add it.")


def _base(options: Options) -> Asked:
    """The plan that options change."""
    if options.preset is not None:
        plan, missing = preset_plan(options.preset, options.data)
        return Asked(plan, missing, lenient=options.preset != "quick")
    if options.plan is not None:
        return Asked(read_plan(options.plan))
    if options.output is not None and not options.scenes:
        earlier = options.output / PLAN
        if earlier.is_file():
            return Asked(read_plan(earlier))
    return Asked(DEFAULT)


def _changes(options: Options) -> dict[str, Any]:
    """The fields of the plan that are given as options."""
    names = {each.name for each in dataclasses.fields(Plan)} - {"scenes", "parameters", "training"}
    given = {name: getattr(options, name) for name in names}
    # By identity: 0 equals False.
    idle = {name for name, value in given.items() if value in (None, ()) or value is False}
    changes = {name: value for name, value in given.items() if name not in idle}
    changes["training"] = options.training.settings
    if options.budgets and not options.ratios:
        changes["ratios"] = ()
    if options.scenes:
        changes["scenes"] = _scenes(options.scenes)
    return changes


def _scenes(paths: Sequence[str]) -> tuple[PlannedScene, ...]:
    """The scenes at some paths; folders of the same name are told apart by their parents."""
    scenes = [PlannedScene(path) for path in paths]
    count = Counter(scene.label for scene in scenes)
    return tuple(
        scene
        if count[scene.label] == 1 or scene.path == DEMO
        else PlannedScene(scene.path, "_".join(Path(scene.path).resolve().parts[-2:]))
        for scene in scenes
    )


def _with_depth(
    scenes: Sequence[PlannedScene], folders: Sequence[Path]
) -> tuple[PlannedScene, ...]:
    """The scenes with their folders of depth maps."""
    if len(folders) == 1 and any((folders[0] / scene.label).is_dir() for scene in scenes):
        below = [folders[0] / scene.label for scene in scenes]
        depths = [str(folder) if folder.is_dir() else "" for folder in below]
    elif len(folders) == len(scenes):
        depths = [str(folder) for folder in folders]
    else:
        raise ParameterError(
            f"--depth with a folder for each of {len(scenes)} scenes, or one with subfolders of "
            "their names",
            found=f"{len(folders)} folders",
            fix="See --dry-run for the scenes and their order.",
        )
    return tuple(
        dataclasses.replace(scene, depth=depth) for scene, depth in zip(scenes, depths, strict=True)
    )


def _with_clouds(scenes: Sequence[PlannedScene], files: Sequence[Path]) -> tuple[PlannedScene, ...]:
    """The scenes with their scans."""
    if len(files) != len(scenes):
        raise ParameterError(
            f"--clouds with a scan for each of {len(scenes)} scenes",
            found=f"{len(files)} files",
            fix="Name one per scene, in their order; in a plan (see --dry-run), only some scenes "
            "may have one.",
        )
    return tuple(
        dataclasses.replace(scene, cloud=str(file))
        for scene, file in zip(scenes, files, strict=True)
    )
