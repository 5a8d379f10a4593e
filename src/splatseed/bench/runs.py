"""Read a benchmark's folder, and record what is planned.

``planned.json`` records the calls of the command and the runs of the last plan. A folder
``runs/KEY`` with a ``result.json`` is a finished run, which is not repeated; with an ``error.json``
it is a failed one.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import socket
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from splatseed.bench.plan import RunResult, RunSpec
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.findings import Finding
from splatseed.io.files import StrPath, read_text
from splatseed.io.staging import MANIFEST, check_output, check_separate, read_manifest, write_json
from splatseed.requirements import version_of
from splatseed.text import counted

RESULT, ERROR = "result.json", "error.json"
_PLANNED = "planned.json"
_OTHER_LAYOUT = (ValueError, KeyError, TypeError, AttributeError)
"""Errors of reading the JSON of another version."""
_PACKAGES = ("splatseed", "torch", "gsplat", "torchmetrics", "numpy", "scipy", "numba", "ray")


@dataclass(frozen=True)
class BenchRun:
    """A run: finished if it has a result, failed if it has an error, else pending."""

    spec: RunSpec
    result: RunResult | None = None
    error: str = ""


def run_folder(bench: Path, spec: RunSpec) -> Path:
    """Return the folder of a run."""
    return bench / "runs" / spec.key


def read_run(bench: Path, spec: RunSpec) -> BenchRun:
    """Read a run from its folder; it is pending if there is none."""
    return _read(run_folder(bench, spec), spec)


def _read(folder: Path, spec: RunSpec | None = None) -> BenchRun:
    """Read a run from a folder, which may be missing only if ``spec`` is given."""
    for name in (RESULT, ERROR):
        with suppress(FileNotFoundError, NotADirectoryError):
            text = read_text(folder / name)
            try:
                content = json.loads(text)
                known = spec or RunSpec.from_dict(content["spec"])
                if name == ERROR:
                    return BenchRun(known, error=str(content["error"]))
                return BenchRun(known, RunResult.from_dict(content["result"]))
            except _OTHER_LAYOUT as error:
                fix = "Remove that folder to repeat its run, or start a new benchmark."
                raise _layout_error(folder / name, error, fix) from None
    assert spec is not None  # noqa: S101  (folders are listed by these files)
    return BenchRun(spec)


def _layout_error(path: Path, error: Exception, fix: str) -> SceneFormatError:
    expected = f"{path} as this version of splatseed writes it"
    return SceneFormatError(
        expected, found=f"another layout ({type(error).__name__}: {error})", fix=fix
    )


def _planned_runs(bench: Path) -> list[RunSpec]:
    try:
        return [RunSpec.from_dict(spec) for spec in _planned(bench)["runs"]]
    except _OTHER_LAYOUT as error:
        fix = "Plan it again with splatseed bench, or start a new one."
        raise _layout_error(bench / _PLANNED, error, fix) from None


def read_runs(bench: StrPath) -> list[BenchRun]:
    """Read the runs of the last plan, in its order, and the finished runs of earlier plans.

    Raises:
        SceneNotFoundError: There is no benchmark.
        SceneFormatError: Another version wrote a file.
    """
    bench = Path(bench)
    kind = read_manifest(bench).get("command")
    if kind != "bench":
        fix = "Name the folder that splatseed bench wrote."
        raise SceneNotFoundError(f"a benchmark at {bench}", found=kind or "none", fix=fix)
    runs = [read_run(bench, spec) for spec in _planned_runs(bench)]
    known = {run_folder(bench, run.spec).name for run in runs}
    # Failed runs of earlier plans are dropped.
    finished = sorted(path.parent for path in bench.glob(f"runs/*/{RESULT}"))
    return [*runs, *(_read(folder) for folder in finished if folder.name not in known)]


def changed_code(bench: Path, planned: Sequence[RunSpec]) -> Iterator[Finding]:
    """Find whether ``planned`` runs repeat finished ones of a benchmark with other code."""
    repeated = dict[tuple[str, str], RunSpec]()
    for spec in planned:
        if not (run_folder(bench, spec) / RESULT).is_file():
            repeated[_without_code(spec)] = spec
    changes, count = defaultdict[str, set[str]](set), set[tuple[str, str]]()
    for path in bench.glob(f"runs/*/{RESULT}"):
        with suppress(SceneFormatError):  # of another version's layout
            old = _read(path.parent).spec
            key = _without_code(old)
            if (new := repeated.get(key)) is not None:
                count.add(key)
                for what, before, now in (
                    ("splatseed", old.version, new.version),
                    (f"method {new.arm.method}", old.method_version, new.method_version),
                ):
                    if before != now:
                        changes[f"{what} is {now}"].add(before or "of an unknown version")
    if count:
        parts = [f"{now}, was {' and '.join(sorted(before))}" for now, before in changes.items()]
        text = (
            f"The code has changed ({counted(len(count), 'run')} to repeat): {'; '.join(parts)}. "
            "The earlier results are kept apart."
        )
        yield Finding("changed-code", text, "info", subjects=tuple(changes))


def _without_code(spec: RunSpec) -> tuple[str, str]:
    """What is the same of a run by other code; files of one name are different methods."""
    return replace(spec, version="", method_version="").key, spec.arm.method


def count_runs(runs: Sequence[BenchRun]) -> str:
    """Describe the numbers of finished, failed and pending runs."""
    done = sum(run.result is not None for run in runs)
    failed = sum(bool(run.error) for run in runs)
    pending = len(runs) - done - failed
    kinds = {"done": done, "failed": failed, "pending": pending if done or failed else 0}
    parts = [f"{number:,} {kind}" for kind, number in kinds.items() if number]
    return ", ".join([counted(len(runs), "run"), *parts])


def check_bench_folder(folder: Path, protect: Sequence[Path]) -> None:
    """Check that ``bench`` may write to a folder.

    Raises:
        OutputError: Something else wrote it, or it overlaps a scene of ``protect``.
    """
    kind = read_manifest(folder).get("command")
    if kind == "bench":
        check_separate(folder, protect)
    elif kind is None:
        check_output(folder, kind="bench", protect=protect)
    else:
        expected = f"the folder of splatseed bench, or a new one, at {folder}"
        found = f"what splatseed {kind} wrote"
        raise OutputError(expected, found=found, fix="Choose another folder.")


def record_plan(bench: Path, verb: str, specs: Iterable[RunSpec], arguments: Sequence[str]) -> None:
    """Record a call of the command and the runs that it plans; creates the folder."""
    if not (bench / MANIFEST).is_file():
        write_json(bench / MANIFEST, {"command": verb})
    calls = [*read_calls(bench), _describe_call(verb, arguments)]
    planned = [spec.to_dict() for spec in specs]
    write_json(bench / _PLANNED, {"calls": calls, "runs": planned})


def read_calls(bench: Path) -> list[dict[str, Any]]:
    """Read the recorded calls: command, time, machine and versions, the oldest first."""
    return _planned(bench)["calls"]


def _planned(bench: Path) -> dict[str, list[Any]]:
    with suppress(OSError, ValueError):
        return dict(json.loads(read_text(bench / _PLANNED)))
    return {"calls": [], "runs": []}


def _describe_call(verb: str, arguments: Sequence[str]) -> dict[str, Any]:
    cpu = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        cpu = next(line.partition(": ")[2] for line in lines if line.startswith("model name"))
    return {
        "command": shlex.join(["splatseed", verb, *arguments]),
        "started": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "folder": str(Path.cwd()),
        "host": socket.gethostname(),
        "system": platform.platform(),
        "cpu": cpu,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: known for name in _PACKAGES if (known := version_of(name))},
    }


def estimate_seconds(specs: Sequence[RunSpec], runs: Iterable[BenchRun], threads: int) -> float:
    """Estimate the time of runs in sequence, corrected by the times of finished runs."""
    paces = [run.result.wall_seconds / run.spec.seconds(threads) for run in runs if run.result]
    return median(paces or [1.0]) * sum(spec.seconds(threads) for spec in specs)
