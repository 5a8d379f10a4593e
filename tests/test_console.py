"""What the terminal shows, what it must not break, and names that come to it as they are."""

from __future__ import annotations

import dataclasses
import io
import shutil
import subprocess
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from rich.console import Console

import splatseed
from splatseed import console, progress
from splatseed.console import (
    StageClock,
    print_note,
    print_pairs,
    print_table,
    show_extraction,
    stage_display,
)
from splatseed.findings import Finding
from splatseed.progress import extraction_progress, silent
from splatseed.text import quoted, visible
from splatseed.training.settings import TrainSettings

LONG = "/".join(["a_rather_long_folder_name"] * 9)
EVIL = "a\x1b[31mb\x1b]0;title\x07 :fire: [red]c[/red] \u202ereversed\rd\n{e} \\ ' \"f"
SHOWN = r"""a\x1b[31mb\x1b]0;title\x07 :fire: [red]c[/red] \u202ereversed\rd\n{e} \ ' "f"""


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


def test_a_log_has_a_line_per_stage_with_its_count(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(console.time, "perf_counter", lambda: now[0])
    with stage_display(lines=True) as clock:
        clock.count(2000, "photographs", "features")
        for seconds, stage, fraction in (
            *((0, "prepare", 0), (0, "features", 0), (20, "features", 0.2)),
            *((40, "features", 0.4), (50, "features", 0.5), (62, "features", 1.0)),
            *((62, "features", 1.0), (62, "mapping", 0.0), (64.5, "mapping", 1.0)),
        ):
            now[0] = seconds
            clock(stage, fraction)
    assert capsys.readouterr().err.splitlines() == [
        "features: 800 of 2,000 photographs, 40 s",
        "features: 2,000 photographs, 62 s",
        "mapping: done, 2.5 s",
    ]


def test_extraction_is_shown_whichever_call_causes_it(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(console.time, "perf_counter", lambda: now[0])

    def extract(stage):
        for seconds, fraction in ((1, 0.0), (32, 0.5), (2, 1.0), (1, 1.0)):  # counted too few
            now[0] += seconds
            extraction_progress.get(silent)(stage, fraction)

    with show_extraction():
        extract("write frames")
        with stage_display(lines=True) as clock:
            extract("analyse video")
        with stage_display():  # shows nothing, so the one around it does
            extract("write frames")
    extract("nobody looks")
    assert list(clock.seconds()) == ["analyse video"]
    assert capsys.readouterr().err.splitlines() == [
        *(f"{stage}: {done}" for stage in ("write frames", "analyse video", "write frames")
          for done in ("50%, 32 s", "done, 34 s")),
    ]  # fmt: skip


def test_a_log_is_told_once_of_compilation_that_takes_long(capsys, monkeypatch):
    now = iter(range(0, 1000, 10))
    monkeypatch.setattr(console.time, "perf_counter", lambda: float(next(now)))
    monkeypatch.setattr(console, "MIN_LOGGED_COMPILATION", 3.0)
    with stage_display() as clock:
        clock("fit", 0.0)
        for _ in range(2):
            progress.notify(begins=True)
            progress.notify(begins=False)
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


def test_a_terminal_sees_the_stages_and_what_is_left(terminal, capsys):
    with stage_display(remaining=True) as clock:
        clock.expect("features", "matching", "mapping")
        clock("features", 0.5)
        for _ in range(3):
            clock.compilation(True)
            clock.compilation(False)
    drawn = [terminal.getvalue().rfind(stage) for stage in ("features", "matching", "mapping")]
    assert 0 <= drawn[0] < drawn[1] < drawn[2]
    assert "compiling kernels" in terminal.getvalue()
    with stage_display(clock):
        clock("write", 0.5)
    assert "write" in terminal.getvalue()
    assert capsys.readouterr() == ("", "")
    assert list(clock.seconds()) == ["features", "compiling kernels", "write"]


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


LITERAL = (LONG, "[bold]no markup[/bold]", "a [3, 4] b", "3 x 4 = 12.5")


@pytest.mark.parametrize(("text", "shown"), [*zip(LITERAL, LITERAL, strict=True), (EVIL, SHOWN)])
def test_text_is_printed_as_it_is_on_one_line(text, shown, capsys):
    print_pairs(text, [("label", text), ("", text)])
    print_note(Finding("a-kind", text))
    print_table(text, ("image", *(f"column {i}" for i in range(8))), [(text, *"12345678")])
    out = "".join(capsys.readouterr())
    assert sum(shown in line for line in out.splitlines()) == 6  # also in a table in a file
    assert "\x1b" not in out


def test_all_that_is_printed_goes_through_the_literal_console():
    for path in Path(splatseed.__file__).parent.rglob("*.py"):
        text = path.read_text("utf-8")
        if path.name != "console.py":
            assert "rich.console" not in text, path
            assert "TextColumn" not in text or "markup=False" in text, path


def test_languages_stay_readable():
    name = "日本語\u3000写真 Ελλάδα ñ 📷.jpg"
    assert visible(name) == name
    assert quoted(name) == f"'{name}'"


@given(
    st.text(st.characters(exclude_characters="\0"), min_size=1).filter(lambda t: t[0] < "\ud800")
)
def test_visible_text_has_nothing_that_acts(text):
    assert not any(ord(each) < 32 or 127 <= ord(each) < 160 for each in visible(text))


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs a shell")
def test_a_shell_reads_quoted_names_back():
    names = ["a b", "$(touch x)", "`x`", "~", "*", "it's", "-rf"]
    names += [EVIL, "a\udcffb", "\x01", "é\n", "x\\'\n"]
    words = " ".join(map(quoted, names))
    done = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {words}".encode("utf-8", "surrogateescape")],
        capture_output=True, check=True,
    )  # fmt: skip
    read = done.stdout.decode("utf-8", "surrogateescape").split("\0")[:-1]
    assert [each.removeprefix("./") for each in read] == names


def test_arguments_of_the_library_are_printed_as_options(capsys):
    text = "Pass `data_factor=1`, `scene` or `cap_max=9`; not a`b`, `A` or `a b`."
    print_note(Finding("a-kind", text))
    said = "Pass --data-factor 1, --scene or --budget 9; not a--b, `A` or `a b`."
    assert capsys.readouterr().err == f"note: {said}\n"
    options = {
        "`overwrite=True`": "--overwrite",
        "`depth.align=False`": "--depth.no-align",
        "`masks='my masks'`": "--masks 'my masks'",
        "`masks=FILE`": "--masks FILE",
        "`mls.k=8`": "--mls.k 8",
        "`sh_degree`": "sh_degree",
        "`sh_degree=2`": "`sh_degree = 2` in a --config file",
        "`opacity_reset=True`": "`opacity_reset = true` in a --config file",
    }
    for argument, option in options.items():
        assert console.with_options(argument) == option


def test_settings_that_are_no_options_are_known(splatseed):
    options = splatseed("train", "--help").out
    names = {field.name for field in dataclasses.fields(TrainSettings)}
    flags = {name: console.OPTIONS.get(name, name).replace("_", "-") for name in names}
    assert {n for n, flag in flags.items() if f"--{flag} " not in options} == console.FILE_SETTINGS
