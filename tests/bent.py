"""A made capture as a lens with distortion would have photographed it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates

from splatseed.camera import Intrinsics
from splatseed.lens import project_rays, unproject_pixels
from splatseed.tracks import Observations

COEFFICIENTS = (-0.12, 0.02, 0.002, -0.003)
"""Of OPENCV: straight lines at the photographs' edges are bent by some pixels."""


def bend(capture):
    """The capture through a lens; depths stay the pinhole camera's."""
    images = [_bent(image) for image in capture.scene.images]
    pictures = [_photograph(p, i.intrinsics) for p, i in zip(capture.images, images, strict=True)]
    lenses = {image.intrinsics.camera_id: image.intrinsics for image in images}
    scene = capture.scene.replace(images=tuple(images), intrinsics=tuple(lenses.values()))
    return replace(capture, scene=scene, images=np.stack(pictures))


def _bent(image):
    old = image.intrinsics
    K = image.camera.K
    four = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    lens = Intrinsics(old.camera_id, "OPENCV", old.width, old.height, (*four, *COEFFICIENTS))
    seen = image.observations
    if seen is not None:
        moved = project_rays(lens, (seen.xy - K[:2, 2]) / K[[0, 1], [0, 1]])
        seen = Observations(moved, seen.point_ids)
    return replace(image, intrinsics=lens, observations=seen)


def _photograph(pixels, lens):
    """What the lens sees of a pinhole photograph; its edge goes on where that one ends."""
    column, row = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    xy = unproject_pixels(lens, np.stack([column, row], axis=-1))
    uv = xy * lens.K[[0, 1], [0, 1]] + lens.K[:2, 2] - 0.5
    places = [uv[..., 1], uv[..., 0]]
    channels = [
        map_coordinates(pixels[..., c].astype(float), places, order=1, mode="nearest")
        for c in range(3)
    ]
    return np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
