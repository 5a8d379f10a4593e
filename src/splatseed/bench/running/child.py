"""A run in its own process, to measure its peak memory and so that its death ends nothing else.

Notation: the process is started with the run as one line of JSON on its standard input, and answers
with lines of JSON: ``{"stage": ..., "fraction": ...}`` on the way, ``{"status": ..., ...}`` at the
end.
Promise: it does not receive the terminal's Ctrl-C, but one SIGTERM from its parent when it should
stop; it ends with its parent.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from splatseed.bench.planning.records import RunResult, RunSpec
from splatseed.bench.running.job import JobOptions, Outcome, run_job
from splatseed.progress import Progress

PROGRAM = "from splatseed.bench.running.child import serve; serve()"
REPORT_SECONDS = 0.5
"""Seconds between progress messages."""
LOG_WORDS = 40
"""Characters of the process's last output that are reported."""


class Killed(Exception):  # noqa: N818  (it is what happened to it)
    """The process of a run died; the text says how."""


@dataclass(frozen=True)
class _Order:
    """The process's instructions."""

    spec: str
    work: str
    target: str
    options: Mapping[str, Any]


class Child:
    """The process of a run, from the parent's side.

    Args:
        spec: The run.
        work: The folder it works in.
        target: The folder for what is kept.
        options: What else to do.
        environment: Environment variables to set for it.
    """

    def __init__(
        self,
        spec: RunSpec,
        work: Path,
        target: Path,
        options: JobOptions,
        environment: Mapping[str, str],
    ) -> None:
        self._order = _Order(spec.to_json(), str(work), str(target), asdict(options))
        self._log = work.with_suffix(".log")
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(  # noqa: S603  (our own interpreter and module)
                [sys.executable, "-P", "-c", PROGRAM],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env={
                    **os.environ,
                    "PYTHONPATH": os.pathsep.join(filter(None, sys.path)),
                    "PYTHONSAFEPATH": "1",
                    **environment,
                },
                text=True,
                encoding="utf-8",
                process_group=0,  # Ctrl-C reaches only us
            )

    def wait(self, progress: Progress) -> Outcome:
        """Wait for the end.

        Args:
            progress: Told how far it is.

        Raises:
            Killed: It died.
        """
        outcome = None
        assert self._process.stdin is not None  # noqa: S101  (asked for above)
        assert self._process.stdout is not None  # noqa: S101  (for mypy: it is known here)
        try:
            self._process.stdin.write(json.dumps(asdict(self._order)) + "\n")
            self._process.stdin.flush()
            for line in self._process.stdout:
                message = json.loads(line)
                if "status" in message:
                    outcome = _outcome(message)
                else:
                    progress(message["stage"], message["fraction"])
        except (BrokenPipeError, ValueError):  # it died before or during its message
            pass
        except BaseException:  # we stop waiting
            self.kill()
            raise
        finally:
            code = self._process.wait()
            self._process.stdout.close()
            _close(self._process.stdin)
        if outcome is None:
            raise Killed(_cause(code, self._log))
        self._log.unlink(missing_ok=True)
        return outcome

    def stop(self) -> None:
        """Ask it to stop: training leaves a checkpoint. To be called once."""
        self._process.terminate()

    def kill(self) -> None:
        """Stop it at once."""
        self._process.kill()


def serve() -> None:
    """Be the process: execute the run given on standard input."""
    replies = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what libraries print goes to the log
    order = _Order(**json.loads(sys.stdin.readline()))
    threading.Thread(target=_end_with_parent, daemon=True).start()
    outcome = run_job(
        RunSpec.from_json(order.spec),
        Path(order.work),
        Path(order.target),
        JobOptions(**order.options),
        _reporter(replies),
    )
    result = None if outcome.result is None else outcome.result.to_json()
    _say(replies, {"status": outcome.status, "result": result, "error": outcome.error})


def _end_with_parent() -> None:
    """The parent holds the other end of standard input, and writes nothing more."""
    os.read(sys.stdin.fileno(), 1)  # not through the buffer, whose lock would be held at exit
    os._exit(1)


def _reporter(replies: IO[str]) -> Progress:
    """Progress that is forwarded a few times per second."""
    last = ("", 0.0)

    def report(stage: str, fraction: float) -> None:
        nonlocal last
        now = time.monotonic()
        if stage != last[0] or now - last[1] > REPORT_SECONDS:
            last = (stage, now)
            _say(replies, {"stage": stage, "fraction": float(fraction)})

    return report


def _say(replies: IO[str], message: Mapping[str, Any]) -> None:
    try:
        replies.write(json.dumps(message) + "\n")
        replies.flush()
    except BrokenPipeError:  # nobody listens any more: the parent is gone
        os._exit(1)


def _outcome(message: Mapping[str, Any]) -> Outcome:
    text = message["result"]
    result = None if text is None else RunResult.from_json(text)
    return Outcome(message["status"], result, message["error"])


def _close(pipe: IO[str]) -> None:
    with suppress(BrokenPipeError):  # it did not read our last message
        pipe.close()


def _cause(code: int, log: Path) -> str:
    """How a process died, and its last output."""
    how = f"killed by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}"
    said = log.read_text("utf-8", "replace").split("\n")
    last = " ".join(" ".join(said).split()[-LOG_WORDS:]) if any(said) else ""
    return f"{how}{': ' if last else ''}{last}"
