"""Each workaround works, and is still needed: these fail once the other library changes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

AT_ONCE = """
import os, sys, threading
import numba, numpy as np
from splatseed.runtime.jit import kernel, parallel_range

@kernel
def add_one(x):
    for i in parallel_range(len(x)):
        x[i] += 1.0

def call_often():
    x = np.zeros(1000)
    for _ in range(300):
        add_one(x)
    assert (x == 300).all()

def run(number):
    threads = [threading.Thread(target=call_often) for _ in range(number)]
    [each.start() for each in threads]
    if hasattr(os, "fork") and os.environ["NUMBA_THREADING_LAYER"] == "workqueue":
        child = os.fork()  # while others are in kernels
        if child == 0:
            call_often()
            os._exit(0)
        assert os.waitpid(child, 0)[1] == 0
    [each.join() for each in threads]

run(3)
add_one(np.zeros(1))
print(numba.threading_layer(), type(add_one).__name__)
"""


def _run(path, program, **variables):
    path.write_text(program)
    command = [sys.executable, "-W", "ignore", str(path)]
    environment = {**os.environ, **variables}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("layer", "called"), [("workqueue", "_OneAtATime"), ("omp", "CPUDispatcher")]
)
def test_python_threads_may_call_kernels_at_once(tmp_path, layer, called):
    """The lock costs other layers nothing."""
    variables = {"NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2"}
    run = _run(tmp_path / "at_once.py", AT_ONCE, **variables)
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [layer, called]


def test_numbas_workqueue_still_takes_one_loop_at_a_time(tmp_path):
    program = AT_ONCE.replace('hasattr(os, "fork")', "False")  # a child would outlive the crash
    unlocked = "add_one.__class__ = numba.core.registry.CPUDispatcher\nrun(3)"
    program = program.replace("run(3)", unlocked)
    run = _run(tmp_path / "crash.py", program, NUMBA_THREADING_LAYER="workqueue")
    assert run.returncode != 0
    assert "Concurrent access" in run.stderr


SLOW = """
import sys, time
from pathlib import Path
from splatseed.progress import watched
from splatseed.runtime.jit import inline

@inline
def add(x, y):
    return x + y

with watched(lambda begins: begins and time.sleep(1.0)):
    add(1.0, 2.0)
print(len(add.stats.cache_hits))
"""


def test_of_two_processes_one_compiles_and_the_other_loads(tmp_path):
    """Numba asks the cache and compiles within ``compile``, which the lock surrounds."""
    (tmp_path / "slow.py").write_text(SLOW)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, str(tmp_path / "slow.py")]
    runs = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(2)
    ]
    assert sorted(run.communicate(timeout=120)[0].strip() for run in runs) == ["0", "1"]


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="needs Linux")
def test_glibc_keeps_freed_memory_only_when_asked(tmp_path):
    program = """
import ctypes
from pathlib import Path
from splatseed.runtime.workarounds import keep_freed_memory
libc = ctypes.CDLL("libc.so.6")
libc.malloc.restype, libc.malloc.argtypes = ctypes.c_void_p, [ctypes.c_size_t]
libc.free.argtypes = [ctypes.c_void_p]
def kept():
    held = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * 4096
    before, size = held(), 24 << 20
    block = libc.malloc(size)
    ctypes.memset(block, 1, size)
    libc.free(block)
    return held() - before > size // 2
print(kept(), keep_freed_memory(), kept())
"""
    run = _run(tmp_path / "keep.py", program)
    assert run.stdout.split() == ["False", "True", "True"], run.stderr
