"""``splatseed bench``: does upsampling help on these scenes, by which method, at what cost?"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from splatseed.bench.planning.estimate import Estimator
from splatseed.bench.planning.plan import Plan
from splatseed.bench.planning.plan_file import plan_text
from splatseed.bench.planning.records import RunRow, RunSpec
from splatseed.bench.running.environment import describe_environment
from splatseed.bench.running.folder import PLAN, check_bench_folder, make_bench_folder
from splatseed.bench.running.job import JobOptions
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.commands.bench.display import run_display, spoken_time
from splatseed.commands.bench.machine import Machine, check_machine, open_machine
from splatseed.commands.bench.options import Asked, Options, parse_plan
from splatseed.commands.bench.prepare import Prepared, prepare
from splatseed.commands.bench.summary import print_summary
from splatseed.console import OUT, print_note, stage_display
from splatseed.errors import MissingDependencyError, ParameterError, SceneNotFoundError
from splatseed.io.staging import atomic_file
from splatseed.literal import counted, did_you_mean, visible
from splatseed.process.interruption import exit_code

SOME_FAILED = 1
REPORTING = {"report": "run_report", "compare": "run_compare"}


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    if arguments and arguments[0] in REPORTING:
        reporting = import_module("splatseed.commands.bench.report")
        getattr(reporting, REPORTING[arguments[0]])(arguments[1:])
        return
    if arguments and not arguments[0].startswith("-"):
        meant = did_you_mean(arguments[0], REPORTING)
        raise ParameterError(
            f"{' or '.join(REPORTING)} after splatseed bench, or options",
            found=repr(arguments[0]),
            fix=f"{meant}Name scenes with --scenes; see splatseed bench --help.",
        )
    options, asked = parse_plan(arguments)
    if options.dry_run or options.output is None:
        _dry_run(options, asked)
    else:
        _run(options, asked, options.output, arguments)


def _run(options: Options, asked: Asked, bench: Path, arguments: Sequence[str]) -> None:
    check_bench_folder(bench, _folders(asked.plan))
    with open_machine(options, asked.plan.training.backend) as machine:
        job_options = _job_options(asked.plan)
        with stage_display() as clock:
            prepared = prepare(asked, machine.backend, bench / "scenes", clock)
            _check_fits(prepared, machine)
        ledger = _enter(bench, prepared, arguments, retry=options.retry_failed)
        ended = _run_all(bench, prepared, machine, ledger, job_options)
    rows = _rows(ledger, prepared)
    print_summary(bench, rows)
    if not ended:
        sys.exit(exit_code())
    if any(row.status == "failed" for row in rows):
        sys.exit(SOME_FAILED)


def _check_fits(prepared: Prepared, machine: Machine) -> None:
    """Refuse a plan with a run that does not fit into memory, rather than have it killed."""
    estimator = Estimator(prepared.scenes, [], machine.threads)
    check_machine(machine, max(map(estimator.seeds, prepared.runs), default=0))


def _run_all(
    bench: Path, prepared: Prepared, machine: Machine, ledger: Ledger, options: JobOptions
) -> bool:
    """Run everything that is left; returns whether it was completed."""
    rows = _rows(ledger, prepared)
    to_do = [row.spec for row in rows if row.status in {"pending", "running"}]
    estimator = Estimator(prepared.scenes, rows, machine.threads)
    _announce(bench, prepared, machine, rows, estimator)
    if not to_do:
        return True
    expected = estimator.of_all(to_do)
    with run_display(expected, len(rows) - len(to_do), machine.jobs) as display:
        return machine.run(ledger, bench, prepared.keys, options, display)


def _folders(plan: Plan) -> list[Path]:
    """The folders that are read, which the benchmark must lie apart from."""
    return [Path(scene.path) for scene in plan.scenes if not scene.is_demo]


def _job_options(plan: Plan) -> JobOptions:
    """Options of all runs: LPIPS is measured wherever its weights are available.

    If LPIPS is requested, missing weights are reported now rather than in every run.
    """
    from splatseed.splat.metrics import GIVE_PATH, load_lpips  # noqa: PLC0415  (PyTorch)

    try:
        load_lpips()
    except SceneNotFoundError as error:
        if plan.lpips:
            # splatseed bench has no option for their path: its runs are processes of their own.
            fix = error.fix.replace(f", or {GIVE_PATH}", "")
            raise SceneNotFoundError(error.expected, found=error.found, fix=fix) from None
        return JobOptions(keep_models=plan.keep_models)
    except MissingDependencyError:
        if plan.lpips:
            raise
        return JobOptions(keep_models=plan.keep_models)
    return JobOptions(keep_models=plan.keep_models, lpips=True)


def _enter(bench: Path, prepared: Prepared, arguments: Sequence[str], *, retry: bool) -> Ledger:
    """The ledger, with the plan's runs in it."""
    make_bench_folder(bench)
    with atomic_file(bench / PLAN) as partial:
        partial.write_text(plan_text(prepared.plan), "utf-8")
    ledger = Ledger.open(bench / LEDGER)
    ledger.add(prepared.runs)
    ledger.note_session(describe_environment(arguments))
    if retry:
        ledger.retry_failed(prepared.keys)
    return ledger


