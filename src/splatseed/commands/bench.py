"""``splatseed bench``: does upsampling help on these scenes, by which method, at what cost?"""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.progress import BarColumn, Progress as Bar, TaskID, TextColumn, TimeRemainingColumn

from splatseed.bench.job import JobOptions, do_runs
from splatseed.bench.plan import DEPTH, SFM, Plan, RunSpec, needs_cloud, plan_runs
from splatseed.bench.plan_file import PLAN, PresetName, plan_text, preset_plan, read_plan
from splatseed.bench.runs import (
    Run,
    begin,
    check_bench_folder,
    counts,
    estimate,
    package_version,
    read_run,
    read_runs,
)
from splatseed.bench.scenes import PlannedScene, SceneFacts, survey
from splatseed.commands.options import check_least, parse_options
from splatseed.console import ERR, OUT, print_note, print_pairs, print_table, stage_display
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io.staging import atomic_file, check_output, output_folder
from splatseed.literal import counted, did_you_mean, quoted, visible
from splatseed.requirements import require
from splatseed.runtime.interruption import exit_code
from splatseed.runtime.memory import check_memory
from splatseed.runtime.tasks import ProcessTasks, Tasks, cores, slot_environment
from splatseed.train.settings import BYTES_EACH, Backend, StrategyName
from splatseed.upsample import Profile

if TYPE_CHECKING:
    from splatseed.bench.tables import Table

_SOME_FAILED = 1
_FAILURES_SHOWN = 5
_DEFAULT = Plan()


def _default(values: Sequence[object]) -> Any:
    """A list that is empty when not given, with its default in words."""
    return tyro.conf.arg(help_behavior_hint=f"(default: {' '.join(map(str, values))})")


@dataclass(frozen=True)
class Options:
    """Train from every method's seeds, several times each, on one machine or many, and compare.

    Stop it at any time: the same command, or ``splatseed bench -o BENCH`` alone, resumes. Then see
    ``splatseed bench report BENCH``, and ``splatseed bench compare A B`` for two benchmarks. A plan
    sets more: other settings of training, names of scenes, parameters of methods (see --dry-run).
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    """The folder of the benchmark, new or to be resumed."""
    scenes: tuple[str, ...] = ()
    """Scenes with photographs; demo: is a synthetic room."""
    methods: Annotated[tuple[str, ...], _default(_DEFAULT.methods)] = ()
    """Upsampling methods; sfm is the original cloud, with which the others are compared."""
    ratios: Annotated[tuple[float, ...], _default([f"{r:g}" for r in _DEFAULT.ratios])] = ()
    """Points in all, per original."""
    budgets: tuple[str, ...] = ()
    """Most Gaussians at the end, the same for every arm: such as 50k, or 0.25rho, per pixel of a
    photograph at training size. Methods then fill the budget, unless --ratios are given too."""
    strategies: Annotated[tuple[StrategyName, ...], _default(_DEFAULT.strategies)] = ()
    """Densification strategies; -3dgs: in 3DGS's own conventions of rates and schedules."""
    profiles: Annotated[tuple[Profile, ...], _default(_DEFAULT.profiles)] = ()
    """Parameter sets of the methods: improved ones, and those of the paper's text."""
    repeats: int | None = None
    """Number of repeats (3), with another seed each time; error bars need at least 2."""
    max_steps: int | None = None
    """Training steps (30000); schedules and learning rates adapt to them."""
    data_factor: int | None = None
    """Divide the width and height of the photographs by this whole number (1)."""
    long_side: int | None = None
    """Downsample photographs by a whole factor, per scene, to at most this many pixels on their
    longer side; instead of --data-factor."""
    depth: tuple[Path, ...] = ()
    """For method depth: a folder of maps per scene, or one folder with a subfolder of each one's
    name; the scene's own by default."""
    clouds: tuple[Path, ...] = ()
    """For methods cloud and cloud+auto: the scan of each scene, in its frame (docs/scans.md)."""
    preset: PresetName | None = None
    """A ready-made plan: the paper's data sets, laptop (four real scenes, on one core), both
    with --data; or quick, on a synthetic room."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """The folder of a preset's scenes."""
    plan: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A plan as printed by --dry-run; other options change it."""
    dry_run: bool = False
    """Print the plan, the number of runs, and an estimate of hours and disk; run nothing."""
    executor: Literal["local", "ray"] = "local"
    """Processes on this machine, or tasks on a Ray cluster (extra cluster)."""
    address: str | None = None
    """The Ray cluster's, such as auto on its head node; one on this machine alone by default."""
    jobs: int | None = None
    """Runs at a time: by default one per GPU, else 1; on Ray what fits."""


