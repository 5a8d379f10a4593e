"""Run pycolmap in a child process.

COLMAP aborts its process on some failures (a full disk under SQLite, a broken image codec), and
some of its loops only stop by a kill: an abort of the child becomes ``ReconstructionError``, and an
interrupt kills it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, TypeAlias

from splatseed import errors
from splatseed.progress import Progress
from splatseed.runtime.child import Child
from splatseed.sfm import colmap
from splatseed.sfm.colmap import ColmapRun, Settings
from splatseed.sfm.work_folder import WorkFolder

Job: TypeAlias = Callable[..., Any]
"""A job of the child process: (run, staging folder, *arguments) to its result."""
WORK = ".work"
"""The folder of temporary files in the staging folder."""
_CHILD = {"OPENBLAS_NUM_THREADS": "1"}  # our threads and NumPy's own would wait for each other
_REASON = re.compile(r"what\(\):\s*(.*)|^[EF]\d{8}\s.*?\]\s*(.*)", re.MULTILINE)


def call(
    images: Path,
    staging: Path,
    settings: Settings,
    progress: Progress,
    kept: WorkFolder | None,
    job: Job,
    *arguments: Any,
) -> Any:
    """Run a job in a child process; return its result."""
    log = staging / WORK / "log.txt"
    task = (_work, images, staging, settings, kept, job, arguments)
    limited = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS") if settings.threads > 0 else ()
    environment = {**_CHILD, **dict.fromkeys(limited, str(settings.threads))}
    with closing(Child(*task, reports=True, environment=environment, log=log.open("w+b"))) as child:
        try:
            return child.result(progress)
        except errors.TaskLostError as error:
            reasons, found = _REASON.findall(log.read_text("utf-8", "replace")), error.found
            if reasons:
                found = f"{found.partition(':')[0]}: {''.join(reasons[-1])}"
            fix = "Check disk space and memory."
            if kept is not None:
                fix = f"{fix[:-1]}, and run it again: finished work is in {kept.folder}."
            raise errors.ReconstructionError("pycolmap to finish", found=found, fix=fix) from error


def _work(
    images: Path,
    staging: Path,
    settings: Settings,
    kept: WorkFolder | None,
    job: Job,
    arguments: Sequence[Any],
    progress: Progress,
) -> Any:
    pycolmap = colmap.require_pycolmap(settings.device)
    pycolmap.logging.logtostderr = True  # not to files in the temporary folder
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.ERROR)
    run = ColmapRun(pycolmap, settings, images, staging / WORK, progress, kept)
    return job(run, staging, *arguments)
