"""The verb ``upsample``: read, add points, write, and report."""

from splatseed.commands.upsample.command import Options, run

__all__ = ["Options", "run"]
