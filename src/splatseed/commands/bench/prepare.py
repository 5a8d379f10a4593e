"""From a plan to its runs: checking every scene before any is run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatseed.bench.planning.plan import DEPTH, Plan, PlannedScene, plan_runs
from splatseed.bench.planning.records import SFM, RunSpec, needs_cloud
from splatseed.bench.planning.scenes import SceneFacts, survey
from splatseed.bench.running.environment import package_version
from splatseed.bench.running.folder import DEMO_FACTS, make_demo_scene
from splatseed.commands.bench.options import Asked
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.progress import Progress
from splatseed.train.settings import Backend

NO_RUNS = "Name other methods, or what these need."


@dataclass(frozen=True)
class Prepared:
    """A benchmark that can be run.

    Args:
        plan: Its plan, with the scenes that exist.
        scenes: Facts about them.
        runs: Its runs, in order.
        notes: Notes for the user, one sentence each.
    """

    plan: Plan
    scenes: Sequence[SceneFacts]
    runs: Sequence[RunSpec]
    notes: Sequence[str]

    @property
    def keys(self) -> frozenset[str]:
        """The keys of its runs."""
        return frozenset(spec.key for spec in self.runs)


def prepare(asked: Asked, backend: Backend, made: Path | None, progress: Progress) -> Prepared:
    """Check all scenes of a plan, and list its runs.

    Args:
        asked: The user's request.
        backend: The backend of training: not "auto".
        made: Where to put a synthetic scene; None to use its known facts without making it.
        progress: Told how far this is.

    Raises:
        SceneNotFoundError: A scene is not there; for a preset, none is.
        SceneFormatError: A file of one is not what its format promises.
        ParameterError: No run is left.
    """
    notes = [f"not there: {', '.join(asked.missing)}"] if asked.missing else []
    present: list[tuple[PlannedScene, SceneFacts]] = []
    absent = [*notes]
    for scene in asked.plan.scenes:
        try:
            present.append((scene, _survey(scene, asked.plan, made, progress)))
        except SceneNotFoundError as error:
            if not asked.lenient:
                raise
            notes.append(f"{scene.label} is left out: {error}")
            absent.append(f"in {scene.label}, expected {error.expected}, found {error.found}")
    if not present:
        fix = "Name the folder that holds the preset's scenes with --data."
        raise SceneNotFoundError("scenes to run", found=f"none; {'; '.join(absent)}", fix=fix)
    plan = dataclasses.replace(asked.plan, scenes=tuple(scene for scene, _ in present))
    scenes = [facts for _, facts in present]
    runs = plan_runs(plan, scenes, backend, package_version("splatseed"))
    notes += [*_notes(plan, scenes), *_full(runs, scenes)]
    if not runs:
        raise ParameterError("a plan with runs", found="; ".join(notes) or "none", fix=NO_RUNS)
    return Prepared(plan, scenes, runs, notes)


def _survey(scene: PlannedScene, plan: Plan, made: Path | None, progress: Progress) -> SceneFacts:
    if scene.is_demo and made is None:
        return dataclasses.replace(DEMO_FACTS, name=scene.label)
    if scene.is_demo:
        progress("make the demo scene", 0.0)
    return survey(
        make_demo_scene(made) if made and scene.is_demo else Path(scene.path),
        scene.label,
        images=scene.images,
        depth=Path(scene.depth) if scene.depth else None,
        with_depth=DEPTH in plan.methods,
        cloud=Path(scene.cloud) if scene.cloud and _scans(plan) else None,
        progress=progress,
    )


def _scans(plan: Plan) -> bool:
    """Whether an arm needs the scenes' scans."""
    return any(map(needs_cloud, plan.methods))


def _full(runs: Sequence[RunSpec], scenes: Sequence[SceneFacts]) -> Iterator[str]:
    """A note for each budget that a scene's own points fill."""
    there = {facts.name: facts.num_points for facts in scenes}
    seeds = {(run.scene, run.arm.budget): run.most_seeds for run in runs if run.arm.method != SFM}
    for (scene, budget), most in seeds.items():
        if most is not None and most <= there[scene]:
            yield (
                f"{scene}: under {budget} a run begins with {most:,} seeds at most, and it has "
                f"{there[scene]:,} points: auto and the methods that interpolate add none."
            )


def _notes(plan: Plan, scenes: Sequence[SceneFacts]) -> Iterator[str]:
    for scene in scenes:
        yield from (f"{scene.name}: {warning}" for warning in scene.warnings)
    bare = [scene.name for scene in scenes if not scene.depth_digest]
    if DEPTH in plan.methods and bare:
        names = ", ".join(bare)
        yield f"without depth maps, and so without the method depth: {names} (--depth DIR)"
    unscanned = [scene.name for scene in scenes if not scene.cloud_digest]
    if _scans(plan) and unscanned:
        names = ", ".join(unscanned)
        yield f"without a scan, and so without the methods that need one: {names} (--clouds FILE)"
    if not _scans(plan) and any(scene.cloud for scene in plan.scenes):
        yield "No method needs the scans: name cloud or cloud+auto among --methods."
    if SFM not in plan.methods:
        yield "Without sfm among the methods there is nothing to compare with."
    if len(plan.profiles) > 1:
        labels = [arm for arm in plan.arms(plan.strategies[0]) if arm.method != SFM]
        same = [m for m in plan.methods if len({a.profile for a in labels if a.method == m}) == 1]
        if same:
            yield f"run once, as both profiles are the same: {', '.join(same)}"
