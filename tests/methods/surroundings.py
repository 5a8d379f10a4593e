"""A made scene around any cloud: cameras, photographs and depth maps, for methods that need them.

Notation: e is the longest edge of the cloud's bounding box. Cameras stand 8 e above the middle of
the box and look straight down, in the world's axes, on a plane z = -0.1 x through it. Whatever
moves or scales the cloud moves or scales all of it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import Intrinsics, quat_from_rotation
from splatseed.depthmap import DepthMap
from splatseed.scene import Image, Scene, SceneSource

from ..depth.conftest import MemoryMaps

WIDTH, HEIGHT, FOCAL = 96, 72, 320.0
HEIGHT_ABOVE, SLOPE = 8.0, 0.1
OFFSETS = [(-0.4, -0.2), (0.0, -0.2), (0.4, -0.2), (-0.4, 0.2), (0.0, 0.2), (0.4, 0.2)]
FOLDER = tempfile.TemporaryDirectory(prefix="splatseed-photographs-")


def scene_around(cloud):
    """A scene with the cloud as its points; a bare cloud where no finite originals make a box."""
    xyz = cloud.originals.xyz[cloud.originals.finite].astype(np.float64)
    if not len(xyz):
        return cloud
    middle = (xyz.min(axis=0) + xyz.max(axis=0)) / 2
    edge = np.ptp(xyz, axis=0).max() or 1.0
    lens = Intrinsics(1, "PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))
    down = np.diag([1.0, -1.0, -1.0])
    ray_x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) / FOCAL
    images, maps = [], MemoryMaps()
    for i, (dx, dy) in enumerate(OFFSETS):
        center = middle + edge * np.array([dx, dy, HEIGHT_ABOVE])
        images.append(Image(f"{i}.png", i + 1, lens, quat_from_rotation(down), -down @ center))
        depth = edge * (HEIGHT_ABOVE + SLOPE * dx) / (1 - SLOPE * ray_x)
        maps[f"{i}.png"] = DepthMap(np.tile(depth, (HEIGHT, 1)).astype(np.float32))
    folder = _photographs(cloud.rgb)
    source = SceneSource("colmap", folder, folder, image_dir=folder)
    return Scene(cloud, tuple(images), (lens,), source=source, depths=maps)


def _photographs(rgb):
    """A folder of photographs, all alike, whose colours run from the least to the largest of a
    cloud."""
    low, high = rgb.min(axis=0).astype(int), rgb.max(axis=0).astype(int)
    folder = Path(FOLDER.name) / "_".join(map(str, [*low, *high]))
    if not folder.exists():
        folder.mkdir()
        share = np.linspace(0.0, 1.0, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 1))
        pixels = (low + share * (high - low)).astype(np.uint8)
        for i in range(len(OFFSETS)):
            PilImage.fromarray(pixels).save(folder / f"{i}.png")
    return folder
