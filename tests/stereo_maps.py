"""Stereo maps with true depth and normals, ray-cast from the synthetic room."""

from __future__ import annotations

import numpy as np

from splatseed.camera import Camera
from splatseed.depth.stereo import StereoMap
from splatseed.synthetic.room import pixel_rays, visible

NUM_SOURCES = 4


def true_maps(capture, factor):
    """A map of every image, ``factor`` times smaller; remaining pixels are cut off."""
    images = capture.scene.images
    return tuple(_true_map(capture, i, factor) for i in range(len(images)))


def _true_map(capture, i, factor):
    images = capture.scene.images
    camera = _smaller(images[i].camera, factor)
    rays = pixel_rays(camera)
    t, which = capture.surfaces.intersect_parts(camera.center, rays)
    hit = np.isfinite(t)
    xyz = camera.center + np.where(hit, t, 1.0)[:, None] * rays
    normal = _normals(capture, which, xyz)
    normal *= -np.sign(np.einsum("ij,ij->i", normal, rays))[:, None]
    sources = [images[(i + step) % len(images)] for step in (1, -1, 2, -2)]
    seen = [hit & visible(capture.surfaces, source.camera, xyz) for source in sources]
    agreeing = sum(np.uint8(1 << k) * mask for k, mask in enumerate(seen)).astype(np.uint8)
    known = agreeing > 0
    shape = (camera.height, camera.width)
    return StereoMap(
        name=images[i].name,
        camera=camera,
        depth=np.where(known, t, np.nan).astype(np.float32).reshape(shape),
        normal=np.where(known[:, None], normal @ camera.cam_from_world[:3, :3].T, np.nan)
        .astype(np.float32)
        .reshape(*shape, 3),
        confidence=known.astype(np.float32).reshape(shape),
        sources=tuple(source.name for source in sources),
        agreeing=np.where(known, agreeing, 0).astype(np.uint8).reshape(shape),
    )


def _smaller(camera, factor):
    K = np.diag([1 / factor, 1 / factor, 1.0]) @ camera.K
    size = (camera.width // factor, camera.height // factor)
    return Camera(K, *size, camera.cam_from_world)


def _normals(capture, which, xyz):
    normal = np.zeros_like(xyz)
    for part, surface in enumerate(capture.surfaces.parts):
        mine = which == part
        if mine.any():
            normal[mine] = surface.normals(xyz[mine])
    return normal
