"""Every benchmark can be loaded: most are too long to be run by a test."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FILES = [path.relative_to(ROOT) for path in sorted((ROOT / "benchmarks").rglob("*.py"))]
MODULES = [".".join(path.with_suffix("").parts) for path in FILES if path.stem != "__init__"]
LOAD = "import importlib, sys; [importlib.import_module(name) for name in sys.argv[1:]]"


def test_every_benchmark_finds_what_it_imports():
    pytest.importorskip("gsplat", reason="some need PyTorch and gsplat's strategies")
    assert len(MODULES) > 20
    run = subprocess.run(
        [sys.executable, "-c", LOAD, *MODULES],
        cwd=ROOT,
        capture_output=True,
        check=False,
        text=True,
    )
    assert run.returncode == 0, run.stderr


def test_without_a_gpu_its_benchmark_is_one_sentence():
    torch = pytest.importorskip("torch", reason="it asks PyTorch for a GPU")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    run = subprocess.run(
        [sys.executable, "-m", "benchmarks.gpu"],
        cwd=ROOT,
        capture_output=True,
        check=False,
        text=True,
    )
    assert (run.returncode, run.stdout) == (2, "")
    assert run.stderr == (
        "expected a GPU; found none that PyTorch sees. Run this on a machine that has one.\n"
    )