@dataclass(frozen=True)
class ReportOptions:
    """Write report.html, tables and figures of a benchmark, as far as it has run."""

    bench: Annotated[Path, tyro.conf.Positional]
    """The folder of splatseed bench."""


@dataclass(frozen=True)
class CompareOptions:
    """Show what changed from one benchmark to another, and whether it is more than noise."""

    a: Annotated[Path, tyro.conf.Positional]
    """The folder of the first benchmark."""
    b: Annotated[Path, tyro.conf.Positional]
    """The folder of the second."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    """A new folder to write the tables to, as CSV, Markdown, LaTeX and HTML."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    reporting = {"report": _report, "compare": _compare}
    if arguments and arguments[0] in reporting:
        reporting[arguments[0]](arguments[1:])
        return
    if arguments and not arguments[0].startswith("-"):
        meant = did_you_mean(arguments[0], reporting)
        raise ParameterError(
            f"{' or '.join(reporting)} after splatseed bench, or options",
            found=repr(arguments[0]),
            fix=f"{meant}Name scenes with --scenes; see splatseed bench --help.",
        )
    options, plan, missing = parse_plan(arguments)
    with open_machine(options, plan.training.backend) as machine:
        _bench(options, plan, missing, machine, arguments)


def parse_plan(arguments: Sequence[str]) -> tuple[Options, Plan, tuple[str, ...]]:
    """The options of a command line, the plan that they ask for, and a preset's missing scenes.

    An option that is not given leaves the plan unchanged: that of a preset, of a file, of the
    folder to resume, or the default one.
    """
    options = parse_options(Options, "bench", arguments)
    check_least(options, 1, "jobs", "repeats", "long_side", "max_steps", "data_factor")
    for fits, expected, found, fix in (
        (options.output or options.dry_run, "-o BENCH, the folder of the benchmark", "none",
         "Name one, or --dry-run."),
        (not (options.plan and options.preset), "--plan or --preset", "both",
         "Leave one of them out."),
        (options.preset or not options.data, "--preset with --data", "none", "Name the preset."),
        (options.preset in {None, "quick"} or not options.scenes,
         f"the scenes of the preset {options.preset}", "--scenes",
         "Leave --scenes out, or take --plan: --dry-run prints the preset's."),
        (not options.address or options.executor == "ray", "--executor ray with --address",
         "local", "Add it."),
    ):  # fmt: skip
        if not fits:
            raise ParameterError(expected, found=found, fix=fix)
    plan, missing = _DEFAULT, tuple[str, ...]()
    earlier = options.output / PLAN if options.output and not options.scenes else None
    if options.preset is not None:
        plan, missing = preset_plan(options.preset, options.data)
    elif options.plan is not None:
        plan = read_plan(options.plan)
    elif earlier is not None and earlier.is_file():
        plan = read_plan(earlier)
    plan = _changed(plan, options)
    if not plan.scenes:
        raise ParameterError(
            "--scenes DIR..., --preset or --plan",
            found="none of them",
            fix="splatseed bench --preset quick -o BENCH tries it on a synthetic room.",
        )
    return options, plan, missing


