"""Tasks here and in processes: results, failures, deaths, interrupts, and what children import."""

from __future__ import annotations

import importlib
import math
import os
import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pytest

import splatseed
from splatseed.errors import ParameterError, TaskLostError
from splatseed.runtime.tasks import Child, HereTasks, ProcessTasks, slot_environment

from .task_functions import die, fail, raise_unpicklable

POSIX = pytest.mark.skipif(os.name != "posix", reason="needs signals")


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # where children find the functions


@pytest.mark.parametrize("tasks", [HereTasks(), ProcessTasks([slot_environment(1)])])
def test_a_failure_ends_no_other_task(tasks):
    told = []
    report = lambda *each: told.append(each)
    results = {each.index: each for each in tasks.run(fail, [("x",), ("",), ("bug",)], report)}
    assert results[1].error is None
    assert results[1].value in {0, 1}
    assert str(results[0].error) == "expected x; found it. Mend it."
    assert (type(results[0].error), type(results[2].error)) == (ParameterError, ValueError)
    assert {(1, "start", 0.0), (1, "half", 0.5), (2, "half", 0.5)} <= set(told)


@POSIX
def test_a_death_is_the_failure_of_its_task_alone_after_another_try(tmp_path):
    calls = [(when, tmp_path / "flag") for when in ("always", "once", "never")]
    first, *others = sorted(ProcessTasks([{}, {}]).run(die, calls), key=lambda each: each.index)
    assert isinstance(first.error, TaskLostError)
    assert "SIGABRT" in str(first.error)
    assert "no memory is left" in str(first.error)
    assert [each.value for each in others] == ["lived", "lived"]


INTERRUPTED = """
import sys
from pathlib import Path
from splatseed.runtime.tasks import ProcessTasks
from tests.runtime.task_functions import wait_for_term
results = ProcessTasks([{}]).run(wait_for_term, [(Path(sys.argv[1]),), (Path(sys.argv[2]),)])
try:
    for each in results:
        print(each.value, flush=True)
except KeyboardInterrupt:
    print("interrupted")
"""


@POSIX
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_an_interrupt_lets_a_task_save_and_a_kill_ends_it(number, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, "-c", INTERRUPTED, first, second]
    with subprocess.Popen(command, stdout=subprocess.PIPE, env=environment, text=True) as run:
        wait_until(first.exists)
        asked = ["ps", "-o", "pid=", "--ppid", str(run.pid)]
        child = int(subprocess.run(asked, capture_output=True, check=True, text=True).stdout)
        run.send_signal(number)
        saved = number == signal.SIGTERM
        assert run.communicate(timeout=60)[0] == ("saved\ninterrupted\n" if saved else "")
    assert not second.exists()  # no other is begun
    wait_until(lambda: not Path(f"/proc/{child}").exists())


def wait_until(holds):
    for _ in range(1200):
        if holds():
            return
        time.sleep(0.05)
    pytest.fail("waited in vain")


NAMES = ("numpy", "random", "json", "pickle", "splatseed", "wave")


def test_children_import_nothing_of_the_working_directory(tmp_path, monkeypatch):
    for name in NAMES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'mark')!r}, 'a').write({name!r})"
        )
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend("")  # as in python -c and in a notebook
    with closing(Child()) as child:
        for name in NAMES:
            child.call(exec, f"import {name}")
        assert child.call(eval, "__import__('splatseed').__file__") == splatseed.__file__
        assert child.call(math.sqrt, 4) == 2.0  # after what could not be pickled
        assert not (tmp_path / "mark").exists()
        with pytest.raises((AttributeError, TypeError, ValueError), match="pickle"):
            child.call(importlib.import_module, "math")
        with pytest.raises(TaskLostError):
            child.call(raise_unpicklable)
