"""Reading and writing scenes."""

from splatseed.io.load import load_scene
from splatseed.io.write import WriteReport, write_scene

__all__ = ["WriteReport", "load_scene", "write_scene"]
