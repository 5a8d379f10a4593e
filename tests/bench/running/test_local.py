"""The local executor: processes that die, that are stopped, that fail; and what each is given.

The processes are real; all but the last of them do what a short program says instead of training.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from splatseed.bench.planning.records import Arm, RunResult, RunSpec
from splatseed.bench.running import child
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.local import LocalExecutor
from splatseed.bench.running.watcher import Watcher
from splatseed.errors import OutputError
from splatseed.process.threads import slot_environment
from splatseed.scores import EvalResult, ViewScore
from splatseed.train.settings import TrainSettings

ARM = Arm("mls", "default", 8, "none")
SPECS = [
    RunSpec("room", "ab12", ARM, repeat=r, training=TrainSettings(max_steps=100)) for r in range(4)
]
KEYS = {spec.key for spec in SPECS}
SCORES = EvalResult((ViewScore("a.png", 21.5, 0.8, None, 0.01),), num_gaussians=8, model_bytes=1888)
RESULT = RunResult(SCORES, (), 7, 0.2, 1.5, 10**9, "CPU")

START = f"""
import json, os, signal, sys, time
from pathlib import Path
order = json.loads(sys.stdin.readline())
work, repeat = Path(order["work"]), json.loads(order["spec"])["repeat"]
begun = work.with_suffix(".begun")
times = len(begun.read_text()) if begun.exists() else 0
begun.write_text("x" * (times + 1))
def say(**message):
    print(json.dumps(message), flush=True)
def done():
    say(status="done", result={RESULT.to_json()!r}, error="")
say(stage="train", fraction=0.5)
"""


@pytest.fixture
def bench(tmp_path):
    ledger = Ledger.open(tmp_path / "ledger.sqlite")
    ledger.add(SPECS)
    return tmp_path


class Heard(Watcher):
    """Remembers what it is told, and may do something about it."""

    def __init__(self, on_progress=lambda: None):
        self.said = []
        self._on_progress = on_progress

    def begun(self, spec):
        self.said.append(("begun", spec.repeat))

    def progress(self, spec, stage, fraction):
        assert (stage, fraction) == ("train", 0.5)
        self._on_progress()

    def done(self, spec, result):
        self.said.append(("done", spec.repeat))

    def failed(self, spec, error):
        self.said.append(("failed", spec.repeat))

    def handed_back(self, spec, reason):
        self.said.append(("back", spec.repeat))


def _run(bench, monkeypatch, program, *, jobs=1, watcher=None):
    """Whether it went to the end, and the ledger's rows after."""
    monkeypatch.setattr(child, "PROGRAM", START + program)
    ledger = Ledger.open(bench / "ledger.sqlite")
    environments = [slot_environment(1 + i) for i in range(jobs)]
    executor = LocalExecutor(ledger, bench, environments, watcher=watcher)
    return executor.run(KEYS), ledger.rows()


def test_runs_are_done_and_told_of(bench, monkeypatch):
    heard = Heard()
    ended, rows = _run(bench, monkeypatch, "done()", watcher=heard)
    assert ended
    assert [(row.status, row.attempts) for row in rows] == [("done", 1)] * 4
    assert rows[0].result == RESULT
    assert heard.said == [(what, i) for i in range(4) for what in ("begun", "done")]
    assert not list((bench / "work").glob("*.log"))


def test_a_killed_process_is_tried_again_after_the_others(bench, monkeypatch):
    heard = Heard()
    program = "os.kill(os.getpid(), signal.SIGKILL) if repeat == 0 and not times else done()"
    ended, rows = _run(bench, monkeypatch, program, watcher=heard)
    assert ended
    assert [(row.status, row.attempts) for row in rows] == [("done", 2)] + [("done", 1)] * 3
    assert heard.said[:2] == [("begun", 0), ("back", 0)]
    assert heard.said[-2:] == [("begun", 0), ("done", 0)]


def test_a_process_that_is_killed_each_time_fails_alone(bench, monkeypatch):
    program = "os.kill(os.getpid(), signal.SIGKILL) if repeat == 1 else done()"
    ended, rows = _run(bench, monkeypatch, program, jobs=2)
    assert ended
    assert [row.status for row in rows] == ["done", "failed", "done", "done"]
    assert rows[1].attempts == 2
    assert "killed by SIGKILL, 2 times; out of memory?" in rows[1].error


def test_a_process_that_ends_without_a_word_is_quoted(bench, monkeypatch):
    ended, rows = _run(bench, monkeypatch, "sys.exit('no such library') if repeat else done()")
    assert ended
    assert [row.status for row in rows] == ["done"] + ["failed"] * 3
    assert "exit code 1: no such library, 2 times" in rows[1].error