def _rows(ledger: Ledger, prepared: Prepared) -> list[RunRow]:
    """The rows of the plan's runs; a ledger may have others."""
    return [row for row in ledger.rows() if row.spec.key in prepared.keys]


def _announce(
    bench: Path,
    prepared: Prepared,
    machine: Machine,
    rows: Sequence[RunRow],
    estimator: Estimator,
) -> None:
    """Print what will be done."""
    for note in prepared.notes:
        print_note(note)
    scenes = ", ".join(
        f"{visible(each.name)} ({each.num_points:,} points)" for each in prepared.scenes
    )
    lines = [scenes, f"  -> {_counts(rows)}; {machine.words}"]
    lines += [f"  -> {line}" for line in _estimates(prepared.plan, rows, machine, estimator)]
    OUT.print("\n".join([*lines, f"  -> {visible(bench)}"]), soft_wrap=True)


def _counts(rows: Sequence[RunRow]) -> str:
    """The number of runs, and how many of them are done."""
    done, failed = (sum(row.status == status for row in rows) for status in ("done", "failed"))
    ended = f" ({done} done, {failed} failed, {len(rows) - done - failed} to do)"
    return f"{counted(len(rows), 'run')}{ended if done or failed else ''}"


def _estimates(
    plan: Plan, rows: Sequence[RunRow], machine: Machine, estimator: Estimator
) -> list[str]:
    """Hours and disk for the remaining runs, as sentences."""
    left = [row.spec for row in rows if row.status in {"pending", "running"}]
    if not left:
        return []
    seconds = sum(estimator.of_all(left).values()) / min(machine.jobs, len(left))
    measured = estimator.num_measured
    finished = counted(measured, "finished run")
    by = f"by {finished}" if measured else "by a rough model, until runs are finished"
    return [f"about {spoken_time(seconds)} ({by}), {_disk(plan, left, machine.jobs, estimator)}"]


def _disk(plan: Plan, left: Sequence[RunSpec], jobs: int, estimator: Estimator) -> str:
    kept = sum(estimator.disk(spec, models=plan.keep_models) for spec in left)
    most = jobs * max(estimator.checkpoint(spec) for spec in left)
    return f"{_size(kept)} kept, up to {_size(most)} more on the way"


def _size(count: float) -> str:
    return f"{count / 1e9:,.1f} GB" if count > 1e9 else f"{count / 1e6:,.1f} MB"


def _dry_run(options: Options, asked: Asked) -> None:
    """Print the plan as TOML, with everything else in comments, so that all can be saved as one."""
    with (
        open_machine(options, asked.plan.training.backend) as machine,
        stage_display() as clock,
    ):
        if asked.plan.lpips:
            _job_options(asked.plan)  # refuses now what a run would
        kept = options.output / "scenes" if options.output else None
        scenes = kept if kept and (kept / "demo").is_dir() else None
        prepared = prepare(asked, machine.backend, scenes, clock)
        _check_fits(prepared, machine)
    rows = _rows_if_there(options, prepared)
    estimator = Estimator(prepared.scenes, rows, machine.threads)
    told = [
        *prepared.notes,
        f"{_counts(rows)}; {machine.words}",
        *_estimates(prepared.plan, rows, machine, estimator),
    ]
    comments = "".join(f"# {' '.join(line.split())}\n" for line in told)
    text = f"{plan_text(prepared.plan)}\n{comments}"
    OUT.print(text, end="", soft_wrap=True)


def _rows_if_there(options: Options, prepared: Prepared) -> list[RunRow]:
    """The plan's runs, with their status if the folder has a ledger."""
    known: dict[str, RunRow] = {}
    if options.output is not None and (options.output / LEDGER).is_file():
        ledger = Ledger.open(options.output / LEDGER, read_only=True)
        known = {row.spec.key: row for row in ledger.rows()}
    rows = [known.get(spec.key, RunRow(spec)) for spec in prepared.runs]
    if not options.retry_failed:
        return rows
    return [replace(row, status="pending") if row.status == "failed" else row for row in rows]
