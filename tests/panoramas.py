"""A walk through a made room in panoramas whose poses are known."""

from __future__ import annotations

import numpy as np

from splatseed.camera import rotation_from_quat
from splatseed.synthetic.surfaces import Rectangle, Union
from splatseed.synthetic.texture import Mottled

SIZE = np.array([5.0, 4.0, 2.6])
"""Of the room, along x, y and z (down), metres; a corner is at 0."""


def walls() -> tuple[Union, list[Mottled]]:
    """Six walls, each of another texture."""
    x, y, z = np.diag(SIZE)
    here = np.zeros(3)
    sides = [(here, x, y), (here, x, z), (here, y, z), (z, x, y), (y, x, z), (x, y, z)]
    parts = [Rectangle(*side) for side in sides]
    palette = np.random.default_rng(5).uniform(0.05, 1.0, (6, 3, 3))
    textures = [
        Mottled(tuple(map(tuple, palette[k])), (3.0, 3.0, 3.0), octaves=3, contrast=2.0, seed=k)
        for k in range(6)
    ]
    return Union(tuple(parts)), textures


def poses(num: int) -> list[np.ndarray]:
    """cam_from_world [4, 4] of a walk, each turned and a little tilted."""
    found = []
    for k in range(num):
        turn = 0.5 * k
        quat = np.array([np.cos(turn / 2), 0.05 * np.sin(k), np.sin(turn / 2), 0.05 * np.cos(k)])
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_quat(quat)
        center = np.array([1.2 + 0.45 * k, 1.5 + 0.5 * np.sin(1.1 * k), 1.1 + 0.15 * np.cos(2 * k)])
        pose[:3, 3] = -pose[:3, :3] @ center
        found.append(pose)
    return found


def directions(width: int, height: int) -> np.ndarray:
    """Of each pixel, by the definition of longitude and latitude, [H, W, 3]."""
    longitude = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitude = (0.5 - (np.arange(height) + 0.5) / height) * np.pi  # up
    a, b = np.meshgrid(longitude, latitude)
    return np.stack([np.cos(b) * np.sin(a), -np.sin(b), np.cos(b) * np.cos(a)], axis=-1)


def shade(center: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Colours 0 to 255 of world directions [..., 3] from a place."""
    surfaces, textures = walls()
    flat = rays.reshape(-1, 3)
    t, which = surfaces.intersect_parts(center, flat)
    colors = np.empty((len(flat), 3))
    for k, texture in enumerate(textures):
        colors[which == k] = texture((center + t[:, None] * flat)[which == k])
    return 255 * np.clip(colors, 0, 1).reshape(rays.shape)


def render(pose: np.ndarray, width: int) -> np.ndarray:
    """A panorama of ``width`` x ``width / 2`` pixels, uint8."""
    rays = directions(width, width // 2) @ pose[:3, :3]
    return np.round(shade(-pose[:3, :3].T @ pose[:3, 3], rays)).astype(np.uint8)
