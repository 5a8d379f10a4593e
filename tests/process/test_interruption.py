"""Signals: the first waits for the end of a step, and the exit code says which it was."""

from __future__ import annotations

import os
import signal

import pytest

from splatseed.cli import main
from splatseed.commands.bench import command as bench
from splatseed.commands.train import command as train
from splatseed.process.interruption import exit_code, interruption


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


def test_bench_exits_with_it_too():
    assert bench.exit_code is exit_code
