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
    modules = [name for name in MODULES if not name.startswith("benchmarks.gpu.")]
    assert len(modules) > 20
    run = subprocess.run(
        [sys.executable, "-c", LOAD, *modules],
        cwd=ROOT,
        capture_output=True,
        check=False,
        text=True,
    )
    assert run.returncode == 0, run.stderr
