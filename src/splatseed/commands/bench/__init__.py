"""The verb ``bench``: its options, the machine, the display, and the reports."""

from splatseed.commands.bench.command import run
from splatseed.commands.bench.options import Options

__all__ = ["Options", "run"]
