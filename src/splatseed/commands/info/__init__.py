"""The verb ``info``: a scene in numbers, words and a picture."""

from splatseed.commands.info.command import Options, run

__all__ = ["Options", "run"]
