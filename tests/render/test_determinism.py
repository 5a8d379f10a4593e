"""The same bytes, forward and backward, whatever the threads and wherever the kernels come from."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numba
import pytest

from .digest import digest


@pytest.fixture(scope="module")
def expected() -> str:
    return digest()


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="this machine has one thread")
@pytest.mark.parametrize("threads", [1, 2])
def test_any_number_of_threads(expected: str, threads: int) -> None:
    before = numba.get_num_threads()
    numba.set_num_threads(threads)
    try:
        assert digest() == expected
    finally:
        numba.set_num_threads(before)


def test_freshly_compiled_and_loaded_from_the_cache(expected: str, tmp_path: Path) -> None:
    """A new process with an empty cache compiles; a second one loads what the first has left."""
    assert _in_new_process(tmp_path) == expected
    compiled = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")}
    assert compiled
    assert _in_new_process(tmp_path) == expected
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.nbc")} == compiled


def _in_new_process(cache: Path) -> str:
    script = Path(__file__).with_name("digest.py")
    run = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, check=True,
        env={**os.environ, "NUMBA_CACHE_DIR": str(cache)},
    )  # fmt: skip
    name, value = run.stdout.split()
    assert name == "digest"
    return value
