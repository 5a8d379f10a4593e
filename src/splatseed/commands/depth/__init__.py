"""The verb ``depth``: depth maps by a network or by stereo."""

from splatseed.commands.depth.command import run
from splatseed.commands.depth.options import Options

__all__ = ["Options", "run"]
