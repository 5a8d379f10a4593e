"""The verb ``upsample``: read, add points, write, and report."""

from splatseed.commands.upsample.command import run
from splatseed.commands.upsample.options import Options, full_options

__all__ = ["Options", "full_options", "run"]
