"""Files, functions and constants that docs/architecture.md names exist."""

from __future__ import annotations

import re
from pathlib import Path

import splatseed

SOURCE = Path(splatseed.__file__).parent
ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "architecture.md").read_text("utf-8")
PATH = re.compile(
    r"`((?:[a-z_0-9]+/)+[a-z_0-9]+\.py)(?:: ([\w.]+))?`((?:,? (?:and )?`[A-Za-z_]\w*`)*)"
)
"""A file, perhaps a name in it, and more names of the same file."""


def test_named_files_hold_the_named_functions():
    found = PATH.findall(TEXT)
    assert len(found) > 40
    for path, name, others in found:
        file = SOURCE / path
        if not file.is_file():  # of the repository, such as a test
            file = ROOT / path
        text = file.read_text("utf-8")
        names = [name, *re.findall(r"`(\w+)`", others)] if name else []
        for each in (part for full in names if full for part in full.split(".")):
            assert re.search(rf"\b(?:def|class) {each}\b|^{each}\b", text, re.MULTILINE), (
                path,
                each,
            )
