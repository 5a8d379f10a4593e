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
from splatseed.errors import OutputError, ParameterError, TaskLostError
from splatseed.progress import silent
from splatseed.runtime.tasks import Child, HereTasks, ProcessTasks, slot_environment

POSIX = pytest.mark.skipif(os.name != "posix", reason="needs signals")


def fail(what, progress=silent):
    progress("half", 0.5)
    if what == "bug":
        raise ValueError(what)
    if what:
        raise ParameterError(what, found="it", fix="Mend it.")
    return len(os.environ.get("OMP_NUM_THREADS", ""))


def die_once(flag):
    if not flag.exists():
        flag.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return "lived"


def die_or_not(dies):
    if dies:
        os.write(2, b"no memory is left")
        os.abort()
    time.sleep(1)
    return "lived"


def wait_for_term(flag):
    signal.signal(signal.SIGTERM, lambda *_: flag.with_suffix(".saved").touch())
    flag.touch()
    for _ in range(600):
        if flag.with_suffix(".saved").exists():
            return "saved"
        time.sleep(0.1)
    return "not asked"


@pytest.fixture(autouse=True)
def _importable(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2])  # where children find this file


@pytest.mark.parametrize("tasks", [HereTasks(), ProcessTasks([slot_environment(1)] * 2)])
def test_a_failure_ends_no_other_task(tasks):
    told = []
    report = lambda *each: told.append(each)
    results = {each.index: each for each in tasks.run(fail, [("",), ("x",), ("bug",)], report)}
    assert results[0].error is None
    assert results[0].value in {0, 1}
    assert str(results[1].error) == "expected x; found it. Mend it."
    assert (type(results[1].error), type(results[2].error)) == (ParameterError, ValueError)
    assert {(0, "start", 0.0), (0, "half", 0.5), (2, "half", 0.5)} <= set(told)
    with pytest.raises(ParameterError):
        tasks.run_all(fail, [("",), ("x",)], "stage", silent)


@POSIX
def test_a_death_is_the_failure_of_its_task_alone_after_another_try(tmp_path):
    tasks = ProcessTasks([{}, {}], fresh=True)
    (once,) = tasks.run(die_once, [(tmp_path / "flag",)])
    assert once.value == "lived"
    results = {each.index: each for each in tasks.run(die_or_not, [(True,), (False,), (False,)])}
    assert isinstance(results[0].error, TaskLostError)
    assert "SIGABRT" in str(results[0].error)
    assert "no memory is left" in str(results[0].error)
    assert (results[1].value, results[2].value) == ("lived", "lived")


INTERRUPTED = """
import sys
from pathlib import Path
from splatseed.runtime.tasks import ProcessTasks
from tests.runtime.test_tasks import wait_for_term
results = ProcessTasks([{}]).run(wait_for_term, [(Path(sys.argv[1]),), (Path(sys.argv[2]),)])
try:
    for each in results:
        print(each.value, flush=True)
except KeyboardInterrupt:
    print("interrupted")
"""


def _started(flag, *words):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    run = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED, *map(str, words)],
        stdout=subprocess.PIPE, env=environment, text=True,
    )  # fmt: skip
    for _ in range(300):
        if flag.exists():
            return run
        time.sleep(0.1)
    pytest.fail("no task was begun")


@POSIX
def test_an_interrupt_lets_a_task_save_and_begins_no_other(tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    with _started(first, first, second) as run:
        run.send_signal(signal.SIGTERM)
        assert run.communicate(timeout=60)[0] == "saved\ninterrupted\n"
    assert not second.exists()


@POSIX
def test_children_end_with_their_parent(tmp_path):
    with _started(tmp_path / "flag", tmp_path / "flag", tmp_path / "other") as run:
        asked = ["ps", "-o", "pid=", "--ppid", str(run.pid)]
        child = int(subprocess.run(asked, capture_output=True, check=True, text=True).stdout)
        run.kill()
    for _ in range(200):
        if not Path(f"/proc/{child}").exists():
            return
        time.sleep(0.1)
    pytest.fail("the child goes on")


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


def test_no_other_module_starts_a_process():
    folder = Path(splatseed.__file__).parent
    texts = {path.name: path.read_text("utf-8") for path in folder.rglob("*.py")}
    # Some name it in what they tell users to install, and start nothing.
    starts = {name for name, text in texts.items() if "[sys.executable" in text}
    assert starts <= {"tasks.py", "child.py"}
    assert not any("multiprocessing" in text for text in texts.values())


def raise_unpicklable():
    """What cannot be carried over is an error, not a hang."""
    error = OutputError("a", found="b", fix="c")
    error.fix = lambda: None
    raise error


def test_what_cannot_be_pickled_is_an_error():
    with closing(Child()) as child:
        with pytest.raises((AttributeError, TypeError, ValueError), match="pickle"):
            child.call(importlib.import_module, "math")
        with pytest.raises(TaskLostError):
            child.call(raise_unpicklable)
