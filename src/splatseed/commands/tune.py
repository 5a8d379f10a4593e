"""``splatseed tune``: which seeds and which strategy are best for this scene, by experiment."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
import sys
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import tyro

from splatseed.bench.analysis.statistics import LEVEL
from splatseed.bench.planning.estimate import Estimator
from splatseed.bench.planning.plan import Plan, PlannedScene, plan_runs
from splatseed.bench.planning.records import SFM, Arm, RunResult, RunSpec
from splatseed.bench.planning.scenes import SceneFacts, survey
from splatseed.bench.running.environment import describe_environment, package_version
from splatseed.bench.running.folder import TUNING, check_bench_folder, make_bench_folder
from splatseed.bench.running.job import JobOptions
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.bench.tuning.halving import (
    LAST_REPEATS,
    Rung,
    Verdict,
    best_arms,
    check_time,
    plan_rungs,
    verdict,
)
from splatseed.bench.tuning.reach import most_grown, steps_to_grow
from splatseed.bench.tuning.validation import make_validation_scene
from splatseed.commands.bench.display import run_display, spoken_time
from splatseed.commands.bench.machine import Machine, open_machine
from splatseed.commands.bench.options import Options as BenchOptions
from splatseed.commands.options import check_least, parse_options
from splatseed.console import OUT, print_commands, print_note, print_table, stage_display
from splatseed.errors import ParameterError, SceneFormatError, SplatseedError
from splatseed.io.files import read_text
from splatseed.io.staging import atomic_file
from splatseed.literal import quoted, visible
from splatseed.process.interruption import exit_code
from splatseed.seeding.upsampling import parse_budget
from splatseed.train.settings import Backend, StrategyName, TrainSettings

SCENE = "scene"
MINUTE = 60.0
EQUAL = 0.99
"""Least part of the most Gaussians that counts as as many."""
METHODS = (SFM, "mls", "stereo", "cover", "auto")
STRATEGIES: tuple[StrategyName, ...] = ("default", "grow", "mcmc")
TEST_EVERY = 8


def _number(kind: type, default: str) -> Any:
    return tyro.conf.arg(
        constructor=kind,
        metavar=kind.__name__.upper(),
        help_behavior_hint=f"(default: {default})",
    )


@dataclass(frozen=True)
class Options:
    """Find the best seeds and strategy for a scene by short runs on it, at one number of Gaussians.

    Test views are never looked at: every 8th of the other views is held out for choosing. Many
    arms are trained briefly, the best of them for longer. Stop it when you like: the same command
    resumes.
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """The scene, with photographs."""
    minutes: float = 10.0
    """Approximate time to take; more of it trains longer, and tells smaller differences apart."""
    output: Annotated[
        Path | None,
        tyro.conf.arg(
            aliases=["-o"],
            constructor=Path,
            metavar="DIR",
            help_behavior_hint="(default: tune_ and the scene's name, here)",
        ),
    ] = None
    """The folder of its runs."""
    budget: str = "0.25rho"
    """Gaussians at the end: a number, or per pixel of a photograph at the training size."""
    max_steps: int = 7000
    """Steps that you plan to train. Runs take no more, unless that is too few to tell: the first of
    three rounds takes 100, or what growing to the budget needs, and each next twice as many."""
    long_side: int = 400
    """Reduce photographs by a whole factor until their longer side has at most this many pixels."""
    methods: tuple[str, ...] = METHODS
    """Seeds to try, sfm among them."""
    strategies: tuple[StrategyName, ...] = STRATEGIES
    """Strategies to try, default among them."""
    jobs: Annotated[int | None, _number(int, "one per GPU, else 1")] = None
    """Runs at a time."""
    threads: Annotated[int | None, _number(int, "an equal share of the cores")] = None
    """Threads of each run on the CPU."""
    backend: Backend = "auto"
    """Where to train; auto takes a GPU if PyTorch sees one."""


