"""What the terminal shows, and what it must not break."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from splatseed import console
from splatseed.console import (
    StageClock,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.runtime import compilation

LONG = "/".join(["a_rather_long_folder_name"] * 9)


def test_a_stage_lasts_until_the_next_begins(monkeypatch):
    now = iter([0.0, 1.0, 4.0, 10.0])
    monkeypatch.setattr(console.time, "perf_counter", lambda: next(now))
    clock = StageClock()
    for stage, fraction in (("read", 0), ("read", 1), ("fit", 0), ("fit", 0.5), ("read", 0)):
        clock(stage, fraction)
    assert clock.seconds() == {"read": 1.0 + 6.0, "fit": 3.0}


def test_nothing_is_drawn_where_nobody_looks(capsys):
    with stage_display() as clock:
        clock("read", 0.5)
        clock.compilation(True)
        clock.compilation(True)  # they nest
        clock.compilation(False)
        clock.compilation(False)
    assert capsys.readouterr() == ("", "")
    assert list(clock.seconds()) == ["read", "compiling kernels"]


def test_a_log_is_told_once_of_compilation_that_takes_long(capsys, monkeypatch):
    now = iter(range(0, 1000, 10))
    monkeypatch.setattr(console.time, "perf_counter", lambda: float(next(now)))
    monkeypatch.setattr(console, "TOLD_AFTER", 3.0)
    with stage_display() as clock:
        clock("fit", 0.0)
        for _ in range(2):
            compilation.tell(begins=True)
            compilation.tell(begins=False)
    with stage_display(clock):
        clock("write", 0.0)
    out, err = capsys.readouterr()
    assert out == ""
    (last,) = err.splitlines()
    assert last == "compiling kernels took 20 s; cached for the next run"


@pytest.fixture
def terminal(monkeypatch):
    """What would have been drawn on stderr, were it a terminal."""
    drawn = io.StringIO()
    screen = Console(file=drawn, force_terminal=True, force_interactive=True, width=80)
    monkeypatch.setattr(console, "ERR", screen)
    return drawn


def test_a_terminal_sees_what_is_left(terminal):
    with stage_display(remaining=True) as clock:
        clock.expect("features", "matching", "mapping")
        clock("features", 0.5)
    drawn = [terminal.getvalue().rfind(stage) for stage in ("features", "matching", "mapping")]
    assert 0 <= drawn[0] < drawn[1] < drawn[2]
    assert list(clock.seconds()) == ["features"]


def test_a_terminal_sees_the_stages(terminal, capsys):
    with stage_display() as clock:
        clock("read", 1.0)
    with stage_display(clock):
        clock("write", 0.5)
    assert "read" in terminal.getvalue()
    assert "write" in terminal.getvalue()
    assert capsys.readouterr() == ("", "")
    assert list(clock.seconds()) == ["read", "write"]


def test_compilation_is_shown_once_and_taken_away(terminal):
    with stage_display() as clock:
        for _ in range(3):
            clock.compilation(True)
            clock.compilation(False)
        clock("fit", 0.1)
    assert "compiling kernels" in terminal.getvalue()


def test_the_bars_go_away_when_the_work_fails(terminal):
    clock = StageClock()

    def fail():
        with stage_display(clock):
            clock("read", 0.5)
            raise KeyError

    with pytest.raises(KeyError):
        fail()
    drawn = terminal.getvalue()
    assert drawn.rfind("\x1b[?25h") > drawn.rfind("\x1b[?25l") >= 0  # the cursor is back
    clock("write", 0.5)
    assert terminal.getvalue() == drawn


@pytest.mark.parametrize("text", [LONG, "[bold]no markup[/bold]", "a [3, 4] b", "3 x 4 = 12.5"])
def test_text_is_printed_as_it_is_on_one_line(text, capsys):
    print_pairs(text, [("label", text)])
    print_pairs(text, [("", text)])
    print_note(text)
    print_table(text, ("name", "value"), [("one", "1")])
    out = capsys.readouterr().out
    lines = [line for line in out.splitlines() if text in line]
    assert len(lines) == 6
    assert "\x1b" not in out


def test_a_table_in_a_file_cuts_no_name_short(capsys):
    name = "a photograph with quite a long name, taken at 1305031102.175304.png"
    header = ("image", *(f"column {i}" for i in range(8)))
    print_table("title", header, [(name, *"12345678")])
    assert name in capsys.readouterr().out
