"""The verb ``demo``: the whole workflow, from capture to trained models."""

from splatseed.commands.demo.command import Options, run

__all__ = ["Options", "run"]
