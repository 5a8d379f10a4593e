"""Stereo maps with true depth and normals, ray-cast from the synthetic room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatseed.depth.stereo import StereoMap
from splatseed.synthetic.room import pixel_rays, visible


def true_maps(capture, factor):
    """A map of every image, ``factor`` times smaller; remaining pixels are cut off."""
    images = capture.scene.images
    return tuple(_true_map(capture, i, factor) for i in range(len(images)))


def _true_map(capture, i, factor):
    images, camera = capture.scene.images, capture.scene.images[i].camera
    width, height = camera.width // factor, camera.height // factor
    K = np.diag([1 / factor, 1 / factor, 1.0]) @ camera.K
    camera = replace(camera, K=K, width=width, height=height)
    rays = pixel_rays(camera)
    t = capture.surfaces.intersect(camera.center, rays)
    hit = np.isfinite(t)
    xyz = camera.center + np.where(hit, t, 1.0)[:, None] * rays
    normal = capture.surfaces.normals(xyz)
    normal *= -np.sign(np.einsum("ij,ij->i", normal, rays))[:, None]
    sources = [images[(i + step) % len(images)] for step in (1, -1, 2, -2)]
    seen = [hit & visible(capture.surfaces, source.camera, xyz) for source in sources]
    agreeing = sum(np.uint8(1 << k) * mask for k, mask in enumerate(seen)).astype(np.uint8)
    known, shape = (agreeing > 0).reshape(height, width), (height, width)
    turned = (normal @ camera.cam_from_world[:3, :3].T).astype(np.float32).reshape(*shape, 3)
    return StereoMap(
        name=images[i].name,
        camera=camera,
        depth=np.where(known, t.astype(np.float32).reshape(shape), np.float32(np.nan)),
        normal=np.where(known[..., None], turned, np.float32(np.nan)),
        confidence=known.astype(np.float32),
        sources=tuple(source.name for source in sources),
        agreeing=agreeing.reshape(shape),
        rgb=np.full((*shape, 3), 128, np.uint8),
    )