def _changed(plan: Plan, options: Options) -> Plan:

    def given(*names: str) -> dict[str, Any]:
        return {n: value for n in names if (value := getattr(options, n)) not in (None, ())}

    training = replace(plan.training, **given("max_steps", "data_factor"))
    changes = given(
        "methods", "ratios", "budgets", "strategies", "profiles", "repeats", "long_side"
    )
    if options.budgets and not options.ratios:
        changes["ratios"] = ()
    scenes = [PlannedScene(path) for path in options.scenes] or list(plan.scenes)
    labels = Counter(scene.label for scene in scenes)
    for i, scene in enumerate(scenes):  # folders of the same name are told apart by their parents
        if labels[scene.label] > 1 and not scene.is_demo and not scene.name:
            name = "_".join(Path(scene.path).resolve().parts[-2:])
            scenes[i] = replace(scene, name=name)
    maps = options.depth
    if len(maps) == 1 and any((maps[0] / scene.label).is_dir() for scene in scenes):
        below = [maps[0] / scene.label for scene in scenes]
        scenes = [replace(scene, depth=str(folder) if folder.is_dir() else "")
                  for scene, folder in zip(scenes, below, strict=True)]  # fmt: skip
        maps = ()
    for option, what, files in (("--depth", "depth", maps), ("--clouds", "cloud", options.clouds)):
        if len(files) not in {0, len(scenes)}:
            raise ParameterError(
                f"{option} with one for each of {len(scenes)} scenes",
                found=f"{len(files)}",
                fix="See --dry-run for the scenes and their order; a plan may have one for some "
                "only. --depth may be one folder with subfolders of the scenes' names.",
            )
        if files:
            pairs = zip(scenes, map(str, files), strict=True)
            scenes = [replace(scene, **{what: file}) for scene, file in pairs]
    return replace(plan, training=training, scenes=tuple(scenes), **changes)


@dataclass(frozen=True)
class Machine:
    """Where runs are carried out: how many ``jobs`` at a time, of so many threads on the CPU each.

    ``backend`` is not "auto"; ``away`` is whether ``tasks`` are carried out on other machines.
    """

    name: str
    backend: Backend
    jobs: int
    threads: int
    tasks: Tasks
    away: bool = False

    @property
    def words(self) -> str:
        """A description."""
        on = "on a GPU" if self.backend == "cuda" else "on the CPU"
        return f"{self.name}, {self.jobs} at a time, {on}, {counted(self.threads, 'thread')} each"


@contextmanager
def open_machine(options: Options, backend: Backend) -> Iterator[Machine]:
    """The machine to run on, for a plan's backend, while the block runs."""
    require("torch", "gsplat", "pandas")
    if options.executor == "local":
        yield _local_machine(options.jobs, backend)
        return
    from splatseed.runtime.ray_tasks import RayTasks, ray_cluster  # noqa: PLC0415  (an extra)

    with ray_cluster(options.address):
        tasks = RayTasks(gpu=None if backend == "auto" else backend == "cuda", jobs=options.jobs)
        on_gpu: Backend = "cuda" if tasks.gpu else "cpu"
        yield Machine("Ray", on_gpu, tasks.jobs, tasks.threads, tasks, away=True)


