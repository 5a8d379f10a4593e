"""How the demo calls a method; the process that compiles ahead must call it the same way."""

from __future__ import annotations

from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.upsample import METHODS, chooses_number, configure, upsample

SHOWN = "auto"
RATIO = 8.0
"""Points in all over originals, for methods that interpolate."""
SEED = 0
TEST_EVERY = 8
"""Photographs held out for testing: no method uses them."""


def upsample_by(name: str, scene: Scene, ratio: float, seed: int) -> PointCloud:
    """The scene's points and new ones.

    Args:
        name: A key of ``METHODS``.
        scene: A scene with photographs and depth maps.
        ratio: Points in all over originals; ignored by methods that choose their number.
        seed: Seed of the random numbers.

    Raises:
        SplatseedError: As ``upsample``.
    """
    looks = hasattr(METHODS[name], "hold_out")
    method = configure(name, hold_out=TEST_EVERY) if looks else configure(name)
    return upsample(scene, method, ratio=None if chooses_number(name) else ratio, seed=seed)
