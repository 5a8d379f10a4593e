"""The worker: pycolmap in a process of its own.

A failure deep in COLMAP (a full disk under SQLite, a broken image codec) aborts the process it
happens in, and only a kill stops some of its loops. So ``run_job`` starts an interpreter that runs
``serve``, hands it a pickled job, and reads pickled messages back until ``("done", Outcome)`` or
``("failed", error class, expected, found, fix)``; in between come ``("progress", stage,
fraction)``. An abort becomes a ``ReconstructionError``, an interrupt a kill.
"""

from __future__ import annotations

import os
import pickle
import re
import signal
import subprocess
import sys
from pathlib import Path
from threading import Thread
from typing import Any, BinaryIO, cast

from splatseed import errors
from splatseed.errors import ReconstructionError, SplatseedError
from splatseed.process.interpreter import child_command, child_environment
from splatseed.progress import Progress
from splatseed.sfm.jobs import Job, Outcome
from splatseed.sfm.settings import check_cuda, require_pycolmap
from splatseed.sfm.stages import Stages

_CHILD = "from splatseed.sfm.worker import serve; serve()"
_REASON = re.compile(r"what\(\):\s*(.*)|^[EF]\d{8}\s.*?\]\s*(.*)", re.MULTILINE)


def run_job(job: Job, log: Path, *, verbose: bool, on_progress: Progress) -> Outcome:
    """Run ``job`` in a child process and wait for it.

    Args:
        job: What to do.
        log: Where pycolmap's log goes.
        verbose: Let the log through to the terminal instead.
        on_progress: Called with the stage and the fraction done.

    Raises:
        SplatseedError: The job failed; the class and the text are the child's.
        ReconstructionError: The child died.
    """
    with (
        log.open("wb") as sink,
        subprocess.Popen(  # noqa: S603  (our own interpreter and module)
            child_command(_CHILD, str(int(verbose))),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=None if verbose else sink,
            env=child_environment(),
            process_group=0,  # Ctrl-C reaches only us, and we end the child
        ) as child,
    ):
        try:
            return _converse(child, job, on_progress)
        except (EOFError, BrokenPipeError, pickle.UnpicklingError) as error:
            raise _death(child.wait(), log) from error
        finally:
            child.kill()


def _converse(child: subprocess.Popen[bytes], job: Job, on_progress: Progress) -> Outcome:
    commands, replies = cast("BinaryIO", child.stdin), cast("BinaryIO", child.stdout)
    pickle.dump(job, commands)
    commands.flush()
    while True:
        match pickle.load(replies):  # noqa: S301  (our own child)
            case "progress", stage, fraction:
                on_progress(stage, fraction)
            case "done", Outcome() as outcome:
                return outcome
            case "failed", name, expected, found_text, fix:
                raise getattr(errors, name)(expected, found=found_text, fix=fix)


def _death(code: int, log: Path) -> ReconstructionError:
    cause = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    text = log.read_text(errors="replace")
    reasons = [" ".join(filter(None, groups)) for groups in _REASON.findall(text)]
    reason = "".join(f": {line}" for line in (reasons or text.splitlines())[-1:])
    return ReconstructionError(
        "pycolmap to finish",
        found=f"its process ended by {cause}{reason}",
        fix="Check disk space and memory; verbose=True shows pycolmap's own log.",
    )


def _serve(commands: BinaryIO, replies: BinaryIO, *, verbose: bool) -> None:
    """The child's side: read one job, run it, and report the result."""

    def reply(*message: Any) -> None:
        pickle.dump(message, replies)
        replies.flush()

    try:
        pycolmap = require_pycolmap()
        job = pickle.load(commands)  # noqa: S301  (our own parent)
        Thread(target=_end_with, args=(commands.fileno(),), daemon=True).start()
        check_cuda(pycolmap, job.settings.device)
        pycolmap.logging.logtostderr = True  # alone: it would leave files in the temporary folder
        pycolmap.logging.minloglevel = int(
            pycolmap.logging.Level.INFO if verbose else pycolmap.logging.Level.ERROR
        )
        stages = Stages(
            pycolmap, job.settings.seed, lambda stage, done: reply("progress", stage, done)
        )
        reply("done", job.run(stages))
    except SplatseedError as error:
        reply("failed", type(error).__name__, error.expected, error.found, error.fix)


def _end_with(parent: int) -> None:
    """End this process when the parent does, even if it is killed: its pipe closes then."""
    while os.read(parent, 1):
        pass
    os._exit(1)


def serve() -> None:
    """Act as the child: communicate over standard input and output."""
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever the C++ libraries print goes to the log
    _serve(sys.stdin.buffer, replies, verbose=sys.argv[1] == "1")
