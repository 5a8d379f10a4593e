"""Where a benchmark is run: this machine or a Ray cluster, how many runs at a time, with what each."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatseed.bench.job import JobOptions
from splatseed.bench.ledger import Ledger
from splatseed.bench.local import LocalExecutor, cores, slot_environment
from splatseed.bench.watcher import Watcher
from splatseed.commands._bench_options import Options
from splatseed.commands._bench_prepare import local_backend
from splatseed.train.settings import Backend

__all__ = ["Machine", "find_machine"]


@dataclass(frozen=True)
class Machine:
    """Where runs go.

    Args:
        backend: What they train on: not "auto".
        jobs: How many at a time.
        threads: Threads of each on the CPU.
        gpus: Names of the GPUs that are shared out; none to leave the choice to PyTorch.
    """

    backend: Backend
    jobs: int
    threads: int
    gpus: Sequence[str] = ()

    @property
    def words(self) -> str:
        """In words."""
        on = "on a GPU" if self.backend == "cuda" else "on the CPU"
        threads = "1 thread" if self.threads == 1 else f"{self.threads} threads"
        return f"{self.jobs} at a time, {on}, {threads} each"

    def run(
        self,
        ledger: Ledger,
        bench: Path,
        keys: Collection[str],
        options: JobOptions,
        watcher: Watcher,
    ) -> bool:
        """Do the runs; whether it went to the end.

        Raises:
            OutputError: The ledger or a folder cannot be written.
        """
        environments = [
            slot_environment(self.threads, self.gpus[i % len(self.gpus)] if self.gpus else "")
            for i in range(self.jobs)
        ]
        return LocalExecutor(ledger, bench, environments, options, watcher).run(keys)


def find_machine(options: Options, backend: Backend) -> Machine:
    """What there is to run on.

    Args:
        options: What the user asks for.
        backend: Of the plan.

    Raises:
        ParameterError: A GPU is asked for and there is none.
    """
    backend = local_backend(backend)
    gpus = _gpus() if backend == "cuda" else []
    jobs = options.jobs or max(len(gpus), 1)
    return Machine(
        backend,
        jobs,
        options.threads or max(1, cores() // jobs),
        gpus if len(gpus) > 1 else (),
    )


def _gpus() -> list[str]:
    """The GPUs that may be used, as ``CUDA_VISIBLE_DEVICES`` names them."""
    import torch  # noqa: PLC0415  (takes a while)

    named = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
    return named or [f"{i}" for i in range(torch.cuda.device_count())]
