"""Two clocks: the wall's, and one for a machine that others use too.

Notation: ``wall`` is seconds on the wall. ``cpu`` (Linux) is, of everything that is timed, the time
that the busiest thread was on a core: what the wall's would be were nothing else running, as long
as what is timed runs either on one thread or on all of them at once. Promise: a reading is an
array, so that differences can be taken thread by thread; its greatest entry is the time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float64

__all__ = ["Clock", "start_clock"]

Clock = Literal["wall", "cpu"]
TASKS = Path("/proc/self/task")


def start_clock(clock: Clock) -> Callable[[], Float64[np.ndarray, " T"]]:
    """A clock to read; ``cpu`` watches the threads that have started so far."""
    if clock == "wall":
        return lambda: np.array([time.perf_counter()])
    threads = sorted(int(each.name) for each in TASKS.iterdir())
    # A thread's clock by its number, as Linux' clock_getcpuclockid makes it.
    clocks = [~thread << 3 | 6 for thread in threads]
    return lambda: np.array([time.clock_gettime(each) for each in clocks])
