"""The commands in docs/depth.md and docs/stereo.md are ones that the command line has."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from splatseed.cli import VERBS, main

DOCS = Path(__file__).parents[2] / "docs"
TEXT = "".join((DOCS / name).read_text("utf-8") for name in ("depth.md", "stereo.md"))
LINES = [
    shlex.split(line, comments=True)
    for block in re.findall(r"```sh\n(.*?)```", TEXT, re.DOTALL)
    for line in block.splitlines()
    if line.startswith("splatseed")
]


@pytest.fixture(scope="module")
def known():
    """The help of each verb, printed once."""
    import contextlib
    import io

    def text(verb):
        said = io.StringIO()
        with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
            main([verb, "--help"])
        return said.getvalue()

    return {verb: text(verb) for verb in {line[1] for line in LINES}}


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_verbs_and_flags_are_there(line, known):
    assert line[1] in VERBS
    for word in line[2:]:
        if word.startswith("-"):
            assert re.search(rf"{re.escape(word)}\b", known[line[1]]), word
