"""Where a benchmark runs: this machine or a Ray cluster, how many runs at a time."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shutil import which
from typing import TYPE_CHECKING, TypeAlias

from splatseed.bench.running.job import JobOptions
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.local import LocalExecutor
from splatseed.bench.running.watcher import Watcher
from splatseed.commands.bench.options import Options
from splatseed.console import stage_display
from splatseed.process.memory import check_memory
from splatseed.process.threads import cores, slot_environment
from splatseed.requirements import require
from splatseed.train.settings import BYTES_EACH, Backend

if TYPE_CHECKING:
    from splatseed.process.ray_tasks import Cluster

Run: TypeAlias = Callable[[Ledger, Path, Collection[str], JobOptions, Watcher], bool]


@dataclass(frozen=True)
class Machine:
    """Where runs are executed.

    Args:
        name: Its name.
        backend: The backend of training: not "auto".
        jobs: Number of runs at a time.
        threads: Threads of each run on the CPU.
        run: Executes the runs of a ledger with these keys; returns whether it was completed.
        is_local: Whether it is the machine that this process runs on.
    """

    name: str
    backend: Backend
    jobs: int
    threads: int
    run: Run
    is_local: bool = False

    @property
    def words(self) -> str:
        """A description."""
        each = f"{self.threads} thread{'' if self.threads == 1 else 's'} each"
        on = "on a GPU" if self.backend == "cuda" else "on the CPU"
        return f"{self.name}, {self.jobs} at a time, {on}, {each}"


@contextmanager
def open_machine(options: Options, backend: Backend) -> Iterator[Machine]:
    """The machine to run on, while the block runs.

    Args:
        options: The user's options.
        backend: The plan's backend.

    Raises:
        ParameterError: A GPU is requested and there is none, or there is no such cluster.
        MissingDependencyError: PyTorch, gsplat or Ray is absent.
    """
    require("torch", "gsplat")
    if options.executor == "ray":
        from splatseed.process.ray_tasks import ray_cluster  # noqa: PLC0415  (an extra)

        with ray_cluster(options.address) as cluster:
            yield _ray_machine(options, backend, cluster)
    else:
        yield _local_machine(options, backend)


def check_machine(machine: Machine, seeds: int) -> None:
    """Refuse runs that do not fit into this machine's memory.

    The memory of a cluster's nodes is unknown.

    Args:
        machine: Where they will run.
        seeds: Gaussians that the largest of them begins with.

    Raises:
        ParameterError: This many at a time do not fit.
    """
    if not machine.is_local or machine.backend != "cpu":
        return
    check_memory(
        seeds,
        BYTES_EACH * machine.jobs,
        f"seeds per run with {machine.jobs} at a time",
        fix="Pass smaller --ratios, --cap-max {most}, or fewer --jobs.",
    )


def _local_machine(options: Options, backend: Backend) -> Machine:
    chosen: Backend = "cpu"
    if backend == "cuda" or (backend == "auto" and _has_driver()):
        from splatseed.train.device import pick_device  # noqa: PLC0415  (PyTorch, which takes seconds)

        with stage_display() as clock:  # gsplat's kernels are built here, not by each run
            chosen = "cuda" if pick_device(backend, clock).type == "cuda" else "cpu"
    gpus = _gpus() if chosen == "cuda" else []
    jobs = options.jobs or max(len(gpus), 1)
    threads = options.threads or max(1, cores() // jobs)
    environments = [slot_environment(threads, _gpu_of(slot, gpus)) for slot in range(jobs)]

    def run(
        ledger: Ledger, bench: Path, keys: Collection[str], how: JobOptions, watcher: Watcher
    ) -> bool:
        return LocalExecutor(ledger, bench, environments, how, watcher).run(keys)

    return Machine("this machine", chosen, jobs, threads, run, is_local=True)


def _has_driver() -> bool:
    """Whether there may be a GPU for PyTorch: without a driver there is none."""
    return (
        os.name == "nt"
        or which("nvidia-smi") is not None
        or Path("/proc/driver").joinpath("nvidia").exists()
        or which("rocminfo") is not None
    )


def _gpus() -> list[str]:
    """The GPUs that may be used, as ``CUDA_VISIBLE_DEVICES`` names them."""
    import torch  # noqa: PLC0415  (takes a while)

    named = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each]
    return named or [f"{i}" for i in range(torch.cuda.device_count())]


def _gpu_of(slot: int, gpus: Sequence[str]) -> str:
    """The GPU of a slot; PyTorch chooses if there is none."""
    return gpus[slot % len(gpus)] if len(gpus) > 1 else ""


def _ray_machine(options: Options, backend: Backend, cluster: Cluster) -> Machine:
    from splatseed.bench.running.ray_cluster import RayExecutor  # noqa: PLC0415  (an extra)

    chosen: Backend = "cuda" if backend == "cuda" or cluster.has_gpus else "cpu"
    chosen = "cpu" if backend == "cpu" else chosen
    share = cluster.share(options.threads, gpu=chosen == "cuda")
    jobs = min(options.jobs or cluster.capacity(share), cluster.capacity(share))

    def run(
        ledger: Ledger, bench: Path, keys: Collection[str], how: JobOptions, watcher: Watcher
    ) -> bool:
        executor = RayExecutor(
            ledger, bench, share, jobs=options.jobs, options=how, watcher=watcher
        )
        return executor.run(keys)

    return Machine("Ray", chosen, jobs, share.threads, run)
