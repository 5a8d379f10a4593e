"""pycolmap in a process of its own.

A failure deep in COLMAP (a full disk under SQLite, a broken image codec) aborts the process it
happens in, and only a kill stops some of its loops. So an abort becomes a ``ReconstructionError``,
and an interrupt a kill.
"""

from __future__ import annotations

import re
from contextlib import closing
from pathlib import Path

from splatseed.errors import ReconstructionError, TaskLostError
from splatseed.process.tasks import Child
from splatseed.progress import Progress
from splatseed.sfm.jobs import Job, Outcome
from splatseed.sfm.settings import check_cuda, require_pycolmap
from splatseed.sfm.stages import Stages

_REASON = re.compile(r"what\(\):\s*(.*)|^[EF]\d{8}\s.*?\]\s*(.*)", re.MULTILINE)


def run_job(job: Job, log: Path, *, verbose: bool, on_progress: Progress) -> Outcome:
    """Run ``job`` in a child process and wait for it.

    Args:
        job: What to do.
        log: Where pycolmap's log goes.
        verbose: Let the log through to the terminal instead.
        on_progress: Called with the stage and the fraction done.

    Raises:
        SplatseedError: The job failed; the error is the child's.
        ReconstructionError: The child died.
    """
    with closing(Child(log=None if verbose else log.open("w+b"))) as child:
        try:
            outcome: Outcome = child.call(_run, job, verbose, progress=on_progress)
        except TaskLostError as error:
            reasons = [] if verbose else _REASON.findall(log.read_text(errors="replace"))
            reason = "".join(f": {''.join(groups)}" for groups in reasons[-1:])
            raise ReconstructionError(
                "pycolmap to finish",
                found=f"{error.found.partition(':')[0]}{reason}" if reason else error.found,
                fix="Check disk space and memory; verbose=True shows pycolmap's own log.",
            ) from error
        return outcome


def _run(job: Job, verbose: bool, progress: Progress) -> Outcome:
    """Do the job, in the child."""
    pycolmap = require_pycolmap()
    check_cuda(pycolmap, job.settings.device)
    pycolmap.logging.logtostderr = True  # alone: it would leave files in the temporary folder
    level = pycolmap.logging.Level.INFO if verbose else pycolmap.logging.Level.ERROR
    pycolmap.logging.minloglevel = int(level)
    return job.run(Stages(pycolmap, job.settings.seed, progress))
