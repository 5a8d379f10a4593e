"""Tasks in child processes: results, failures, deaths, interrupts, and imports."""

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
from splatseed.runtime.child import Child
from splatseed.runtime.environment import worker_env
from splatseed.runtime.tasks import ProcessWorkers, run_tasks

from .task_functions import die, fail, import_all, raise_unpicklable

POSIX = pytest.mark.skipif(os.name != "posix", reason="needs signals")


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # where children find the functions


def test_a_failed_task_does_not_affect_the_others():
    reported = []
    report = lambda *each: reported.append(each)
    calls = [("x",), ("",), ("bug",)]
    ended = run_tasks(ProcessWorkers([worker_env(1)]), fail, calls, report)
    results = {each.index: each for each in ended}
    assert results[1].error is None
    assert results[1].value == 1  # digit of OMP_NUM_THREADS
    assert str(results[0].error) == "expected x; found it. Mend it."
    assert (type(results[0].error), type(results[2].error)) == (ParameterError, ValueError)
    assert {(1, "start", 0.0), (1, "half", 0.5), (2, "half", 0.5)} <= set(reported)


@POSIX
def test_a_task_whose_process_dies_is_tried_once_more(tmp_path):
    calls = [(when, tmp_path / "flag") for when in ("always", "once", "never")]
    ended = run_tasks(ProcessWorkers([{}, {}]), die, calls)
    first, *others = sorted(ended, key=lambda each: each.index)
    assert isinstance(first.error, TaskLostError)
    assert "SIGABRT" in str(first.error)
    assert "no memory is left" in str(first.error)
    assert [each.value for each in others] == ["lived", "lived"]


INTERRUPTED = """
import sys
from pathlib import Path
from splatseed.runtime.tasks import ProcessWorkers, run_tasks
from tests.runtime.task_functions import wait_for_term
calls = [(Path(sys.argv[1]),), (Path(sys.argv[2]),)]
results = run_tasks(ProcessWorkers([{}]), wait_for_term, calls)
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
    assert in_child(import_all, NAMES) == splatseed.__file__
    assert in_child(math.sqrt, 4) == 2.0
    assert not (tmp_path / "mark").exists()


def in_child(function, *arguments):
    with closing(Child(function, *arguments)) as child:
        return child.result()


def test_what_cannot_be_pickled_is_an_error():
    with pytest.raises((AttributeError, TypeError, ValueError), match="pickle"):
        in_child(importlib.import_module, "math")
    with pytest.raises(TaskLostError):
        in_child(raise_unpicklable)
