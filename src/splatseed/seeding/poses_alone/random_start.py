"""Where trainers begin without points: at random in a cube around the cameras.

Notation: V cameras. Promise: a baseline to compare with, as strong as the trainers' own; the same
generator gives the same bytes.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float64

from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene


def random_start(
    scene: Scene, rng: np.random.Generator, trainer: Literal["gsplat", "nerfstudio"] = "gsplat"
) -> PointCloud:
    """Points as a trainer draws them for a scene that has none, uniform in position and colour.

    Args:
        scene: A scene with at least two cameras.
        rng: Draws positions and colours.
        trainer: Whose rule: that of gsplat 1.5.3's simple_trainer (``init_type`` random), 100,000
            points in a cube that reaches 3.3 times as far as the cameras; or nerfstudio 1.1.5's
            splatfacto, 50,000 that reach 5 times as far as their coordinates.
    """
    centers = np.stack([image.camera.center for image in scene.images])
    middle = centers.mean(axis=0)
    if trainer == "nerfstudio":
        return _in_cube(middle, 5.0 * np.abs(centers - middle).max(), 50_000, rng)
    # Its world is centred at the median, over cameras, of the point on the optical axis that is
    # nearest to the origin. It is turned, too, which a median of coordinates feels a little.
    axes = np.stack([image.camera.cam_from_world[2, :3] for image in scene.images])
    nearest = centers - (centers * axes).sum(axis=1, keepdims=True) * axes
    reach = np.linalg.norm(centers - middle, axis=1).max()
    return _in_cube(np.median(nearest, axis=0), 3.0 * 1.1 * reach, 100_000, rng)


def _in_cube(
    middle: Float64[np.ndarray, " 3"], half: float, num: int, rng: np.random.Generator
) -> PointCloud:
    xyz = middle + half * rng.uniform(-1.0, 1.0, (num, 3))
    return PointCloud(xyz.astype(np.float32), rng.integers(0, 256, (num, 3), dtype=np.uint8))
