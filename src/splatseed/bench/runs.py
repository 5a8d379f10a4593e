"""The folder of a benchmark, whose runs are folders: reading them, and what is left to do.

``planned.json`` has the calls of the command and the runs of the last plan, ``runs/KEY`` each run
that ended: with a ``result.json`` it is finished and never repeated, with an ``error.json`` it
failed. A folder that is not a benchmark's is never written to.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import socket
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from statistics import median
from typing import Any

from splatseed.bench.plan import RunResult, RunSpec
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import StrPath, read_text
from splatseed.io.staging import (
    MANIFEST,
    check_output,
    check_separate,
    locked,
    read_manifest,
    write_json,
)
from splatseed.text import counted

RESULT, ERROR = "result.json", "error.json"
_PLANNED = "planned.json"
_OTHER_LAYOUT = (ValueError, KeyError, TypeError, AttributeError)
"""What reading JSON of another version raises."""
_PACKAGES = ("splatseed", "torch", "gsplat", "torchmetrics", "numpy", "scipy", "numba", "ray")


@dataclass(frozen=True)
class Run:
    """A run of a benchmark: finished if it has a result, failed if it has an error, else to do."""

    spec: RunSpec
    result: RunResult | None = None
    error: str = ""


def run_folder(bench: Path, spec: RunSpec) -> Path:
    """Where a run is kept."""
    return bench / "runs" / spec.key


def read_run(bench: Path, spec: RunSpec) -> Run:
    """A run as its folder tells of it."""
    return _read(run_folder(bench, spec), spec)


def _read(folder: Path, spec: RunSpec | None = None) -> Run:
    """What a run's folder tells; of an unfinished run whose specification is given, that."""
    for name in (RESULT, ERROR):
        with suppress(FileNotFoundError, NotADirectoryError):
            text = read_text(folder / name)
            try:
                content = json.loads(text)
                own = spec or RunSpec.from_dict(content["spec"])
                if name == ERROR:
                    return Run(own, error=str(content["error"]))
                return Run(own, RunResult.from_dict(content["result"]))
            except _OTHER_LAYOUT as error:
                fix = "Remove that folder to have its run repeated, or begin a new benchmark."
                raise _not_ours(folder / name, error, fix) from None
    assert spec is not None  # noqa: S101  (folders are listed by these files)
    return Run(spec)


def _not_ours(path: Path, error: Exception, fix: str) -> SceneFormatError:
    expected = f"{path} as this version of splatseed writes it"
    return SceneFormatError(
        expected, found=f"another layout ({type(error).__name__}: {error})", fix=fix
    )


def _planned_runs(bench: Path) -> list[RunSpec]:
    try:
        return [RunSpec.from_dict(each) for each in _planned(bench)["runs"]]
    except _OTHER_LAYOUT as error:
        fix = "Plan it again with splatseed bench, or begin a new one."
        raise _not_ours(bench / _PLANNED, error, fix) from None


def read_runs(bench: StrPath) -> list[Run]:
    """All runs of a benchmark: those of the last plan, in its order, then others that are finished.

    Raises:
        SceneNotFoundError: There is no benchmark.
        SceneFormatError: A file is not of the layout that this version writes.
    """
    bench = Path(bench)
    kind = read_manifest(bench).get("command")
    if kind != "bench":
        fix = "Name the folder that splatseed bench wrote."
        raise SceneNotFoundError(f"a benchmark at {bench}", found=kind or "none", fix=fix)
    runs = [read_run(bench, spec) for spec in _planned_runs(bench)]
    known = {run_folder(bench, run.spec).name for run in runs}
    # What failed in an earlier plan is no longer asked for.
    finished = sorted(path.parent for path in bench.glob(f"runs/*/{RESULT}"))
    return [*runs, *(_read(each) for each in finished if each.name not in known)]


def counts(runs: Sequence[Run]) -> str:
    """How many runs there are of each kind, in words."""
    done = sum(run.result is not None for run in runs)
    failed = sum(bool(run.error) for run in runs)
    left = len(runs) - done - failed
    kinds = {"done": done, "failed": failed, "to do": left if done or failed else 0}
    told = [f"{number:,} {kind}" for kind, number in kinds.items() if number]
    return ", ".join([counted(len(runs), "run"), *told])


def check_bench_folder(folder: Path, protect: Sequence[Path]) -> None:
    """Refuse a folder that ``bench`` did not write, before any work is done.

    Raises:
        OutputError: It is another's, or lies in a scene of ``protect`` or around one.
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


@contextmanager
def alone_in(bench: Path) -> Iterator[None]:
    """Keep other processes from carrying out runs of a benchmark's folder while the block runs.

    Raises:
        OutputError: Another process is at it.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(locked(bench))
        except BlockingIOError:
            fix = "Wait until it ends, stop it, or name another folder."
            expected = f"no other process that carries out runs in {bench}"
            raise OutputError(expected, found="one", fix=fix) from None
        yield


def begin(bench: Path, verb: str, specs: Iterable[RunSpec], words: Sequence[str]) -> None:
    """Make the folder unless it exists, and record a call of the command and its runs.

    Raises:
        OutputError: It cannot be written.
    """
    if not (bench / MANIFEST).is_file():
        write_json(bench / MANIFEST, {"command": verb})
    calls = [*read_calls(bench), _describe_call(verb, words)]
    planned = [spec.to_dict() for spec in specs]
    write_json(bench / _PLANNED, {"calls": calls, "runs": planned})


def read_calls(bench: Path) -> list[dict[str, Any]]:
    """The recorded calls of the command, oldest first: words, time, machine, and versions."""
    return _planned(bench)["calls"]


def _planned(bench: Path) -> dict[str, list[Any]]:
    with suppress(OSError, ValueError):
        return dict(json.loads(read_text(bench / _PLANNED)))
    return {"calls": [], "runs": []}


def _describe_call(verb: str, words: Sequence[str]) -> dict[str, Any]:
    cpu = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines()
        cpu = next(line.partition(": ")[2] for line in lines if line.startswith("model name"))
    return {
        "command": shlex.join(["splatseed", verb, *words]),
        "started": datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "folder": str(Path.cwd()),
        "host": socket.gethostname(),
        "system": platform.platform(),
        "cpu": cpu,
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "versions": {name: known for name in _PACKAGES if (known := package_version(name))},
    }


def package_version(package: str) -> str:
    """An installed package's version; empty if it is not installed or runs from its source."""
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def estimate(specs: Sequence[RunSpec], runs: Iterable[Run], threads: int) -> float:
    """Seconds of runs one after another, each on so many threads, at the pace of finished ones."""
    paces = [run.result.wall_seconds / run.spec.seconds(threads) for run in runs if run.result]
    return median(paces or [1.0]) * sum(spec.seconds(threads) for spec in specs)
