"""The verb ``upsample``: read, add points, write, and report."""

from splatseed.commands.upsample.command import Options, full_options, run

__all__ = ["Options", "full_options", "run"]
