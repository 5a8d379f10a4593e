"""Names of files come to the terminal as they are, and into commands as one word."""

from __future__ import annotations

import shutil
import subprocess
from io import StringIO
from pathlib import Path

import pytest
from hypothesis import given, strategies as st

import splatseed
from splatseed import console
from splatseed.console import LiteralConsole, print_note, print_pairs, print_table
from splatseed.literal import quoted, visible

EVIL = "a\x1b[31mb\x1b]0;title\x07 :fire: [red]c[/red] \u202ereversed\rd\n{e} \\ ' \"f"
SHOWN = r"a\x1b[31mb\x1b]0;title\x07 :fire: [red]c[/red] \u202ereversed\rd\n{e} \ ' \"f".replace(
    r"\"", '"'
)


@pytest.fixture
def out(monkeypatch):
    """What goes to a terminal of 400 columns."""
    written = StringIO()
    screen = LiteralConsole(file=written, force_terminal=True, width=400, color_system=None)
    monkeypatch.setattr(console, "OUT", screen)
    return written


@pytest.mark.parametrize(
    "show",
    [
        lambda: print_note(EVIL),
        lambda: print_pairs(EVIL, [("what", "")]),
        lambda: print_pairs("", [("what", EVIL)]),
        lambda: print_table("", ("what",), [(EVIL,)]),
    ],
)
def test_what_is_printed_is_literal(show, out):
    show()
    assert SHOWN in out.getvalue()
    assert "\x1b" not in out.getvalue().replace("\x1b[0m", "")


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
    names = [
        EVIL,
        "a b",
        "$(touch x)",
        "`x`",
        "~",
        "*",
        "it's",
        "-rf",
        "a\udcffb",
        "\x01",
        "é\n",
        "x\\'\n",
    ]
    words = " ".join(map(quoted, names))
    done = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {words}".encode("utf-8", "surrogateescape")],
        capture_output=True, check=True,
    )  # fmt: skip
    read = done.stdout.decode("utf-8", "surrogateescape").split("\0")[:-1]
    assert [each.removeprefix("./") for each in read] == names