def _local_machine(jobs: int | None, backend: Backend) -> Machine:
    chosen: Backend = "cpu"
    driver = which("nvidia-smi") or which("rocminfo") or Path("/proc/driver/nvidia").exists()
    if backend == "cuda" or (backend == "auto" and driver):  # else PyTorch sees no GPU
        from splatseed.train.device import pick_device  # noqa: PLC0415  (PyTorch, which takes seconds)

        with stage_display() as clock:  # gsplat's kernels are built here, not by each run
            chosen = "cuda" if pick_device(backend, clock).type == "cuda" else "cpu"
    gpus = [""]
    if chosen == "cuda":
        import torch  # noqa: PLC0415  (takes a while)

        named = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
        gpus = named or [f"{i}" for i in range(torch.cuda.device_count())]
    jobs = jobs or len(gpus)
    threads = max(1, cores() // jobs)
    slots = [slot_environment(threads, gpus[slot % len(gpus)]) for slot in range(jobs)]
    return Machine("this machine", chosen, jobs, threads, ProcessTasks(slots, fresh=True))


def check_machine(machine: Machine, seeds: int) -> None:
    """Refuse runs of so many seeds that do not fit into this machine, rather than have them killed.

    The memory of a cluster's nodes is unknown.
    """
    if not machine.away and machine.backend == "cpu":
        check_memory(
            seeds,
            BYTES_EACH * machine.jobs,
            f"seeds per run with {machine.jobs} at a time",
            fix="Pass smaller --ratios or --budgets, or fewer --jobs.",
        )


def _prepare(
    options: Options, plan: Plan, missing: Sequence[str], machine: Machine, demo: Path | None
) -> tuple[Plan, list[SceneFacts], list[RunSpec], list[str]]:
    """Check all scenes of a plan: the plan of those that can be used, these, its runs, and notes.

    ``demo`` is where to put a synthetic scene; None to use its known facts without making it.
    """
    notes = [f"not there: {', '.join(missing)}"] if missing else []
    present: list[tuple[PlannedScene, SceneFacts]] = []
    needs = {"with_depth": DEPTH in plan.methods, "with_cloud": any(map(needs_cloud, plan.methods))}
    with stage_display() as clock:
        for scene in plan.scenes:
            try:
                present.append((scene, survey(scene, demo=demo, **needs, progress=clock)))
            except SceneNotFoundError as error:
                if options.preset in {None, "quick"}:
                    raise
                notes.append(f"{scene.label} is left out: {error}")
    if not present:
        fix = "Name the folder that holds the preset's scenes with --data."
        raise SceneNotFoundError("scenes to run", found=f"none; {'; '.join(notes)}", fix=fix)
    plan = replace(plan, scenes=tuple(scene for scene, _ in present))
    scenes = [facts for _, facts in present]
    specs = plan_runs(plan, scenes, machine.backend, package_version("splatseed"))
    notes += _notes(plan, scenes, specs)
    if not specs:
        raise ParameterError(
            "a plan with runs",
            found="; ".join(notes) or "none",
            fix="Name other methods, or what these need.",
        )
    check_machine(machine, int(max(spec.gaussians[0] for spec in specs)))
    return plan, scenes, specs, notes


def _notes(plan: Plan, scenes: Sequence[SceneFacts], specs: Sequence[RunSpec]) -> Iterator[str]:
    for scene in scenes:
        yield from (f"{scene.name}: {warning}" for warning in scene.warnings)
    bare = ", ".join(scene.name for scene in scenes if not scene.depth_digest)
    if DEPTH in plan.methods and bare:
        yield f"without depth maps, and so without the method depth: {bare} (--depth DIR)"
    unscanned = ", ".join(scene.name for scene in scenes if not scene.cloud_digest)
    scans = any(map(needs_cloud, plan.methods))
    if scans and unscanned:
        yield f"without a scan, and so without the methods that need one: {unscanned} (--clouds)"
    if not scans and any(scene.cloud for scene in plan.scenes):
        yield "No method needs the scans: name cloud or cloud+auto among --methods."
    if SFM not in plan.methods:
        yield "Without sfm among the methods there is nothing to compare with."
    most = {(s.scene.name, s.arm.budget): (s.most_seeds, s.scene.num_points) for s in specs}
    for (name, budget), (number, there) in most.items():
        if number is not None and number <= there and set(plan.methods) != {SFM}:
            yield (
                f"{name}: under {budget} a run begins with {number:,} seeds at most, and it has "
                f"{there:,} points: auto and the methods that interpolate add none."
            )


def _job_options(plan: Plan) -> JobOptions:
    """Options of all runs: LPIPS is measured wherever its weights are available.

    If LPIPS is requested, missing weights are reported now rather than in every run.
    """
    from splatseed.splat.metrics import load_lpips, lpips_is_here  # noqa: PLC0415  (PyTorch)

    if plan.lpips:
        load_lpips()
    return JobOptions(keep_models=plan.keep_models, lpips=lpips_is_here())


def _bench(
    options: Options, plan: Plan, missing: Sequence[str], machine: Machine, arguments: Sequence[str]
) -> None:
    """Run a plan; or print it as TOML with all else in comments, so that both can be saved."""
    bench = options.output
    demo = bench / "scenes" / "demo" if bench else None
    if bench is None or options.dry_run:
        if plan.lpips:
            _job_options(plan)  # refuses now what a run would
        demo = demo if demo and demo.is_dir() else None
        plan, _, specs, notes = _prepare(options, plan, missing, machine, demo)
        runs = [read_run(bench, spec) if bench else Run(spec) for spec in specs]
        told = [*notes, *_announcement(plan, runs, machine)]
        comments = "".join(f"# {' '.join(line.split())}\n" for line in told)
        OUT.print(f"{plan_text(plan)}\n{comments}", end="", soft_wrap=True)
        return
    check_bench_folder(bench, "bench", [Path(s.path) for s in plan.scenes if not s.is_demo])
    job_options = _job_options(plan)
    plan, scenes, specs, notes = _prepare(options, plan, missing, machine, demo)
    begin(bench, "bench", specs, arguments)
    with atomic_file(bench / PLAN) as partial:  # names that are no text are escaped
        partial.write_text(plan_text(plan), "utf-8", "backslashreplace")
    runs = [read_run(bench, spec) for spec in specs]
    for note in notes:
        print_note(note)
    named = ", ".join(f"{visible(s.name)} ({s.num_points:,} points)" for s in scenes)
    told = [*_announcement(plan, runs, machine), visible(bench)]
    OUT.print("\n  -> ".join([named, *told]), soft_wrap=True)
    ended = carry_out(bench, runs, machine, job_options)
    runs = [read_run(bench, spec) for spec in specs]
    _print_summary(bench, runs)
    if not ended:
        sys.exit(exit_code())
    if any(run.error for run in runs):
        sys.exit(_SOME_FAILED)


def _announcement(plan: Plan, runs: Sequence[Run], machine: Machine) -> Iterator[str]:
    """What will be done, and hours and disk for the remaining runs."""
    yield f"{counts(runs)}; {machine.words}"
    left = [run.spec for run in runs if run.result is None]
    if left:
        measured = len(runs) - len(left)
        by = f"by {counted(measured, 'finished run')}" if measured else "by a rule of thumb"
        time_left = estimate(left, runs, machine.threads) / min(machine.jobs, len(left))
        disk = 0.0
        for spec in left:
            disk += 60e3 + 18 * spec.scene.pixels_at(spec.training.data_factor)  # three pictures
            disk += 236 * spec.gaussians[1] * plan.keep_models
        yield f"about {spoken_time(time_left)} ({by}), {disk / 1e6:,.1f} MB kept"


def carry_out(bench: Path, runs: Sequence[Run], machine: Machine, options: JobOptions) -> bool:
    """Carry out the unfinished ones among some runs; whether all ended, else the user stopped."""
    left = [run.spec for run in runs if run.result is None]
    if not left:
        return True
    display = _Display(left, len(runs))
    ended = do_runs(bench, left, machine.tasks, options, machine.away, display.report)
    try:
        with display.bar:
            for run in ended:
                display.ended(run)
    except KeyboardInterrupt:
        ERR.print("stopped: runs under way start anew next time")
        return False
    return True


class _Display:
    """The progress of runs: bars where stderr is a terminal, and a line per run that ended."""

    def __init__(self, specs: Sequence[RunSpec], total: int) -> None:
        self._specs, self._tasks = specs, dict[str, TaskID]()
        self._total, self._ended = total, total - len(specs)
        columns = (BarColumn(20), TextColumn("{task.description}", markup=False))
        # What goes into a file on stdout must not end up on the terminal.
        shared = sys.stdout.isatty()
        self.bar = Bar(*columns, TimeRemainingColumn(), console=ERR, transient=True,
                       redirect_stdout=shared, disable=not ERR.is_terminal)  # fmt: skip
        self._whole = self.bar.add_task("runs", total=total, completed=self._ended)

    def report(self, index: int, stage: str, fraction: float) -> None:
        spec = self._specs[index]
        label = f"  {_describe(spec)}: {stage}"
        if spec.key not in self._tasks:
            self._tasks[spec.key] = self.bar.add_task(label, total=1.0)
        self.bar.update(self._tasks[spec.key], completed=fraction, description=label)

    def ended(self, run: Run) -> None:
        if (task := self._tasks.pop(run.spec.key, None)) is not None:
            self.bar.remove_task(task)
        self._ended += 1
        said = f" failed: {run.error}"
        if run.result:
            count, seconds = run.result.num_gaussians, run.result.wall_seconds
            said = f": {run.result.psnr:.2f} dB, {count:,} Gaussians, {seconds:.0f} s"
        number = f"[{self._ended}/{self._total}]"
        OUT.print(f"{number} {_describe(run.spec)}{said}", soft_wrap=True)
        self.bar.advance(self._whole)


def _describe(spec: RunSpec) -> str:
    budget = f", {spec.arm.budget}" if spec.arm.budget else ""
    arm = f"{spec.arm.label}, {spec.arm.strategy}{budget}"
    return f"{visible(spec.scene.name)}, {arm}, repeat {spec.repeat + 1}"


def spoken_time(seconds: float) -> str:
    """A duration in words, as roughly as an estimate deserves."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _print_summary(bench: Path, runs: Sequence[Run]) -> None:
    from splatseed.bench.study import studies  # noqa: PLC0415  (pandas, which takes a while)
    from splatseed.bench.study_tables import arm_table  # noqa: PLC0415  (pandas)

    for study in studies(runs):
        _print_table(arm_table(study))
    failed = [run for run in runs if run.error]
    if failed:
        shown = [(_describe(run.spec), run.error) for run in failed[:_FAILURES_SHOWN]]
        print_pairs(f"failed: {len(failed)}", shown)
        print_note(f"Errors in full: {bench / 'runs' / failed[0].spec.key / 'error.json'}")
    left = sum(run.result is None for run in runs)
    again = [(f"the other {counted(left, 'run')}", f"splatseed bench -o {quoted(bench)}")]
    report = ("tables and pictures", f"splatseed bench report {quoted(bench)}")
    print_pairs("next", [*(again if left else []), report])


def _report(arguments: list[str]) -> None:
    options = parse_options(ReportOptions, "bench report", arguments)
    require("pandas", "jinja2")
    from splatseed.bench.report import write_report  # noqa: PLC0415  (pandas, an extra)

    with stage_display() as clock:
        clock("read", 0.0)
        report = write_report(options.bench, clock)
    for sentence in report.summary:
        OUT.print(sentence)
    for note in report.notes:
        print_note(note)
    kinds = f"{report.tables}, each as .csv, .md, .tex and .html, in {options.bench / 'tables'}"
    figures = f"{report.figures} in {options.bench / 'figures'}"
    rows = [("report", str(report.path)), ("tables", kinds), ("figures", figures)]
    print_pairs(str(options.bench), rows)
    print_pairs("next", [("", f"open {quoted(report.path)} in a browser")])


def _compare(arguments: list[str]) -> None:
    options = parse_options(CompareOptions, "bench compare", arguments)
    require("pandas")
    from splatseed.bench.comparisons import compare  # noqa: PLC0415  (pandas, an extra)
    from splatseed.bench.study_tables import comparison_tables  # noqa: PLC0415  (pandas)
    from splatseed.bench.tables import write_table  # noqa: PLC0415  (pandas)

    written: Any = {"kind": "bench compare", "protect": (options.a, options.b)}
    if options.output is not None:
        check_output(options.output, **written)
    comparison = compare(read_runs(options.a), read_runs(options.b))
    if comparison is None:
        raise SceneNotFoundError(
            f"finished runs in both {options.a} and {options.b}",
            found="none in one of them",
            fix="Let splatseed bench finish some.",
        )
    tables = comparison_tables(comparison)
    for table in tables:
        if table.rows:
            _print_table(table)
    for note in comparison.notes:
        print_note(note)
    if options.output is not None:
        with output_folder(options.output, **written) as partial:
            for table in tables:
                write_table(table, partial)
        print_pairs("written", [("tables", str(options.output))])


def _print_table(table: Table) -> None:
    print_table(table.title, table.header, table.shown().to_numpy().tolist())
    for note in table.notes:
        OUT.print(note, style="dim")
