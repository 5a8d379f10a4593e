"""How large splatseed may grow: what comes in makes room."""

from __future__ import annotations

from importlib import import_module

import pytest

pytest.importorskip("torch", reason="some verbs import PyTorch")

from splatseed.cli import VERBS
from splatseed.commands.bench import CompareOptions, ReportOptions

from .command_line import options_of

MOST_OPTIONS = 140


def test_options_over_all_verbs():
    """Methods' own parameters are not counted, nor are positional words and ``--help``."""
    kinds = [import_module(f"splatseed.commands.{verb}").Options for verb in VERBS]
    counts = {each.__module__: len(options_of(each)) for each in kinds}
    counts["bench report and compare"] = len(options_of(ReportOptions)) + len(
        options_of(CompareOptions)
    )
    assert sum(counts.values()) <= MOST_OPTIONS, counts
