"""``splatseed tune``: which seeds and which strategy are best for this scene, by experiment."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections import defaultdict
from collections.abc import Collection, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import tyro

from splatseed.bench.job import JobOptions
from splatseed.bench.plan import SFM, Arm, Plan, RunResult, RunSpec, plan_runs
from splatseed.bench.runs import (
    alone_in,
    begin,
    check_bench_folder,
    estimate,
    package_version,
    read_run,
)
from splatseed.bench.scenes import PlannedScene, SceneFacts, survey
from splatseed.bench.statistics import LEVEL
from splatseed.bench.tuning import (
    Results,
    Rung,
    Verdict,
    best_arms,
    growth_within,
    is_baseline,
    make_validation_scene,
    plan_rungs,
    steps_to_grow,
    verdict,
)
from splatseed.commands import bench
from splatseed.commands.bench import Machine, carry_out, print_failures, spoken_time
from splatseed.commands.options import check_least, parse_options, refuse
from splatseed.console import OUT, print_note, print_pairs, print_table, stage_display
from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.files import read_text
from splatseed.io.staging import write_json
from splatseed.literal import quoted, visible
from splatseed.runtime.interruption import exit_code
from splatseed.seeding.upsampling import parse_budget
from splatseed.train.settings import StrategyName, TrainSettings

_TEST_EVERY = 8
_LONG_SIDE = 400
"""Most pixels of photographs' longer side: they are reduced by a whole factor."""
_ALL_FAILED = 1
_EQUAL = 0.99
"""Least part of the most Gaussians that counts as as many."""


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
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    """The folder of its runs; tune_ and the scene's name, here, by default."""
    budget: str = "0.25rho"
    """Gaussians at the end: a number, or per pixel of a photograph at the training size."""
    max_steps: int = 7000
    """Steps that you plan to train. Runs take no more, unless that is too few to tell: the first of
    three rounds takes 100, or what growing to the budget needs, and each next twice as many."""
    methods: tuple[str, ...] = (SFM, "mls", "stereo", "cover", "auto")
    """Seeds to try, sfm among them."""
    strategies: tuple[StrategyName, ...] = ("default", "grow", "mcmc")
    """Strategies to try, default among them."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "tune", arguments)
    check_least(options, 1, "max_steps")
    refuse((not 0 < options.minutes < math.inf, "--minutes above 0", options.minutes, "Try 10."))
    for name, needed in (("methods", SFM), ("strategies", "default")):
        expected, given = f"{needed} among --{name}, the baseline", getattr(options, name)
        refuse((needed not in given, expected, " ".join(given), "Add it."))
    folder = options.output or Path(f"tune_{PlannedScene(str(options.scene)).label}")
    check_bench_folder(folder, "tune", [options.scene])
    with bench.open_machine(bench.Options(), "auto") as machine:
        new = not folder.exists()
        try:
            tuning = _open(options, folder, machine, arguments)
        except SplatseedError:
            if new:  # nothing was begun
                shutil.rmtree(folder, ignore_errors=True)
            raise
        tuning.announce()
        with alone_in(folder):
            ended = tuning.climb()
    tuning.report(ended=ended)
    if not ended:
        sys.exit(exit_code())


def _open(options: Options, folder: Path, machine: Machine, arguments: Sequence[str]) -> _Tuning:
    with stage_display() as clock:
        clock("read", 0.0)
        path = make_validation_scene(options.scene, folder / "scene", _TEST_EVERY)
        facts = survey(
            PlannedScene(str(path), PlannedScene(str(options.scene)).label), progress=clock
        )
    factor = max(1, -(-facts.long_side // _LONG_SIDE))
    budget, least_steps = options.budget, 0
    if "grow" in options.strategies:
        grown = max(2, math.floor(facts.num_points * growth_within(options.max_steps)))
        most = parse_budget(budget, facts.pixels_at(factor))
        budget = budget if most <= grown else str(grown)
        least_steps = steps_to_grow(min(most, grown) / max(1, facts.num_points))
    tuning = _Tuning(options, folder, facts, machine, budget, [])
    tuning.plan(least_steps)
    begin(folder, "tune", tuning.specs(tuning.rungs[0]), arguments)
    return tuning


@dataclass(frozen=True)
class _Tuning:
    """A scene under tuning: everything that its rungs share, and the rungs."""

    options: Options
    folder: Path
    facts: SceneFacts
    machine: Machine
    budget: str
    rungs: list[Rung]

    def specs(self, rung: Rung, arms: Collection[Arm] | None = None) -> list[RunSpec]:
        plan = Plan(
            (self.facts,), self.options.methods, (), (self.budget,), self.options.strategies,
            repeats=rung.repeats, long_side=_LONG_SIDE,
            training=TrainSettings(max_steps=rung.steps, test_every=_TEST_EVERY),
        )  # fmt: skip
        version = package_version("splatseed")
        runs = plan_runs(plan, [self.facts], self.machine.backend, version)
        return [spec for spec in runs if arms is None or spec.arm in arms]

    def results(self, rung: Rung) -> Results:
        """Results of a rung's finished runs, by arm and repeat."""
        results: dict[Arm, dict[int, RunResult]] = defaultdict(dict)
        for run in (read_run(self.folder, spec) for spec in self.specs(rung)):
            if run.result and math.isfinite(run.result.psnr):
                results[run.spec.arm][run.spec.repeat] = run.result
        return dict(results)

    def plan(self, least_steps: int) -> None:
        """Take the rungs that were planned when the folder was begun, or plan new ones."""
        path, decisive = self.folder / "tune.json", ("minutes", "budget", "max_steps")
        asked: dict[str, Any] = {name: getattr(self.options, name) for name in decisive}
        asked |= {"scene": str(self.options.scene.resolve())}
        asked |= {name: list(getattr(self.options, name)) for name in ("methods", "strategies")}
        if path.is_file():
            try:
                kept = json.loads(read_text(path))
                self.rungs.extend(Rung(**each) for each in kept["rungs"])
                others = kept["asked"] != asked
            except (OSError, ValueError, KeyError, TypeError):
                expected = f"{path} as splatseed tune writes it"
                raise SceneFormatError(expected, found="something else", fix="Remove it.") from None
            fix = "Repeat those, or name another folder with -o."
            began = f"the scene and the options that {self.folder} was begun with"
            refuse((others, began, "others", fix))
            return
        num_arms = _num_arms(self.specs(Rung(100, 0, 1)))
        seconds, most = self.options.minutes * 60, self.options.max_steps
        self.rungs.extend(plan_rungs(num_arms, seconds, most, self.seconds, least_steps))
        write_json(path, {"asked": asked, "rungs": list(map(asdict, self.rungs))})

    def seconds(self, rungs: Sequence[Rung]) -> float:
        """Estimated seconds of rungs, if their arms take the mean time of all."""
        total = 0.0
        for rung in rungs:
            specs = self.specs(rung)
            total += estimate(specs, (), self.machine.threads) * rung.arms / _num_arms(specs)
        return total / self.machine.jobs

    def announce(self) -> None:
        facts, minutes = self.facts, spoken_time(self.seconds(self.rungs))
        steps = ", then ".join(f"{rung.arms} arms for {rung.steps:,} steps" for rung in self.rungs)
        OUT.print(
            f"{visible(facts.name)}: {facts.num_images} views that are not for the test, every "
            f"{_TEST_EVERY}th held out; {facts.num_points:,} points\n  -> {steps}, the last twice\n"
            f"  -> about {minutes} in all (--minutes); {self.machine.words}\n"
            f"  -> {visible(self.folder)}",
            soft_wrap=True,
        )
        if self.budget != self.options.budget:
            print_note(
                f"All arms have {int(self.budget):,} Gaussians at most: growth from "
                f"{facts.num_points:,} points reaches no more."
            )

    def climb(self) -> bool:
        arms: Collection[Arm] | None = None
        for i, rung in enumerate(self.rungs):
            specs = self.specs(rung, arms)
            OUT.print(f"\n{rung.steps:,} steps, {_num_arms(specs)} arms")
            runs = [read_run(self.folder, spec) for spec in specs]
            if not carry_out(self.folder, runs, self.machine, JobOptions()):
                return False
            if verdict(self.results(rung), rung.steps) is None:  # nothing to choose from
                break
            if i + 1 < len(self.rungs):
                arms = best_arms(self.results(rung), self.rungs[i + 1].arms)
        return True

    def report(self, *, ended: bool) -> None:
        """Print the verdict of the longest finished runs, and the command that follows from it."""
        for rung in reversed(self.rungs):  # the highest with two or more finished arms
            results = self.results(rung)
            if (said := verdict(results, rung.steps)) is not None:
                break
        else:
            print_note("Nothing can be said yet: repeat the command to continue.")
            if ended:
                print_failures(
                    self.folder, [read_run(self.folder, s) for s in self.specs(self.rungs[0])]
                )
                sys.exit(_ALL_FAILED)
            return
        if not ended:
            print_note("Stopped before the last run: repeat the command to continue.")
        numbers, rows = dict[Arm, int](), []
        for arm, psnr in said.ranking:
            numbers[arm] = round(fmean(each.num_gaussians for each in results[arm].values()))
            rows.append((arm.label, arm.strategy, f"{numbers[arm]:,}", f"{psnr:.2f}"))
        title = f"{said.views} validation views, {said.steps:,} steps"
        print_table(title, ("seeds", "strategy", "Gaussians", "PSNR, dB"), rows)
        most = max(numbers.values())
        few = [f"{arm.label} + {arm.strategy}" for arm in numbers if numbers[arm] < _EQUAL * most]
        if few:
            print_note(f"Compare with care: {', '.join(few)} ended with fewer Gaussians.")
        OUT.print(sentence(said), soft_wrap=True)
        print_pairs("next", self._commands(said.winner))

    def _commands(self, arm: Arm) -> list[tuple[str, str]]:
        options, scene, commands = self.options, self.options.scene, []
        rung = Rung(options.max_steps, 0, 1)
        spec = next(each for each in self.specs(rung) if each.arm == arm)
        seeded = f"{self.facts.name}_{arm.method}"
        if arm.method != SFM:
            points = max(spec.most_seeds or 0, self.facts.num_points)
            looks = "hold_out" in spec.parameters
            number = f"--{arm.method}.hold-out {_TEST_EVERY}" if looks else f"--num-points {points}"
            seeding = (
                f"splatseed upsample {quoted(scene)} --method {arm.method} {number} "
                f"--budget {spec.most_seeds} -o {quoted(seeded)}"
            )
            commands.append(("seeds", seeding))
        training = (
            f"splatseed train {quoted(scene if arm.method == SFM else seeded)} --seeds scene "
            f"--strategy {arm.strategy} --budget {spec.training.cap_max} "
            f"--max-steps {options.max_steps} --data-factor {spec.training.data_factor} "
            f"-o {quoted(f'run_{seeded}_{arm.strategy}')}"
        )
        return [*commands, ("training", training)]


def _num_arms(specs: Sequence[RunSpec]) -> int:
    return len({spec.arm for spec in specs})


def sentence(said: Verdict) -> str:
    """A verdict in words."""
    arm, gain = said.winner, said.gain
    if is_baseline(arm):
        return "The scene's own points with strategy default are best: leave them as they are."
    over = "views and repeats" if said.repeats > 1 else "views"
    spread = f" ± {gain.se:.2f} (standard error over {over})" if not math.isnan(gain.se) else ""
    doubt = ""
    if said.repeats == 1:
        doubt = " One run of each cannot tell: sfm + default may do as well."
    elif not gain.p * (len(said.ranking) - 1) <= LEVEL:  # Holm's smallest step: the best of all
        doubt = " That is within noise: sfm + default may do as well."
    name = f"{arm.label} + {arm.strategy}"
    return f"Best is {name}: {gain.mean:+.2f} dB{spread} over sfm + default.{doubt}"
