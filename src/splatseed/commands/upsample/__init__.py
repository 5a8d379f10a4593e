"""The verb ``upsample``: read, add points, write, and say what was done."""

from splatseed.commands.upsample.command import Options, run

__all__ = ["Options", "run"]
