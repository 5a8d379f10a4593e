"""A made scene around any cloud: cameras, photographs and depth maps, for methods that need them.

Notation: e is the longest edge of the cloud's bounding box. Cameras stand 8 e above the middle of
the box and look down on a plane through it, in the world's axes. Whatever moves or scales the cloud
moves or scales all of it.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import Camera, Intrinsics, quat_from_rotation
from splatseed.depthmap import DepthMap
from splatseed.scene import Image, Scene, SceneSource

from ..depth.conftest import MemoryMaps

WIDTH, HEIGHT, FOCAL = 96, 72, 320.0
HEIGHT_ABOVE = 8.0
OFFSETS = [(-1.5, -1.0), (0.0, -1.0), (1.5, -1.0), (-1.5, 1.0), (0.0, 1.0), (1.5, 1.0)]
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
    images, maps = [], MemoryMaps()
    for i, (dx, dy) in enumerate(OFFSETS):
        center = middle + edge * np.array([dx, dy, HEIGHT_ABOVE])
        turn = _looking_at(center, middle, down)
        images.append(Image(f"{i}.png", i + 1, lens, quat_from_rotation(turn), -turn @ center))
        maps[f"{i}.png"] = DepthMap(_plane_depth(images[-1].camera, middle, [0.0, 0.0, 1.0]))
    folder = _photographs(cloud.rgb)
    source = SceneSource("colmap", folder, folder, image_dir=folder)
    return Scene(cloud, tuple(images), (lens,), source=source, depths=maps)


def _plane_depth(camera: Camera, point, normal):
    """Planar depth of a plane at the pixels' centres, float32 [H, W]."""
    u, v = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    pixels = np.stack([u, v, np.ones_like(u)], axis=-1)
    rays = pixels @ np.linalg.inv(camera.K).T @ camera.cam_from_world[:3, :3]
    z = (np.asarray(point) - camera.center) @ np.asarray(normal) / (rays @ np.asarray(normal))
    return np.where(z > 0, z, np.nan).astype(np.float32)


def _looking_at(center, target, down):
    """The rotation of a camera that looks at a target, near to a given one."""
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(down[1], forward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])


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
