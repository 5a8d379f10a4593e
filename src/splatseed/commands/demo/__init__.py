"""The verb ``demo``: the main job from end to end."""

from splatseed.commands.demo.command import Options, run

__all__ = ["Options", "run"]
