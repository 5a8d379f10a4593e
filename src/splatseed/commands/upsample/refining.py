"""``--refine-poses``: a scene's poses refined, and points triangulated, before it is upsampled."""

from __future__ import annotations

from splatseed.console import StageClock
from splatseed.scene import Scene
from splatseed.sfm import refining

__all__ = ["refined"]


def refined(scene: Scene, seed: int, clock: StageClock) -> tuple[Scene, str]:
    """What ``sfm.refining.refined`` gives, with its stages shown as still to come."""
    clock.expect("features", "matching", "refinement", "triangulation", "undistortion")
    return refining.refined(scene, seed, clock)
