"""Points that other trainers start from if a scene has none, each by its own rule.

Read in their sources: Brush (``crates/brush-train/src/splat_init.rs``, 459ea30), LichtFeld Studio
(``generate_random_point_cloud`` of its readers). gsplat's and nerfstudio's are
``splatseed.checkup.poses.random_start``. Only positions and colours are theirs: size and opacity
follow from the trainer here, as for all other seeds.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from splatseed.checkup.poses import random_start
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

__all__ = ["PEERS", "peer_start"]

PEERS = ("gsplat", "nerfstudio", "brush", "lichtfeld")
SH_C0 = 0.28209479177387814  # colour is 0.5 + SH_C0 times the coefficient


def peer_start(scene: Scene, rng: np.random.Generator, peer: str) -> PointCloud:
    """Draw the points that a trainer, one of ``PEERS``, starts from."""
    if peer in {"gsplat", "nerfstudio"}:
        return random_start(scene, rng, peer)  # type: ignore[arg-type]
    if peer == "lichtfeld":  # 10,000 in a cube of side 2 around the origin of the scene's frame
        xyz, colors = rng.uniform(-1.0, 1.0, (10_000, 3)), rng.random((10_000, 3))
    else:
        xyz = _in_frusta(scene, rng, 10_000)
        colors = 0.5 + SH_C0 * rng.random((len(xyz), 3))
    return PointCloud(xyz.astype(np.float32), np.rint(255 * colors).astype(np.uint8))


def _in_frusta(scene: Scene, rng: np.random.Generator, num: int) -> np.ndarray:
    """Brush's: a random camera, a random angle within its view, a depth around the cameras' mean.

    The scale is the mean distance from there; where that is below 1, three times the mean distance
    of the nearest other camera, 1 at least.
    """
    cameras = [image.camera for image in scene.images]
    centers = np.stack([camera.center for camera in cameras])
    from_middle = np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    scale = float(from_middle.mean())
    if scale <= 1.0:
        scale = max(3.0 * float(cKDTree(centers).query(centers, 2)[0][:, 1].mean()), 1.0)
    chosen = rng.integers(0, len(cameras), num)
    middle = np.maximum(from_middle[chosen], scale)
    depth = rng.uniform(np.maximum(middle - scale, 0.2 * scale), middle + scale)
    size = np.array([(camera.width, camera.height) for camera in cameras])
    focal = np.array([(camera.K[0, 0], camera.K[1, 1]) for camera in cameras])
    slope = np.tan(rng.uniform(-1.0, 1.0, (num, 2)) * np.arctan(0.5 * size / focal)[chosen])
    local = np.concatenate([slope * depth[:, None], depth[:, None]], axis=1)
    rotation = np.stack([camera.cam_from_world[:3, :3] for camera in cameras])[chosen]
    return np.asarray(centers[chosen] + np.einsum("nji,nj->ni", rotation, local))
