"""``splatseed bench``: does upsampling help on these scenes, by which method, at what cost?"""

from __future__ import annotations

import logging
import sys
import tomllib
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.progress import BarColumn, Progress as Bar, TaskID, TextColumn, TimeRemainingColumn

from splatseed.bench.job import Machine, RunOptions, execute_runs, local_machine, ray_machine
from splatseed.bench.plan import (
    CLOUD,
    DEPTH,
    SFM,
    Plan,
    RunSpec,
    fair_budget,
    needs_cloud,
    plan_runs,
)
from splatseed.bench.plan_file import PLAN, plan_text, read_plan
from splatseed.bench.runs import (
    ERROR,
    BenchRun,
    changed_code,
    check_bench_folder,
    count_runs,
    estimate_seconds,
    read_run,
    record_plan,
    run_folder,
)
from splatseed.bench.scenes import PlannedScene, SceneFacts, survey
from splatseed.commands.options import check_minimum, parse_options, refuse
from splatseed.console import (
    ERR,
    OUT,
    add_results,
    print_message,
    print_next,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.exclusion import read_patterns
from splatseed.io.staging import atomic_file
from splatseed.methods import Profile
from splatseed.requirements import require
from splatseed.runtime.interruption import exit_code
from splatseed.runtime.memory import check_memory
from splatseed.text import counted, did_you_mean, format_duration, name_some, quoted, visible
from splatseed.training.request import ExcludeChoice
from splatseed.training.settings import BYTES_PER_GAUSSIAN, Backend, StrategyName

if TYPE_CHECKING:
    from splatseed.bench.tables import Table

_SOME_FAILED = 1
_FAILURES_SHOWN = 5
_DEFAULT = Plan()


def _list(alias: str, values: Sequence[object]) -> Any:
    """A list, under the name that other verbs have for one value, too.

    It is empty if the option is not given; the help shows the actual default.
    """
    hint = f"(default: {' '.join(map(str, values))})"
    return tyro.conf.arg(aliases=[alias], help_behavior_hint=hint)


@dataclass(frozen=True)
class Options:
    """Train from the seeds of several methods, with repeats, and compare the results.

    Stop it at any time; the same command or ``splatseed bench -o BENCH`` resumes. ``splatseed bench
    report BENCH`` writes a report. A plan file (--dry-run prints one) has further settings:
    training, scene names, method parameters.
    """

    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="DIR")] = None
    """The benchmark's folder: a new one, or one to resume."""
    scenes: tuple[str, ...] = ()
    """Scene folders with photographs; demo: is a synthetic room. With --data: names of scenes."""
    methods: Annotated[tuple[str, ...], _list("--method", _DEFAULT.methods)] = ()
    """Seeding methods; sfm, the original points, is the baseline; FILE.py:NAME is your own."""
    ratios: Annotated[tuple[float, ...], _list("--ratio", [f"{r:g}" for r in _DEFAULT.ratios])] = ()
    """Total points per original point."""
    budgets: Annotated[tuple[str, ...], _list("--budget", [fair_budget(_DEFAULT.ratios)])] = ()
    """Maximum final Gaussians, equal for all arms: 50k, 0.25rho for 0.25 per photograph pixel at
    training size, 12x for 12 per point, or none. Methods fill a budget that is given, unless
    --ratios are given. The default is none for profile paper, and grows with the ratios."""
    strategies: Annotated[tuple[StrategyName, ...], _list("--strategy", _DEFAULT.strategies)] = ()
    """Densification strategies; -3dgs keeps the rates and schedules of 3DGS."""
    profiles: Annotated[tuple[Profile, ...], _list("--profile", _DEFAULT.profiles)] = ()
    """Parameter sets of the methods: improved (default), or as in the paper."""
    repeats: int | None = None
    """Number of repeats (3), with different random seeds; error bars need at least 2."""
    max_steps: int | None = None
    """Training steps (30000); schedules scale with them."""
    data_factor: int | None = None
    """Downsample the photographs by this whole factor; by default, per scene, by the smallest that
    leaves at most 1600 pixels on the longer side."""
    long_side: int | None = None
    """Maximum longer side of the photographs in pixels; sets a whole --data-factor per scene."""
    depth: tuple[Path, ...] = ()
    """Depth maps for method depth: a folder per scene, or one folder with a subfolder for each; by
    default those of the scene."""
    clouds: tuple[Path, ...] = ()
    """Scans for cloud and cloud+auto: a file per scene, in its frame (docs/scans.md)."""
    exclude: ExcludeChoice = ()
    """Leave out photographs of a single scene: a name, a pattern such as 'IMG_00*', or a .txt file
    with one per line; a plan has them for each scene."""
    plan: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """A plan file, as --dry-run prints; options override it."""
    data: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """The folder of the scenes of a plan; missing scenes are skipped."""
    dry_run: bool = False
    """Print the plan, the number of runs, and estimates of time and disk; run nothing."""
    executor: Literal["local", "ray"] = "local"
    """Processes on this machine, or a Ray cluster (extra cluster)."""
    address: str | None = None
    """The cluster's address, or auto on its head node; by default Ray starts on this machine."""
    jobs: int | None = None
    """Runs at a time: by default one per GPU, or 1; on Ray as many as fit."""


