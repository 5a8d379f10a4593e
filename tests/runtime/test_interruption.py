"""Signals: the first waits for the end of a step, and the exit code says which it was."""

from __future__ import annotations

import os
import signal
from types import SimpleNamespace

import pytest

from splatseed.cli import VERBS
from splatseed.commands import view
from splatseed.runtime.interruption import Interruption, exit_code, interruption

STOPS = pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])


@pytest.fixture(autouse=True)
def _ctrl_c():
    """Ctrl-C as in a terminal: a suite in the background of a shell has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def _stop(number):
    os.kill(os.getpid(), number)
    pytest.fail("the signal had no effect")


@STOPS
def test_the_exit_code_is_that_of_the_signal(number, code):
    with interruption() as stop:
        os.kill(os.getpid(), number)
        assert stop.requested
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), number)
    assert exit_code() == code


def test_a_viewer_is_ended_by_ctrl_c_and_told_of_sigterm(room_path, monkeypatch, splatseed):
    for number, code in ((signal.SIGINT, 0), (signal.SIGTERM, 143)):
        monkeypatch.setattr(view, "time", SimpleNamespace(sleep=lambda _, it=number: _stop(it)))
        run = splatseed("view", room_path, "--port", 0)
        assert (run.code, run.err) == (code, "stopped\n")


@STOPS
@pytest.mark.parametrize("verb", VERBS)
def test_every_verb_exits_with_it(verb, number, code, monkeypatch, splatseed):
    monkeypatch.setattr(f"splatseed.commands.{verb}.run", lambda _words: _stop(number))
    monkeypatch.setattr(Interruption, "last", signal.SIGINT)
    run = splatseed(verb)
    assert (run.code, run.err.split()[0]) == (code, "interrupted;")
