"""Run a measurement in a fresh process.

Numba, PyTorch and BLAS have the given number of threads from the first import on; idle threads
sleep, as under the command line. The parent's caches, memory and settings do not affect the result.
"""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.common.clocks import Clock

from splatseed.errors import SplatseedError

__all__ = ["avx2_environment", "call", "seconds_of", "thread_settings"]

ROOT = Path(__file__).parents[2]
THREADS = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")
AVX2 = {"NUMBA_CPU_NAME": "x86-64-v3", "ATEN_CPU_CAPABILITY": "avx2"}


class ChildError(SplatseedError):
    """A child process failed."""


def call(
    function: str, *, threads: int, environment: Mapping[str, str] | None = None, **arguments: Any
) -> Any:
    """Call a function of these benchmarks in a fresh process, and return its value.

    Args:
        function: ``package.module:name``; arguments and value are JSON values.
        threads: Number of threads.
        environment: Further variables.
        arguments: Keyword arguments of the function.

    Raises:
        ChildError: The call failed; the message has the end of its stderr.
    """
    done = subprocess.run(
        [sys.executable, "-m", __name__, function, json.dumps(arguments)],
        env=_importing({**os.environ, **thread_settings(threads), **(environment or {})}),
        capture_output=True, check=False, text=True,
    )  # fmt: skip
    if done.returncode:
        raise ChildError(
            f"{function} to run on {threads} threads", found=done.stderr[-2000:], fix="See there."
        )
    return json.loads(done.stdout.splitlines()[-1])


def _importing(environment: Mapping[str, str]) -> dict[str, str]:
    """Add the checkout to PYTHONPATH."""
    places = filter(None, [environment.get("PYTHONPATH"), str(ROOT)])
    return {**environment, "PYTHONPATH": os.pathsep.join(places)}


def thread_settings(threads: int, *, awake: bool = False) -> dict[str, str]:
    """Return variables for a number of threads; ``awake`` makes idle threads spin."""
    policy = "active" if awake else "passive"
    return {name: str(threads) for name in THREADS} | {"OMP_WAIT_POLICY": policy}


def seconds_of(
    command: Sequence[str],
    clock: Clock,
    *,
    threads: int = 1,
    environment: Mapping[str, str] | None = None,
) -> float:
    """Measure the time of a program; by clock ``cpu``, CPU time divided by the threads.

    Raises:
        OSError: There is no such program.
        subprocess.CalledProcessError: It failed.
    """
    everything = {**os.environ, **(environment or {})}
    started, before = time.perf_counter(), os.times()
    subprocess.run(command, check=True, capture_output=True, text=True, env=everything)
    took, after = time.perf_counter() - started, os.times()
    busy = after.children_user - before.children_user
    busy += after.children_system - before.children_system
    return took if clock == "wall" else busy / threads


def avx2_environment() -> dict[str, str] | None:
    """Return variables that limit Numba and PyTorch to AVX2; None on processors without AVX-512.

    Numba caches these kernels apart, as its cache key has the processor's features.
    """
    from llvmlite.binding import get_host_cpu_features  # noqa: PLC0415  (asks the processor)

    features = get_host_cpu_features()
    if not features.get("avx512f") or not features.get("avx2"):
        return None
    for name in features:
        if name.startswith(("avx512", "avx10", "evex512")):
            features[name] = False
    return {**AVX2, "NUMBA_CPU_FEATURES": features.flatten()}


def _main(function: str, arguments: str) -> None:
    module, name = function.split(":")
    result = getattr(importlib.import_module(module), name)(**json.loads(arguments))
    print(json.dumps(result))


if __name__ == "__main__":
    _main(*sys.argv[1:])
