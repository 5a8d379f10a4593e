"""Signals: the first waits for the end of a step, and the exit code says which it was."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace

import pytest

from splatseed.cli import VERBS, main
from splatseed.commands import bench, train, view
from splatseed.runtime.interruption import Interruption, exit_code, interruption


@pytest.fixture(autouse=True)
def _ctrl_c():
    """Ctrl-C as in a terminal: a suite in the background of a shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_the_exit_code_is_that_of_the_signal(number, code):
    with interruption() as stop:
        os.kill(os.getpid(), number)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert exit_code() == code


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_train_exits_with_it(number, code, tmp_path, monkeypatch, capsys):
    class Stopped:
        """A run that is told to stop in its first step."""

        state = type("State", (), {"step": 1})

        def train(self, _show):
            with interruption():
                os.kill(os.getpid(), number)
            return False

    monkeypatch.setattr(train, "_prepare", lambda *_: Stopped())
    monkeypatch.setattr(train, "_announce", lambda *_: None)
    monkeypatch.setattr(train, "require", lambda *_: None)
    with pytest.raises(SystemExit) as stop:
        main(["train", str(tmp_path), "-o", str(tmp_path / "run")])
    assert stop.value.code == code
    assert "--resume" in capsys.readouterr().err


def _stop(number):
    os.kill(os.getpid(), number)
    pytest.fail("the signal had no effect")


def test_a_viewer_is_ended_by_ctrl_c_and_told_of_sigterm(room_path, monkeypatch, splatseed):
    for number, code in ((signal.SIGINT, 0), (signal.SIGTERM, 143)):
        monkeypatch.setattr(view, "time", SimpleNamespace(sleep=lambda _, it=number: _stop(it)))
        run = splatseed("view", room_path, "--port", 0)
        assert (run.code, run.err) == (code, "")
        assert run.out.endswith("stopped\n")


STOPS = [(signal.SIGINT, 130), (signal.SIGTERM, 143)]


@pytest.mark.parametrize(("number", "code"), STOPS)
@pytest.mark.parametrize("words", [("bench", "--scenes", "demo"), ("tune", "demo")])
def test_what_trains_in_processes_exits_with_it(
    words, number, code, room_path, tmp_path, monkeypatch, splatseed
):
    class Stopped:
        """Runs that are told to stop while they are under way."""

        def __init__(self, *_, **__):
            pass

        def run(self, *_):
            with interruption():
                os.kill(os.getpid(), number)
            raise KeyboardInterrupt

    monkeypatch.setattr(bench, "ProcessTasks", Stopped)
    named = [room_path if word == "demo" else word for word in words]
    run = splatseed(*named, "-o", tmp_path / "out")
    assert (run.code, "Traceback" in run.err) == (code, False)


@pytest.mark.parametrize(("number", "code"), STOPS)
@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_exits_with_it(verb, number, code, monkeypatch, splatseed):
    def stopped(_words):
        os.kill(os.getpid(), number)

    monkeypatch.setattr(f"splatseed.commands.{verb}.run", stopped)
    monkeypatch.setattr(Interruption, "last", signal.SIGINT)
    run = splatseed(verb)
    assert (run.code, run.err.split()[0]) == (code, "interrupted;")
