"""Environment variables that libraries read when they load."""

from __future__ import annotations

import os
import sys


def set_thread_defaults() -> None:
    """Set how NumPy, PyTorch and Numba use threads, where the user has not.

    Call it before they are imported, at the entry of a program.
    """
    # Idle threads sleep rather than spin. PyTorch and Numba have a pool each: spinning, they take
    # the cores from each other, and on a busy machine a training step took 5 to 20 times as long.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    # TBB, where a distribution ships it, can hang when the interpreter exits.
    os.environ.setdefault("NUMBA_THREADING_LAYER_PRIORITY", "omp workqueue tbb")
    # OMP_NUM_THREADS should limit Numba as well.
    threads = os.environ.get("OMP_NUM_THREADS", "")
    if threads.isdigit() and "numba" not in sys.modules:
        os.environ.setdefault("NUMBA_NUM_THREADS", threads)


def worker_env(threads: int, gpu: str = "") -> dict[str, str]:
    """Return the variables that limit a worker process to its share of the machine.

    Args:
        threads: CPU threads of the worker; results do not depend on it.
        gpu: As in ``CUDA_VISIBLE_DEVICES``; PyTorch chooses if empty.
    """
    libraries = ("NUMBA", "OMP", "MKL", "OPENBLAS")
    environment = {f"{library}_NUM_THREADS": str(threads) for library in libraries}
    environment["OMP_WAIT_POLICY"] = os.environ.get("OMP_WAIT_POLICY", "passive")
    return {**environment, "CUDA_VISIBLE_DEVICES": gpu} if gpu else environment
