"""The verb ``train``: from a scene and its seeds to trained Gaussians."""

from splatseed.commands.train.command import Options, run

__all__ = ["Options", "run"]