def test_a_failed_run_does_not_end_the_rest(bench, monkeypatch):
    program = "say(status='failed', result=None, error='too few') if repeat == 2 else done()"
    ended, rows = _run(bench, monkeypatch, program)
    assert ended
    assert [(row.status, row.error, row.attempts) for row in rows][2] == ("failed", "too few", 1)
    assert [row.status for row in rows].count("done") == 3


INTERRUPTIBLE = """
def stop(*_):
    say(status="interrupted", result=None, error="")
    sys.exit()
signal.signal(signal.SIGTERM, stop)
say(stage="train", fraction=0.5)
time.sleep(60)
"""


def test_ctrl_c_stops_the_runs_and_hands_them_back(bench, monkeypatch):
    words = iter(range(1, 5))  # two from each of two processes

    def stop_when_all_can():
        if next(words) == 4:
            os.kill(os.getpid(), signal.SIGINT)

    heard = Heard(stop_when_all_can)
    ended, rows = _run(bench, monkeypatch, INTERRUPTIBLE, jobs=2, watcher=heard)
    assert not ended
    assert sorted(heard.said) == [("back", 0), ("back", 1), ("begun", 0), ("begun", 1)]
    assert [(row.status, row.attempts) for row in rows] == [("pending", 1)] * 2 + [
        ("pending", 0)
    ] * 2


def test_ctrl_c_twice_stops_at_once(bench, monkeypatch):
    program = "signal.signal(signal.SIGTERM, lambda *_: say(stage='train', fraction=0.5))\n"
    program += "[time.sleep(60) for _ in range(9)]"
    start = time.monotonic()
    heard = Heard(lambda: os.kill(os.getpid(), signal.SIGINT))
    ended, rows = _run(bench, monkeypatch, program, watcher=heard)
    assert not ended
    assert time.monotonic() - start < 30
    assert [row.status for row in rows] == ["pending"] * 4


def test_each_process_knows_its_share_of_the_machine(bench, monkeypatch):
    names = "['NUMBA_NUM_THREADS', 'OMP_NUM_THREADS', 'OMP_WAIT_POLICY', 'CUDA_VISIBLE_DEVICES']"
    program = f"""
work.with_suffix(".env").write_text(json.dumps([os.environ.get(n, "") for n in {names}]))
done()
"""
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    _run(bench, monkeypatch, program)
    seen = [json.loads(path.read_text()) for path in (bench / "work").glob("*.env")]
    assert seen == [["1", "1", "passive", ""]] * 4
    assert slot_environment(3, "2")["CUDA_VISIBLE_DEVICES"] == "2"


def test_a_ledger_that_cannot_be_written_ends_it_with_an_error(bench, monkeypatch):
    def full(*_):
        raise OutputError("a disk", found="a full one", fix="Empty it.")

    monkeypatch.setattr(Ledger, "finish", full)
    with pytest.raises(OutputError, match="a full one"):
        _run(bench, monkeypatch, "done()", jobs=2)


def test_a_process_ends_with_its_parent(tmp_path):
    """The real program, held up where it would read its scene."""
    code = f"""
import sys
from pathlib import Path
from splatseed.bench.running import child
from splatseed.bench.running.job import JobOptions
from splatseed.bench.planning.records import Arm, RunSpec
child.PROGRAM = '''
import os, sys, time
from splatseed.bench.running import job
def wait(spec):
    print(os.getpid(), file=sys.stderr, flush=True)
    time.sleep(60)
job.scene_of = wait
''' + child.PROGRAM
spec = RunSpec("room", "ab12", Arm("mls", "default", 8, "none"), 0)
here = Path({str(tmp_path)!r})
one = child.Child(spec, here / "one", here / "kept", JobOptions(), {{}})
one.wait(lambda stage, part: None)
"""
    with subprocess.Popen([sys.executable, "-c", code]) as parent:
        log = tmp_path / "one.log"
        until = time.monotonic() + 60
        while not (log.is_file() and log.read_text().endswith("\n")):
            assert time.monotonic() < until, "the process did not begin"
            time.sleep(0.05)
        process = int(log.read_text())
        assert Path(f"/proc/{process}").exists() or sys.platform != "linux"
        parent.kill()
    until = time.monotonic() + 20
    while _is_alive(process):
        assert time.monotonic() < until, "the process outlived its parent"
        time.sleep(0.05)


def _is_alive(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    try:  # dead, and waiting for somebody to ask how
        return Path(f"/proc/{process}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False
