"""Stages: pycolmap's blocking calls, run so that their progress can be reported.

pycolmap releases the GIL, so a stage runs in a worker thread while the calling thread polls its
progress ten times a second.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass, field
from typing import Any, TypeVar

from splatseed.errors import ReconstructionError
from splatseed.progress import Progress

T = TypeVar("T")

_POLL_SECONDS = 0.1


@dataclass
class Stages:
    """Runs stages one after another and remembers how long each took.

    Args:
        pycolmap: The pycolmap module.
        seed: Set in pycolmap's generator, which is per thread, before each stage.
        on_progress: Called with the stage and the fraction done.
        seconds: Wall time of the stages so far.
    """

    pycolmap: Any
    seed: int
    on_progress: Progress
    seconds: dict[str, float] = field(default_factory=dict)

    def run(self, stage: str, work: Callable[[], T], count: Callable[[], int], total: int) -> T:
        """Run ``work`` and return what it returns.

        Args:
            stage: Its name.
            work: Calls pycolmap.
            count: How many of ``total`` items are done; called while ``work`` runs.
            total: The number of items.

        Raises:
            ReconstructionError: pycolmap failed.
        """
        started = time.perf_counter()
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(self._seeded, work)
            self.on_progress(stage, 0.0)
            while not wait([future], _POLL_SECONDS).done:
                self.on_progress(stage, min(count() / max(total, 1), 1.0))
        self.on_progress(stage, 1.0)
        self.seconds[stage] = time.perf_counter() - started
        return _result(stage, future)

    def _seeded(self, work: Callable[[], T]) -> T:
        self.pycolmap.set_random_seed(self.seed)
        return work()


def _result(stage: str, future: Future[T]) -> T:
    try:
        return future.result()
    except Exception as error:  # pycolmap throws whatever C++ type its libraries throw
        raise ReconstructionError(
            f"pycolmap to finish {stage}",
            found=f"{type(error).__name__}: {error}",
            fix="Check the disk space and the images; verbose=True shows pycolmap's own log.",
        ) from error