@dataclass(frozen=True)
class ReportOptions:
    """Write report.html, tables and figures from the finished runs of a benchmark."""

    bench: Annotated[Path, tyro.conf.Positional]
    """The benchmark's folder."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    if arguments and arguments[0] == "report":
        _report(arguments[1:])
        return
    if arguments and not arguments[0].startswith("-"):
        fix = f"{did_you_mean(arguments[0], ['report'])}Name scenes by --scenes, a plan by --plan."
        expected = "report after splatseed bench, or options"
        raise ParameterError(expected, found=repr(arguments[0]), fix=fix)
    options, plan = parse_plan(arguments)
    with open_machine(options, plan.training.backend) as machine:
        _bench(options, plan, machine, arguments)


def parse_plan(arguments: Sequence[str]) -> tuple[Options, Plan]:
    """Parse options, and apply them to a plan.

    The plan is that of the file, of the folder to resume, or the default one.
    """
    options = parse_options(Options, "bench", arguments)
    check_minimum(options, 1, "jobs", "repeats", "long_side", "max_steps", "data_factor")
    output = options.output
    refuse(
        (not (output or options.dry_run), "-o BENCH, the folder of the benchmark", "none",
         "Name a folder, or pass --dry-run."),
        (options.data and not options.plan, "--plan with --data", "none", "Name the plan."),
        (options.address and options.executor != "ray", "--executor ray with --address", "local",
         "Add --executor ray."),
    )  # fmt: skip
    plan = _DEFAULT
    if options.plan is not None:
        plan = read_plan(options.plan, options.data)
    elif output and not options.scenes and (output / PLAN).is_file():
        plan = read_plan(output / PLAN)
    plan = _changed(plan, options)
    fix = "splatseed bench --scenes demo: --max-steps 500 -o BENCH tries it on a synthetic room."
    refuse((not plan.scenes, "--scenes DIR... or --plan", "neither", fix))
    return options, plan


def _changed(plan: Plan, options: Options) -> Plan:
    def given(*names: str) -> dict[str, Any]:
        return {n: value for n in names if (value := getattr(options, n)) not in (None, ())}

    training = replace(plan.training, **given("max_steps", "data_factor"))
    changes = given("methods", "budgets", "strategies", "profiles", "repeats", "long_side")
    no_budget = [text.lower() for text in options.budgets] == ["none"]
    if no_budget:
        changes["budgets"] = ()
    if options.ratios or (options.budgets and not plan.budgets and not no_budget):
        changes["ratios"] = options.ratios
    if plan is _DEFAULT and not options.budgets and "paper" not in options.profiles:
        changes["budgets"] = (fair_budget(changes.get("ratios", plan.ratios)),)
    scenes = _without_excluded(_scenes(plan, options), options.exclude)
    labels = Counter(scene.label for scene in scenes)
    for i, scene in enumerate(scenes):  # prefix equal folder names with their parents'
        if labels[scene.label] > 1 and not scene.is_demo and not scene.name:
            scenes[i] = replace(scene, name="_".join(scene.root.parts[-2:]))
    depth = [str(folder) for folder in options.depth]
    if len(depth) == 1 and any(Path(depth[0], scene.label).is_dir() for scene in scenes):
        below = [Path(depth[0], scene.label) for scene in scenes]
        depth = [str(folder) if folder.is_dir() else "" for folder in below]
    for option, what, files in (("--depth", "depth", depth), ("--clouds", "cloud", options.clouds)):
        expected = f"{option} with a path for each of {len(scenes)} scenes"
        fix = "--dry-run prints their order; a plan file may give paths for some scenes only."
        refuse((len(files) not in {0, len(scenes)}, expected, len(files), fix))
        if files:
            named: list[dict[str, Any]] = [{what: str(file)} for file in files]
            scenes = [replace(each, **one) for each, one in zip(scenes, named, strict=True)]
    return replace(plan, training=training, scenes=tuple(scenes), **changes)


def _without_excluded(scenes: list[PlannedScene], patterns: Sequence[str]) -> list[PlannedScene]:
    if not patterns:
        return scenes
    fix = "A plan has a key exclude for each scene."
    refuse((len(scenes) != 1, "--exclude with one scene", len(scenes), fix))
    return [replace(scenes[0], exclude=tuple(each for each, _ in read_patterns(patterns)))]


def _scenes(plan: Plan, options: Options) -> list[PlannedScene]:
    if not (options.data and options.scenes):
        return [PlannedScene(path) for path in options.scenes] or list(plan.scenes)
    own = {scene.label: scene for scene in plan.scenes}
    known = f"--scenes among {', '.join(own)}"
    for name in options.scenes:
        refuse((name not in own, known, name, f"{did_you_mean(name, own)}See docs/bench.md."))
    return [own[name] for name in options.scenes]


@contextmanager
def open_machine(options: Options, backend: Backend) -> Iterator[Machine]:
    """Open the workers for a backend."""
    require("torch", "gsplat", "flip_evaluator", "pandas", *["ray"] * (options.executor == "ray"))
    if options.executor == "ray":
        with ray_machine(options.address, options.jobs, backend) as machine:
            yield machine
        return
    with stage_display() as clock:
        machine = local_machine(options.jobs, backend, clock)
    yield machine


def _prepare(
    options: Options, plan: Plan, machine: Machine, demo: Path | None
) -> tuple[Plan, list[SceneFacts], list[RunSpec], list[Finding]]:
    """Survey the scenes of a plan; returns the plan of those present, these, its runs, findings.

    With ``--data``, scenes may be missing. ``demo`` is the folder of the synthetic scene; None to
    use its known facts.
    """
    missing, of_scenes = list[Finding](), list[Finding]()
    present = list[tuple[PlannedScene, SceneFacts]]()
    needs = {"with_depth": DEPTH in plan.methods, "with_cloud": any(map(needs_cloud, plan.methods))}
    columns = plan.parameters.get(CLOUD, {}).get("columns", ())
    with stage_display() as clock:
        for scene in plan.scenes:
            noted = list[Finding]()
            try:
                facts = survey(
                    scene, demo=demo, **needs, columns=columns, progress=clock, note=noted.append
                )
            except SceneNotFoundError as error:
                if options.data is None:
                    raise
                text = f"{scene.label} is skipped: {error}"
                missing.append(Finding("missing-scene", text, subjects=(scene.label,)))
                continue
            present.append((scene, facts))
            of_scenes += [replace(each, text=f"{facts.name}: {each.text}") for each in noted]
    if not present:
        expected = f"scenes of {options.plan} in {options.data}"
        found = f"none of {', '.join(scene.label for scene in plan.scenes)}"
        raise SceneNotFoundError(expected, found=found, fix="Name the folder that holds them.")
    plan = replace(plan, scenes=tuple(scene for scene, _ in present))
    scenes = [facts for _, facts in present]
    specs = plan_runs(plan, scenes, machine.backend)
    findings = [*missing, *_budget_findings(options, plan), *of_scenes]
    findings += [*_data_findings(plan, scenes), *_full_budgets(plan, specs)]
    findings += changed_code(options.output, specs) if options.output else ()
    fix = "Name other methods, or what these need."
    refuse((not specs, "a plan with runs", "; ".join(map(str, findings)) or "none", fix))
    # The memory of a cluster's nodes is unknown.
    if machine.backend == "cpu" and not machine.remote:
        num_seeds, jobs = int(max(spec.gaussians[0] for spec in specs)), machine.jobs
        fix = "Pass smaller --ratios or --budgets, or fewer --jobs."
        check_memory(
            num_seeds, BYTES_PER_GAUSSIAN * jobs, f"seeds per run with {jobs} at a time", fix=fix
        )
    return plan, scenes, specs, findings


def _budget_findings(options: Options, plan: Plan) -> Iterator[Finding]:
    if options.budgets and plan.budgets and not plan.ratios:
        text = "Methods fill the budget: --ratios 8 makes 8 times the points instead."
        yield Finding("budget", text, "info")
    if plan.budgets == (fair_budget(plan.ratios),) and not options.budgets:
        text = (
            "All arms have the same limit of Gaussians, since more of them alone raise PSNR: "
            "--budgets none lifts it, and --profiles paper has none."
        )
        yield Finding("budget", text, "info")


def _data_findings(plan: Plan, scenes: Sequence[SceneFacts]) -> Iterator[Finding]:
    """Find methods without their data, data without a method, and a plan without a baseline."""
    without_depth = tuple(scene.name for scene in scenes if not scene.depth_digest)
    if DEPTH in plan.methods and without_depth:
        names = ", ".join(without_depth)
        text = f"no depth maps, so method depth is skipped: {names} (--depth DIR)"
        yield Finding("missing-depth-maps", text, subjects=without_depth)
    without_scan = tuple(scene.name for scene in scenes if not scene.cloud_digest)
    scans = any(map(needs_cloud, plan.methods))
    if scans and without_scan:
        names = ", ".join(without_scan)
        text = f"no scan, so methods that need one are skipped: {names} (--clouds)"
        yield Finding("missing-scan", text, subjects=without_scan)
    if not scans and any(scene.cloud for scene in plan.scenes):
        text = "No method uses the scans: add cloud or cloud+auto to --methods."
        yield Finding("unused-scan", text)
    if SFM not in plan.methods:
        text = "Without sfm among the methods there is no baseline."
        yield Finding("missing-baseline", text)


def _full_budgets(plan: Plan, specs: Sequence[RunSpec]) -> Iterator[Finding]:
    """Find scenes whose points fill a budget before any method adds one."""
    full = defaultdict[tuple[str, str, int, int], dict[str, None]](dict)
    for spec in specs:
        if spec.max_seeds is not None and spec.max_seeds <= spec.scene.num_points:
            key = spec.scene.name, spec.arm.budget, spec.max_seeds, spec.scene.num_points
            full[key][spec.arm.strategy] = None
    if set(plan.methods) == {SFM}:
        return
    for (name, budget, limit, num_points), strategies in full.items():
        text = (
            f"{name}: under {budget}, runs with {', '.join(strategies)} start from at most "
            f"{limit:,} seeds, and it has {num_points:,} points: auto and the methods that "
            "interpolate add none."
        )
        yield Finding("full-budget", text, subjects=(name,))


def _bench(options: Options, plan: Plan, machine: Machine, arguments: Sequence[str]) -> None:
    """Run a plan; or print it as TOML, with everything else in comments."""
    bench = options.output
    demo = bench / "scenes" / "demo" if bench else None
    if bench is not None and not options.dry_run:
        check_bench_folder(bench, [Path(s.path) for s in plan.scenes if not s.is_demo])
    if plan.lpips:
        from splatseed.splat.lpips import load_lpips

        load_lpips()  # fails now rather than in every run
    if bench is None or options.dry_run:
        demo = demo if demo and demo.is_dir() else None
        plan, _, specs, findings = _prepare(options, plan, machine, demo)
        runs = [read_run(bench, spec) if bench else BenchRun(spec) for spec in specs]
        lines = [*map(str, findings), *_announcement(plan, runs, machine)]
        add_results(plan=tomllib.loads(plan_text(plan)), num_runs=len(runs), notes=lines)
        comments = "".join(f"# {' '.join(line.split())}\n" for line in lines)
        OUT.print(f"{plan_text(plan)}\n{comments}", end="", soft_wrap=True)
        return
    from splatseed.splat.lpips import has_lpips_weights

    plan, scenes, specs, findings = _prepare(options, plan, machine, demo)
    record_plan(bench, "bench", specs, arguments)
    with atomic_file(bench / PLAN) as partial:  # escapes file names that are no text
        partial.write_text(plan_text(plan), "utf-8", "backslashreplace")
    runs = [read_run(bench, spec) for spec in specs]
    print_note(*findings)
    names = ", ".join(f"{visible(s.name)} ({s.num_points:,} points)" for s in scenes)
    lines = [names, *_announcement(plan, runs, machine), visible(bench)]
    print_message("\n  -> ".join(lines))
    completed = execute(bench, runs, machine, RunOptions(plan.keep_models, has_lpips_weights()))
    runs = [read_run(bench, spec) for spec in specs]
    _print_summary(bench, runs)
    if not completed:
        sys.exit(exit_code())
    if any(run.error for run in runs):
        sys.exit(_SOME_FAILED)


def _announcement(plan: Plan, runs: Sequence[BenchRun], machine: Machine) -> Iterator[str]:
    yield f"{count_runs(runs)}; {machine.description}"
    specs = (run.spec for run in runs if run.spec.arm.budget)
    limits = dict.fromkeys((spec.scene.name, spec.training.cap_max) for spec in specs)
    if limits:
        yield f"at most {name_some([f'{cap:,} Gaussians on {name}' for name, cap in limits])}"
    pending = [run.spec for run in runs if run.result is None]
    if pending:
        measured = len(runs) - len(pending)
        by = f"from {counted(measured, 'finished run')}" if measured else "a rough estimate"
        total = estimate_seconds(pending, runs, machine.threads)
        remaining = total / min(machine.jobs, len(pending))
        disk = 0.0
        for spec in pending:
            disk += 60e3 + 6 * spec.scene.pixels_at(spec.training.factor)  # a picture
            disk += 236 * spec.gaussians[1] * plan.keep_models
        yield f"about {format_duration(remaining)} ({by}), {disk / 1e6:,.1f} MB of results"


def execute(bench: Path, runs: Sequence[BenchRun], machine: Machine, options: RunOptions) -> bool:
    """Carry out the pending runs; returns False if the user stopped them.

    Prints a line per run, and shows bars if stderr is a terminal.
    """
    pending, tasks = [run.spec for run in runs if run.result is None], dict[str, TaskID]()
    columns = (BarColumn(20), TextColumn("{task.description}", markup=False), TimeRemainingColumn())
    # Output that goes to a file must not be redirected to the terminal.
    bar = Bar(*columns, console=ERR, transient=True, redirect_stdout=sys.stdout.isatty(),
              disable=not ERR.is_terminal)  # fmt: skip
    before = len(runs) - len(pending)
    overall = bar.add_task("runs", total=len(runs), completed=before)

    def report(index: int, stage: str, fraction: float) -> None:
        key, label = pending[index].key, f"  {_describe(pending[index])}: {stage}"
        if key not in tasks:
            tasks[key] = bar.add_task(label, total=1.0)
        bar.update(tasks[key], completed=fraction, description=label)

    ended = execute_runs(bench, pending, machine, options, report)
    try:
        with bar:
            for number, run in enumerate(ended, start=before + 1):
                if run.spec.key in tasks:
                    bar.remove_task(tasks.pop(run.spec.key))
                outcome = f" failed: {run.error}"
                if run.result:
                    count, seconds = run.result.num_gaussians, run.result.wall_seconds
                    outcome = f": {run.result.psnr:.2f} dB, {count:,} Gaussians, {seconds:.0f} s"
                print_message(f"[{number}/{len(runs)}] {_describe(run.spec)}{outcome}")
                bar.advance(overall)
    except KeyboardInterrupt:
        print_message("stopped: interrupted runs start anew next time", logging.WARNING)
        return False
    return True


def _describe(spec: RunSpec) -> str:
    budget = f", {spec.arm.budget}" if spec.arm.budget else ""
    arm = f"{spec.arm.label}, {spec.arm.strategy}{budget}"
    return f"{visible(spec.scene.name)}, {arm}, repeat {spec.repeat + 1}"


def _print_summary(bench: Path, runs: Sequence[BenchRun]) -> None:
    from splatseed.bench.study import studies
    from splatseed.bench.study_tables import arm_table

    tables = [arm_table(study) for study in studies(runs)]
    for table in tables:
        _print_table(table)
    shown = [{"title": t.title, "header": t.header, "rows": t.shown().to_numpy()} for t in tables]
    add_results(output=bench, runs=[_facts(bench, run) for run in runs], tables=shown)
    print_failures(bench, runs)
    pending = sum(run.result is None for run in runs)
    resume = [(f"the other {counted(pending, 'run')}", f"splatseed bench -o {quoted(bench)}")]
    report = ("tables and pictures", f"splatseed bench report {quoted(bench)}")
    print_next([*(resume if pending else []), report])


def _facts(bench: Path, run: BenchRun) -> dict[str, object]:
    """Return what ``--json`` prints of a run; its folder has the rest."""
    spec, result = run.spec, run.result
    facts = {"scene": spec.scene.name, **asdict(spec.arm), "repeat": spec.repeat}
    facts |= {"folder": run_folder(bench, spec), "error": run.error or None}
    names = ("psnr", "num_seeds", "num_gaussians", "seconds")
    return {**facts, **{name: getattr(result, name, None) for name in names}}


def print_failures(bench: Path, runs: Sequence[BenchRun]) -> None:
    """Print the errors of failed runs."""
    failed = [run for run in runs if run.error]
    if failed:
        shown = [(_describe(run.spec), run.error) for run in failed[:_FAILURES_SHOWN]]
        print_pairs(f"failed: {len(failed)}", shown)
        path = run_folder(bench, failed[0].spec) / ERROR
        print_note(Finding("failed-runs", f"Full errors: {path}", "error", subjects=(str(path),)))


def _report(arguments: list[str]) -> None:
    options = parse_options(ReportOptions, "bench report", arguments)
    require("pandas", "jinja2")
    from splatseed.bench.report import write_report

    with stage_display() as clock:
        clock("read", 0.0)
        report = write_report(options.bench, clock)
    for sentence in report.summary:
        OUT.print(sentence)
    print_note(*report.findings)
    kinds = f"{report.tables}, each as .csv and .html, in {options.bench / 'tables'}"
    figures = f"{report.figures} in {options.bench / 'figures'}"
    rows = [("report", str(report.path)), ("tables", kinds), ("figures", figures)]
    print_pairs(str(options.bench), rows)
    add_results(report=report.path, summary=report.summary)
    print_next([("", f"open {quoted(report.path)} in a browser")])


def _print_table(table: Table) -> None:
    print_table(table.title, table.header, table.shown().to_numpy().tolist())
    for note in table.notes:
        OUT.print(note, style="dim")
