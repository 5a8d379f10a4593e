"""Machine code from the cache is of the sources as they are, in every file that a kernel
reaches."""

from __future__ import annotations

import importlib
import os
import pickle
import subprocess
import sys

import pytest

from splatseed.runtime.jit import reached_files

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
CALL = """
from tiny.kernels import twice_shifted
value = twice_shifted(3.0)
print(value, len(twice_shifted.stats.cache_hits))
"""


@pytest.fixture
def tiny(tmp_path):
    """A package with a kernel that calls functions of a second file, which use constants of a
    third."""
    folder = tmp_path / "tiny"
    folder.mkdir()
    for name, text in FILES.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def called(tiny):
    """What the kernel returns in a new process, and how often it came from the cache."""
    run = subprocess.run(
        [sys.executable, "-c", CALL], capture_output=True, text=True, check=True, cwd=tiny.parent,
        env={**os.environ, "NUMBA_CACHE_DIR": str(tiny.parent / "cache")},
    )  # fmt: skip
    value, hits = run.stdout.split()
    return float(value), int(hits)


def test_a_kernel_is_compiled_again_when_a_file_that_it_reaches_changes(tiny):
    assert called(tiny) == (7.0, 0)
    for path in tiny.glob("*.py"):
        os.utime(path, (0, 0))  # as a new checkout of the same sources
    (tiny / "aside.py").write_text("UNUSED = 2.0\n")
    assert called(tiny) == (7.0, 1)
    (tiny / "numbers.py").write_text("SHIFT, HALF = 2.0, 0.5\n")
    assert called(tiny) == (8.0, 0)


def test_a_cache_that_names_what_is_gone_is_passed_over(tiny):
    assert called(tiny) == (7.0, 0)
    for index in (tiny.parent / "cache").rglob("*.nbi"):
        with index.open("rb") as file:
            version = pickle.load(file)  # noqa: S301  (our own)
        # What Numba wrote before kernels were keyed on their sources, of a type since moved.
        stale = pickle.dumps(version.partition(" ")[0]) + b"cgone.module\nVector\n."
        index.write_bytes(stale)
    assert called(tiny) == (7.0, 0)


def test_a_file_reaches_what_it_imports_directly_and_by_way_of_others(tiny, monkeypatch):
    monkeypatch.syspath_prepend(tiny.parent)
    importlib.import_module("tiny.kernels")
    importlib.import_module("tiny.aside")
    ours = {"tiny", "tiny.kernels", "tiny.middle", "tiny.numbers"}
    jit = {"splatseed.runtime.jit", "splatseed.runtime.compilation"}
    reached = reached_files("tiny.kernels")
    assert set(reached) == ours | jit
    assert reached["tiny.numbers"] == tiny / "numbers.py"
    importlib.import_module("splatseed.render.harmonics")
    reached = set(reached_files("splatseed.render.harmonics"))
    assert jit | {"splatseed.runtime.simd", "splatseed.runtime.shuffles"} <= reached
    assert "splatseed.cli" not in reached
    for name in ours | {"tiny.aside"}:
        del sys.modules[name]
