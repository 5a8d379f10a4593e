"""Children import what we import, and nothing that lies in the working directory."""

from __future__ import annotations

import importlib
import os
import re
import sys
from pathlib import Path

import pytest

import splatseed
from splatseed.bench.running import child
from splatseed.bench.running.job import JobOptions
from splatseed.errors import ReconstructionError
from splatseed.process import tasks
from splatseed.sfm import worker

NAMES = ("numpy", "random", "json", "pickle", "splatseed", "wave")


@pytest.fixture
def trap(tmp_path, monkeypatch):
    """A working directory whose modules leave a mark when they are executed."""
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'mark')!r}, 'a').write({name!r})"
        )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")  # as in python -c and in a notebook
    return tmp_path


PROGRAM = f"import {', '.join(NAMES)}; print(splatseed.__file__)"


def test_the_worker_of_sfm(trap, monkeypatch):
    monkeypatch.setattr(worker, "_CHILD", f"{PROGRAM}; raise SystemExit(splatseed.__file__)")
    with pytest.raises(ReconstructionError, match=re.escape(splatseed.__file__)):
        worker.run_job(None, trap / "log", verbose=False, on_progress=print)
    assert not (trap / "mark").exists()


def test_the_processes_of_bench(trap, monkeypatch):
    monkeypatch.setattr(child, "PROGRAM", f"{PROGRAM}; raise SystemExit(splatseed.__file__)")
    process = child.Child(_Spec(), trap / "work", trap / "kept", JobOptions(), {})
    with pytest.raises(child.Killed, match=re.escape(splatseed.__file__)):
        process.wait(print)
    assert not (trap / "mark").exists()


class _Spec:
    """A run, of which only the text is needed."""

    def to_json(self):
        return "{}"


def test_no_other_module_starts_an_interpreter():
    folder = Path(splatseed.__file__).parent
    named = {path for path in folder.rglob("*.py") if "sys.executable" in path.read_text()}
    # Two name it in what they tell users to install, and start nothing.
    starts = {path.name for path in named if "-m pip" not in path.read_text()}
    assert starts == {"interpreter.py"}
    assert not any("subprocess" in path.read_text() for path in named if path.name not in starts)
    spawns = {path.name for path in folder.rglob("*.py") if "multiprocessing" in path.read_text()}
    assert spawns == {"interpreter.py", "tasks.py"}  # the former in words alone


def test_the_processes_of_tiles(trap):
    tasks.ProcessTasks(1, 1).run(importlib.import_module, [("wave",)], "stage", lambda *_: None)
    assert not (trap / "mark").exists()
    assert "PYTHONSAFEPATH" not in os.environ
    assert "" in sys.path
