"""Cameras with exact values, from which tests write the exports of photogrammetry programs.

Each test states where a program's own formulas put known points, from the numbers in its file.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image as PilImage
from scipy.spatial.transform import Rotation

from splatseed.io import load_scene
from splatseed.lens import project_rays

SIZE = (96, 72)


class Made(NamedTuple):
    """Cameras that look at points; OpenCV's axes."""

    rotations: np.ndarray  # cam_from_world [V, 3, 3]
    centers: np.ndarray  # [V, 3]
    xyz: np.ndarray  # [N, 3]
    rgb: np.ndarray  # [N, 3]

    @property
    def translations(self):
        return -np.einsum("vij,vj->vi", self.rotations, self.centers)

    def rays(self, view):
        """The points in a camera's axes [N, 3]."""
        return (self.xyz - self.centers[view]) @ self.rotations[view].T


def made_cameras(count=4) -> Made:
    rng = np.random.default_rng(7)
    turns = Rotation.from_euler("zyx", rng.uniform(-30, 30, (count, 3)), degrees=True)
    rotations = turns.as_matrix()
    # Each looks at the middle from a distance of 6.
    centers = -6 * rotations[:, 2] + rng.uniform(-0.5, 0.5, (count, 3))
    xyz, rgb = rng.uniform(-1.5, 1.5, (30, 3)), rng.integers(0, 256, (30, 3))
    return Made(rotations, centers, xyz, rgb)


def write_photographs(folder: Path, names, size=SIZE):
    """Write pictures, no two of which are the same."""
    for i, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((size[1], size[0], 3), 90, np.uint8)
        pixels[:, : len(pixels[0]) // 2] = 20 * i, len(name), 7
        PilImage.fromarray(pixels).save(path)


def load(path):
    return load_scene(path, require_points=False)


def check_projections(scene, made, expected, names):
    """Compare where the scene's cameras see the points with pixels [N, 2] by view."""
    assert [image.name for image in scene.images] == list(names)
    for image, pixels in zip(scene.images, expected, strict=True):
        view = made.xyz - scene.origin  # of a scene far from 0
        rays = view @ image.cam_from_world[:3, :3].T + image.cam_from_world[:3, 3]
        assert (rays[:, 2] > 0).all()
        seen = project_rays(image.intrinsics, rays[:, :2] / rays[:, 2:])
        np.testing.assert_allclose(seen, pixels, rtol=0, atol=1e-6)


def kinds(scene):
    return {finding.kind for finding in scene.findings}
