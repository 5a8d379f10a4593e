"""The ledger: one worker a run, nothing done twice, nothing lost, whoever is killed."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time

import pytest

from splatseed.bench.planning.records import Arm, RunResult, RunSpec
from splatseed.bench.running import ledger as ledger_module, worker as worker_module
from splatseed.bench.running.ledger import Ledger
from splatseed.bench.running.worker import STALE_SECONDS, worker_name
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.scores import EvalResult, ViewScore
from splatseed.train.settings import TrainSettings

ARM = Arm("mls", "default", 8, "none")
SPECS = [
    RunSpec("room", "ab12", ARM, repeat=r, training=TrainSettings(max_steps=100)) for r in range(5)
]
SCORES = EvalResult((ViewScore("a.png", 21.5, 0.8, None, 0.01),), num_gaussians=8, model_bytes=1888)
RESULT = RunResult(SCORES, (), 7, 0.2, 1.5, 10**9, "CPU")
ME = worker_name()


@pytest.fixture
def ledger(tmp_path):
    ledger = Ledger.open(tmp_path / "ledger.sqlite")
    ledger.add(SPECS)
    return ledger


def _row(ledger, spec):
    return next(row for row in ledger.rows() if row.spec.key == spec.key)


def test_runs_are_handed_out_once_and_in_order(ledger):
    assert [ledger.claim(ME) for _ in range(6)] == [*SPECS, None]
    assert {row.status for row in ledger.rows()} == {"running"}
    assert {row.worker for row in ledger.rows()} == {ME}


def test_only_the_keys_that_are_asked_for_are_handed_out(ledger):
    assert ledger.claim(ME, {SPECS[3].key}) == SPECS[3]
    assert ledger.claim(ME, {SPECS[3].key}) is None


def test_what_is_done_is_kept_and_never_handed_out_again(ledger):
    first = ledger.claim(ME)
    assert ledger.finish(first.key, RESULT)
    other = dataclasses.replace(RESULT, num_seeds=0)
    assert not ledger.finish(first.key, other)
    ledger.fail(first.key, ME, "too late")
    ledger.add(SPECS)
    row = _row(ledger, first)
    assert (row.status, row.result, row.error) == ("done", RESULT, "")
    assert row.started <= row.finished <= time.time()
    assert first not in [ledger.claim(ME) for _ in range(6)]


def test_failed_runs_wait_to_be_asked_for_again(ledger):
    first = ledger.claim(ME)
    ledger.fail(first.key, ME, "no memory")
    assert (_row(ledger, first).status, _row(ledger, first).error) == ("failed", "no memory")
    assert first not in [ledger.claim(ME) for _ in range(5)]
    assert ledger.retry_failed({"another key"}) == 0
    assert ledger.retry_failed({first.key}) == 1
    assert ledger.claim(ME) == first
    assert _row(ledger, first).attempts == 2


def test_what_is_handed_back_comes_after_what_was_never_begun(ledger):
    first = ledger.claim(ME)
    ledger.release(first.key, ME)
    assert [ledger.claim(ME) for _ in range(6)] == [*SPECS[1:], first, None]


def test_nobody_ends_a_run_of_another_worker(ledger):
    first = ledger.claim(ME)
    ledger.fail(first.key, "else:1@", "not mine")
    ledger.release(first.key, "else:1@")
    assert _row(ledger, first).status == "running"


def test_a_run_is_handed_on_when_its_worker_is_silent(ledger, monkeypatch):
    first = ledger.claim("elsewhere:77@boot-1")
    later = time.time() + 0.9 * STALE_SECONDS
    monkeypatch.setattr(ledger_module.time, "time", lambda: later)
    assert ledger.claim(ME, {first.key}) is None
    ledger.heartbeat("elsewhere:77@boot-1")
    monkeypatch.setattr(ledger_module.time, "time", lambda: later + 0.9 * STALE_SECONDS)
    assert ledger.claim(ME, {first.key}) is None
    monkeypatch.setattr(ledger_module.time, "time", lambda: later + 1.1 * STALE_SECONDS)
    assert ledger.claim(ME, {first.key}) == first


def test_a_run_of_a_killed_process_is_handed_on_at_once(ledger):
    code = (
        "import sys, time; from pathlib import Path\n"
        "from splatseed.bench.running.ledger import Ledger\n"
        "from splatseed.bench.running.worker import worker_name\n"
        "Ledger.open(Path(sys.argv[1])).claim(worker_name()); print('claimed', flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", code, str(ledger.path)], stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "claimed\n"
        assert ledger.claim(ME, {SPECS[0].key}) is None
        process.send_signal(signal.SIGKILL)
    assert ledger.claim(ME, {SPECS[0].key}) == SPECS[0]


def test_process_numbers_of_elsewhere_prove_nothing():
    free = 2**22 + 1  # more than Linux hands out
    name, now = ME.replace(f":{os.getpid()}@", f":{free}@"), time.time()
    assert worker_module.is_gone(name, now, now)
    assert not worker_module.is_gone(f"{name}-other-boot", now, now)
    assert not worker_module.is_gone(ME, now, now)
    assert worker_module.is_gone(ME, now - 2 * STALE_SECONDS, now)


def test_many_workers_at_once_share_the_runs(ledger):
    more = [dataclasses.replace(SPECS[0], repeat=r) for r in range(5, 40)]
    ledger.add(more)
    taken, lock = [], threading.Lock()

    def work():
        own = Ledger.open(ledger.path)
        while spec := own.claim(ME):
            with lock:
                taken.append(spec.key)
            own.finish(spec.key, RESULT)

    threads = [threading.Thread(target=work) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(taken) == sorted(spec.key for spec in (*SPECS, *more))
    assert {row.status for row in ledger.rows()} == {"done"}


def test_a_killed_writer_is_undone_also_for_readers(ledger):
    """Its transaction has reached the file, and its journal lies beside it."""
    code = (
        "import os, signal, sqlite3, sys\n"
        "db = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
        "db.execute('PRAGMA cache_size = 1'); db.execute('BEGIN IMMEDIATE')\n"
        'db.execute("UPDATE runs SET error = hex(zeroblob(100000))")\n'
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(ledger.path)], check=False)
    journal = ledger.path.with_name("ledger.sqlite-journal")
    assert journal.stat().st_size > 0
    assert [row.error for row in Ledger.open(ledger.path, read_only=True).rows()] == [""] * 5
    assert not journal.exists()


def test_readers_change_nothing(ledger):
    before = ledger.path.read_bytes()
    reader = Ledger.open(ledger.path, read_only=True)
    assert len(reader.rows()) == 5
    with pytest.raises(OutputError, match="readonly"):
        reader.claim(ME)
    assert ledger.path.read_bytes() == before
    with pytest.raises(SceneNotFoundError, match="no such file"):
        Ledger.open(ledger.path.with_name("none.sqlite"), read_only=True)
    assert not ledger.path.with_name("none.sqlite").exists()


def test_sessions_are_kept(ledger):
    ledger.note_session({"command": "splatseed bench"})
    (session,) = ledger.sessions()
    assert session["command"] == "splatseed bench"
    assert session["started"] <= time.time()


def test_scenes_may_move(ledger):
    ledger.add([dataclasses.replace(SPECS[2], scene_path="moved")])
    assert len(ledger.rows()) == 5
    assert _row(ledger, SPECS[2]).spec.scene_path == "moved"


def test_foreign_damaged_and_newer_files_are_refused(ledger, tmp_path):
    newer = shutil.copy(ledger.path, tmp_path / "newer.sqlite")
    with sqlite3.connect(newer) as db:
        db.execute("PRAGMA user_version = 99")
    with pytest.raises(SceneFormatError, match="Update splatseed"):
        Ledger.open(newer)
    with sqlite3.connect(tmp_path / "foreign.sqlite") as db:
        db.execute("CREATE TABLE songs (title TEXT)")
    with pytest.raises(SceneFormatError, match="another program"):
        Ledger.open(tmp_path / "foreign.sqlite")
    text = tmp_path / "text.sqlite"
    text.write_text("not a database, however long it is" * 100)
    with pytest.raises(SceneFormatError, match="not a database"):
        Ledger.open(text)
    assert text.read_text().startswith("not a database")
    with pytest.raises(OutputError, match="ledger"):
        Ledger.open(tmp_path / "no folder" / "ledger.sqlite")


def test_a_ledger_of_the_old_layout_is_read_and_marked_when_it_is_written_to(ledger):
    """Its results have scores beside the rest, its runs no budget."""
    first = SPECS[0]
    spec = json.loads(first.to_json())
    del spec["arm"]["budget"]
    old = {
        "psnr": 21.5, "ssim": 0.8, "lpips": None, "curve": [], "num_seeds": 7, "num_gaussians": 8,
        "per_image": [{"name": "a.png", "psnr": 21.5, "ssim": 0.8, "lpips": None}],
        "model_bytes": 1888, "upsample_seconds": 0.2, "train_seconds": 1.5,
        "render_seconds": 0.01, "peak_bytes": 10**9, "device": "CPU", "peak_gpu_bytes": None,
    }  # fmt: skip
    with sqlite3.connect(ledger.path) as db:
        db.execute("PRAGMA user_version = 1")
        values = (json.dumps(spec), json.dumps(old), first.key)
        db.execute("UPDATE runs SET spec = ?, result = ?, status = 'done' WHERE key = ?", values)
    row = _row(Ledger.open(ledger.path, read_only=True), first)
    assert row.spec == first
    assert row.result == RESULT
    Ledger.open(ledger.path)
    with sqlite3.connect(ledger.path) as db:
        assert db.execute("PRAGMA user_version").fetchone() == (ledger_module.SCHEMA,)


def test_runs_of_an_unknown_layout_are_refused_with_a_sentence(ledger):
    with sqlite3.connect(ledger.path) as db:
        db.execute("UPDATE runs SET result = '{}', status = 'done' WHERE position = 1")
    with pytest.raises(SceneFormatError, match="run of another layout"):
        ledger.rows()
