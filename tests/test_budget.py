"""How large splatseed may grow: what comes in makes room."""

from __future__ import annotations

from importlib import import_module

import pytest

pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.cli import VERBS
from splatseed.commands.bench import CompareOptions, ReportOptions

from .command_line import options_of
from .test_package import tracked_files

MOST_OPTIONS = 140
MOST_FILES = 260
MOST_LINES = {"src": 43_000, "tests": 23_250}


def test_options_over_all_verbs():
    """Methods' own parameters are not counted, nor are positional words and ``--help``."""
    kinds = [import_module(f"splatseed.commands.{verb}").Options for verb in VERBS]
    counts = {each.__module__: len(options_of(each)) for each in kinds}
    counts |= {each.__name__: len(options_of(each)) for each in (ReportOptions, CompareOptions)}
    assert sum(counts.values()) <= MOST_OPTIONS, counts


@pytest.mark.parametrize("top", ["src", "tests"])
def test_lines(top):
    assert (
        sum(path.read_bytes().count(b"\n") for path in tracked_files(top, ".py")) <= MOST_LINES[top]
    )


def test_files():
    assert len(tracked_files("src", ".py")) <= MOST_FILES
