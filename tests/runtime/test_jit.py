"""Machine code from the cache is of the sources as they are, in every file that a kernel
reaches."""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys

import numba
import pytest

from splatseed.runtime import jit

FILES = {
    "__init__": "",
    "kernels": """
from splatseed.runtime.jit import inline

from tiny.middle import (
    halved,
    shifted,
)

@inline
def twice_shifted(x):
    return shifted(2.0 * x) + halved(0.0)
""",
    "middle": """
from splatseed.runtime.jit import inline
from . import numbers
from .numbers import SHIFT

@inline
def shifted(x):
    return x + SHIFT

@inline
def halved(x):
    return numbers.HALF * x
""",
    "numbers": "SHIFT, HALF = 1.0, 0.5\n",
    "aside": "UNUSED = 1.0\n",
}


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    """A package with a kernel that calls functions of a second file, which use constants of a
    third."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    yield folder
    forget()


def forget():
    """Forget the package, as a new process does."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "tiny"]:
        del sys.modules[name]
    importlib.invalidate_caches()
    jit._read.cache_clear()


def called():
    """What the kernel returns at its first call, and how often it came from the cache."""
    forget()
    function = importlib.import_module("tiny.kernels").twice_shifted
    return function(3.0), len(function.stats.cache_hits)


def test_a_kernel_is_compiled_again_when_a_file_that_it_reaches_changes(tiny):
    assert called() == (7.0, 0)
    for path in tiny.glob("*.py"):
        os.utime(path, (0, 0))  # as a new checkout of the same sources
    (tiny / "aside.py").write_text("UNUSED = 2.0\n")
    assert called() == (7.0, 1)
    (tiny / "numbers.py").write_text("SHIFT, HALF = 2.25, 0.5\n")
    assert called() == (8.25, 0)
    for index in (tiny.parent / "cache").rglob("*.nbi"):
        with index.open("rb") as file:
            version = pickle.load(file)  # noqa: S301  (our own)
        # What Numba wrote before kernels were keyed on their sources, of a type since moved.
        stale = pickle.dumps(version.partition(" ")[0]) + b"cgone.module\nVector\n."
        index.write_bytes(stale)
    assert called() == (8.25, 0)


def test_a_kernel_reaches_what_compiles_it_and_the_lanes_that_it_uses():
    importlib.import_module("splatseed.rendering.harmonics")
    reached = jit.reached_files("splatseed.rendering.harmonics").keys()
    assert "splatseed.cli" not in reached
    for name in ("jit", "compilation", "simd", "shuffles"):
        assert f"splatseed.runtime.{name}" in reached


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


@pytest.mark.parametrize(
    ("layer", "called"), [("workqueue", "_OneAtATime"), ("omp", "CPUDispatcher")]
)
def test_python_threads_may_call_kernels_at_once(tmp_path, layer, called):
    """Numba's workqueue layer ends the process by itself; the lock costs other layers nothing."""
    (tmp_path / "at_once.py").write_text(AT_ONCE)
    environment = {**os.environ, "NUMBA_THREADING_LAYER": layer, "NUMBA_NUM_THREADS": "2"}
    command = [sys.executable, "-W", "ignore", str(tmp_path / "at_once.py")]
    run = subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 0, run.stderr
    assert run.stdout.split() == [layer, called]
