"""The made room as phone apps would export it: photographs, poses, depth and its confidence."""

from __future__ import annotations

import json

import numpy as np
from PIL import Image as PilImage

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def world_from_cam(image):
    """The pose in OpenGL axes."""
    return image.camera.world_from_cam @ OPENGL


def millimetres(scene, name):
    return np.nan_to_num(1000 * scene.depths.read(name).values).round().astype(np.uint16)


def confidence_levels(shape):
    """All three levels, in thirds of the rows."""
    return np.repeat(np.arange(3, dtype=np.uint8), -(-shape[0] // 3))[: shape[0], None].repeat(
        shape[1], axis=1
    )


def write_scanner_app(scene, folder):
    """3D Scanner App's "All Data"; ``scene`` has depth maps, every other pixel is stored."""
    folder.mkdir()
    for i, image in enumerate(scene.images):
        K = image.camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        projection = np.zeros((4, 4))
        projection[[0, 1], [0, 1]] = (
            2 * K[[0, 1], [0, 1]] / (image.camera.width, image.camera.height)
        )
        record = {
            "frame_index": 3 * i,
            "cameraPoseARFrame": world_from_cam(image).ravel().tolist(),
            "intrinsics": K.ravel().tolist(),
            "projectionMatrix": projection.ravel().tolist(),
        }
        (folder / f"frame_{3 * i:05d}.json").write_text(json.dumps(record))
        PilImage.open(image.path).convert("RGB").save(folder / f"frame_{3 * i:05d}.jpg")
        depth = millimetres(scene, image.name)[::2, ::2]
        PilImage.fromarray(depth).save(folder / f"depth_{3 * i:05d}.png")
        levels = confidence_levels(depth.shape)
        PilImage.fromarray(levels).save(folder / f"conf_{3 * i:05d}.png")
    (folder / "info.json").write_text(json.dumps({"numImages": len(scene.images)}))
    return folder


def check_cameras(scene, truth):
    """Poses to rounding, and intrinsics, in the order of ``truth``."""
    assert len(scene.images) == len(truth.images)
    for image, known in zip(scene.images, truth.images, strict=True):
        np.testing.assert_allclose(
            image.camera.world_from_cam, known.camera.world_from_cam, atol=1e-6
        )
        np.testing.assert_allclose(image.camera.K, known.camera.K, rtol=1e-6)
        assert (image.camera.width, image.camera.height) == (96, 72)
