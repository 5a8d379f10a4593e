"""How large splatseed may grow: what comes in makes room."""

from __future__ import annotations

import subprocess
from importlib import import_module
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.cli import VERBS
from splatseed.commands.bench import CompareOptions, ReportOptions

from .command_line import options_of

ROOT = Path(__file__).parents[1]

MOST_OPTIONS = 140
MOST_FILES = 260
MOST_LINES = {"src": 42_750, "tests": 24_400}
"""On the way to 42,000 and 22,000: these numbers only fall."""


def test_options_over_all_verbs():
    """Methods' own parameters are not counted, nor are positional words and ``--help``."""
    kinds = [import_module(f"splatseed.commands.{verb}").Options for verb in VERBS]
    counts = {each.__module__: len(options_of(each)) for each in kinds}
    counts["bench report and compare"] = len(options_of(ReportOptions)) + len(
        options_of(CompareOptions)
    )
    assert sum(counts.values()) <= MOST_OPTIONS, counts


@pytest.mark.parametrize("top", ["src", "tests"])
def test_lines(top):
    assert sum(path.read_bytes().count(b"\n") for path in _python_files(top)) <= MOST_LINES[top]


def test_files():
    assert len(_python_files("src")) <= MOST_FILES


def _python_files(top):
    """Those under version control."""
    run = subprocess.run(
        ["git", "ls-files", "-z", top], cwd=ROOT, capture_output=True, check=False, text=True
    )
    if run.returncode:
        pytest.skip("not a git checkout")
    paths = [ROOT / name for name in run.stdout.split("\0") if name.endswith(".py")]
    return [path for path in paths if path.is_file()]