@dataclass(frozen=True)
class _Study:
    """A scene under tuning: everything that its rungs share."""

    options: Options
    folder: Path
    facts: SceneFacts
    machine: Machine
    ledger: Ledger

    @property
    def budget(self) -> str:
        """The budget asked for, or what growth from the scene's own points can reach if less."""
        return self.options.budget if self._most == self._asked_for else str(self._most)

    @property
    def least_steps(self) -> int:
        """The fewest steps in which every arm can reach the budget."""
        if "grow" not in self.options.strategies:
            return 0
        return steps_to_grow(self._most / max(1, self.facts.num_points))

    @property
    def _most(self) -> int:
        """The number of Gaussians that every arm gets."""
        if "grow" not in self.options.strategies:
            return self._asked_for
        return min(self._asked_for, most_grown(self.facts.num_points, self.options.max_steps))

    @property
    def _asked_for(self) -> int:
        """The number of Gaussians that the user's budget comes to."""
        factor = max(1, -(-self.facts.long_side // self.options.long_side))
        return parse_budget(self.options.budget, self.facts.pixels_at(factor))

    def specs(self, rung: Rung, arms: Collection[Arm] | None = None) -> list[RunSpec]:
        """The runs of a rung, for these arms or for all."""
        options = self.options
        plan = Plan(
            scenes=(PlannedScene(self.facts.path, self.facts.name),),
            methods=options.methods,
            ratios=(),
            budgets=(self.budget,),
            strategies=options.strategies,
            repeats=rung.repeats,
            training=TrainSettings(max_steps=rung.steps, test_every=TEST_EVERY),
            long_side=options.long_side,
        )
        backend = self.machine.backend
        runs = plan_runs(plan, [self.facts], backend, package_version("splatseed"))
        return [spec for spec in runs if arms is None or spec.arm in arms]

    def results(self, specs: Sequence[RunSpec]) -> dict[Arm, dict[int, RunResult]]:
        """Results of the finished ones among some runs, by arm and repeat."""
        keys = {spec.key for spec in specs}
        results: dict[Arm, dict[int, RunResult]] = defaultdict(dict)
        for row in self.ledger.rows():
            if row.spec.key in keys and row.result and math.isfinite(row.result.psnr):
                results[row.spec.arm][row.spec.repeat] = row.result
        return dict(results)


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "tune", arguments)
    _check(options)
    folder = options.output or Path(f"tune_{options.scene.resolve().name}")
    check_bench_folder(folder, [options.scene], tunes=True)
    asked = BenchOptions(jobs=options.jobs, threads=options.threads)
    with open_machine(asked, options.backend) as machine:
        with _kept_if_begun(folder):
            study = _open(options, folder, machine, arguments)
            rungs = _rungs(study)
        _announce(study, rungs)
        ended = _climb(study, rungs)
    _report(study, rungs, ended=ended)
    if not ended:
        sys.exit(exit_code())


@contextmanager
def _kept_if_begun(folder: Path) -> Iterator[None]:
    """Remove the folder again if the block refuses to begin in it."""
    before = folder.exists()
    try:
        yield
    except SplatseedError:
        if not before:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _check(options: Options) -> None:
    check_least(options, 1, "max_steps", "long_side", "jobs", "threads")
    if not 0 < options.minutes < math.inf:
        raise ParameterError("--minutes above 0", found=f"{options.minutes}", fix="Try 10.")
    for name, needed in (("methods", SFM), ("strategies", "default")):
        if needed not in getattr(options, name):
            raise ParameterError(
                f"{needed} among --{name}, with which all else is compared",
                found=" ".join(getattr(options, name)),
                fix="Add it.",
            )


def _open(options: Options, folder: Path, machine: Machine, arguments: Sequence[str]) -> _Study:
    with stage_display() as clock:
        clock("read", 0.0)
        make_bench_folder(folder)
        path = make_validation_scene(options.scene, folder / SCENE, TEST_EVERY)
        facts = survey(path, options.scene.resolve().name, progress=clock)
    ledger = Ledger.open(folder / LEDGER)
    ledger.note_session(describe_environment(["tune", *arguments]))
    return _Study(options, folder, facts, machine, ledger)


def _rungs(study: _Study) -> tuple[Rung, ...]:
    """The rungs that were planned when the folder was begun, or new ones."""
    path, asked = study.folder / TUNING, _asked(study.options)
    if path.is_file():
        try:
            kept = json.loads(read_text(path))
            rungs = tuple(Rung(**each) for each in kept["rungs"])
        except (OSError, ValueError, KeyError, TypeError):
            raise SceneFormatError(
                f"{path} as splatseed tune writes it", found="something else", fix="Remove it."
            ) from None
        if kept["asked"] != asked:
            raise ParameterError(
                f"the options that {study.folder} was begun with",
                found="others",
                fix="Repeat those, or name another folder with -o.",
            )
        return rungs
    estimator = _estimator(study)

    def cost(rungs: Sequence[Rung]) -> float:
        return sum(_seconds(study, rung, estimator) for rung in rungs)

    num_arms = len({spec.arm for spec in study.specs(Rung(100, 0, 1))})
    seconds = study.options.minutes * MINUTE
    rungs = plan_rungs(num_arms, seconds, study.options.max_steps, cost, study.least_steps)
    check_time(cost(rungs), seconds)
    content = {"asked": asked, "rungs": [asdict(each) for each in rungs]}
    with atomic_file(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n", "utf-8")
    return rungs


def _asked(options: Options) -> dict[str, Any]:
    """The options that decide on the rungs."""
    told = ("minutes", "budget", "max_steps", "long_side", "methods", "strategies")
    values = {name: getattr(options, name) for name in told}
    return {name: list(v) if isinstance(v, tuple) else v for name, v in values.items()}


def _estimator(study: _Study) -> Estimator:
    return Estimator([study.facts], study.ledger.rows(), study.machine.threads)


def _seconds(study: _Study, rung: Rung, estimator: Estimator) -> float:
    """Seconds of a rung, if its arms take the mean time of all."""
    specs = study.specs(rung)
    share = rung.arms / len({spec.arm for spec in specs})
    return share * sum(estimator.of_all(specs).values()) / study.machine.jobs


def _announce(study: _Study, rungs: Sequence[Rung]) -> None:
    estimator = _estimator(study)
    seconds = sum(_seconds(study, rung, estimator) for rung in rungs)
    steps = ", then ".join(f"{rung.arms} arms for {rung.steps:,} steps" for rung in rungs)
    facts = study.facts
    OUT.print(
        f"{visible(facts.name)}: {facts.num_images} views that are not for the test, every "
        f"{TEST_EVERY}th held out; {facts.num_points:,} points\n  -> {steps}, the last twice\n  -> "
        f"about {spoken_time(seconds)} in all (--minutes); {study.machine.words}\n"
        f"  -> {visible(study.folder)}",
        soft_wrap=True,
    )
    if study.budget != study.options.budget:
        print_note(
            f"All arms have {int(study.budget):,} Gaussians at most: growth from "
            f"{facts.num_points:,} points reaches no more."
        )


def _climb(study: _Study, rungs: Sequence[Rung]) -> bool:
    """Run the rungs in order; whether all were finished."""
    arms: Collection[Arm] | None = None
    for i, rung in enumerate(rungs):
        specs = study.specs(rung, arms)
        OUT.print(f"\n{rung.steps:,} steps, {len({spec.arm for spec in specs})} arms")
        if not _do(study, specs):
            return False
        if i + 1 < len(rungs):
            arms = best_arms(study.results(specs), rungs[i + 1].arms)
    return True


def _do(study: _Study, specs: Sequence[RunSpec]) -> bool:
    """Do the unfinished ones among some runs."""
    study.ledger.add(specs)
    keys = frozenset(spec.key for spec in specs)
    done = {row.spec.key for row in study.ledger.rows() if row.status in {"done", "failed"}}
    left = [spec for spec in specs if spec.key not in done]
    if not left:
        return True
    estimator = _estimator(study)
    expected = estimator.of_all(left)
    with run_display(expected, len(specs) - len(left), study.machine.jobs) as display:
        return study.machine.run(study.ledger, study.folder, keys, JobOptions(), display)


def _report(study: _Study, rungs: Sequence[Rung], *, ended: bool) -> None:
    """Print the verdict of the longest finished runs, and the command that follows from it."""
    said = _verdict(study, rungs)
    if said is None:
        print_note("Nothing can be said yet: repeat the command to continue.")
        return
    if not ended:
        print_note("Stopped before the last run: this is so far. Repeat the command to continue.")
    counts = _counts(study, said)
    rows = [
        (arm.label, arm.strategy, f"{counts[arm]:,}", f"{psnr:.2f}") for arm, psnr in said.ranking
    ]
    views = f"{said.views} validation views, {said.steps:,} steps"
    print_table(views, ("seeds", "strategy", "Gaussians", "PSNR, dB"), rows)
    most = max(counts.values())
    if few := [arm.label + " + " + arm.strategy for arm in counts if counts[arm] < EQUAL * most]:
        print_note(f"Compare with care: {', '.join(few)} ended with fewer Gaussians.")
    OUT.print(_sentence(said), soft_wrap=True)
    print_commands("next", _commands(study, said))


def _verdict(study: _Study, rungs: Sequence[Rung]) -> Verdict | None:
    """The verdict of the highest rung with two or more finished arms."""
    for rung in reversed(rungs):
        results = study.results(study.specs(rung))
        said = verdict(results, rung.steps)
        if said is not None:
            return said
    return None


def _counts(study: _Study, said: Verdict) -> dict[Arm, int]:
    """The mean number of Gaussians with which each arm of the verdict's rung ended."""
    most = max(LAST_REPEATS, said.repeats)
    results = study.results(study.specs(Rung(said.steps, 0, most)))
    return {
        arm: round(fmean(r.num_gaussians for r in results[arm].values())) for arm, _ in said.ranking
    }


def _sentence(said: Verdict) -> str:
    arm, gain = said.winner, said.gain
    name = f"{arm.label} + {arm.strategy}"
    if (arm.method, arm.strategy) == (SFM, "default"):
        return "The scene's own points with strategy default are best: leave them as they are."
    over = "views and repeats" if said.repeats > 1 else "views"
    spread = f" ± {gain.se:.2f} (standard error over {over})" if not math.isnan(gain.se) else ""
    sure = gain.p <= LEVEL
    doubt = "" if sure else " That is within noise: sfm + default may do as well."
    return f"Best is {name}: {gain.mean:+.2f} dB{spread} over sfm + default.{doubt}"


def _commands(study: _Study, said: Verdict) -> list[tuple[str, str]]:
    """The winner's commands, for the whole scene and the planned steps."""
    options, arm = study.options, said.winner
    spec = next(each for each in study.specs(Rung(said.steps, 0, 1)) if each.arm == arm)
    spec = dataclasses.replace(
        spec, training=dataclasses.replace(spec.training, max_steps=options.max_steps)
    )
    scene, name = options.scene, options.scene.resolve().name
    seeded = f"{name}_{arm.method}"
    commands = []
    if arm.method != SFM:
        hold = f" --{arm.method}.hold-out {TEST_EVERY}" if "hold_out" in spec.parameters else ""
        number = (
            "" if hold else f" --num-points {max(spec.most_seeds or 0, study.facts.num_points)}"
        )
        seeding = (
            f"splatseed upsample {quoted(scene)} --method {arm.method}{hold}{number} "
            f"--budget {spec.most_seeds} -o {quoted(seeded)}"
        )
        commands.append(("seeds", seeding))
    source = quoted(scene) if arm.method == SFM else quoted(seeded)
    training = (
        f"splatseed train {source} --seeds scene --strategy {arm.strategy} --budget "
        f"{spec.training.cap_max} --max-steps {options.max_steps} --data-factor "
        f"{spec.training.data_factor} -o {quoted(f'run_{seeded}_{arm.strategy}')}"
    )
    return [*commands, ("training", training)]
