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


def write_polycam(scene, folder, prefix="corrected_"):
    """Polycam's raw export; original photographs and cameras are wrong, if there are others."""
    keyframes = folder / "keyframes"
    for prefix_here in {prefix, ""}:
        for kind in ("images", "cameras"):
            (keyframes / f"{prefix_here}{kind}").mkdir(parents=True)
    for kind in ("depth", "confidence"):
        (keyframes / kind).mkdir()
    for i, image in enumerate(scene.images):
        name = f"{998_000_000 + 166_667 * i}"
        lens, pose = image.camera, world_from_cam(image)
        camera = {
            **{f"t_{row}{column}": pose[row, column] for row in range(3) for column in range(4)},
            "fx": lens.K[0, 0],
            "fy": lens.K[1, 1],
            "cx": lens.K[0, 2],
            "cy": lens.K[1, 2],
            "width": lens.width,
            "height": lens.height,
            "blur_score": 1.0 + i,
        }
        (keyframes / f"{prefix}cameras/{name}.json").write_text(json.dumps(camera))
        photograph = PilImage.open(image.path).convert("RGB")
        photograph.save(keyframes / f"{prefix}images/{name}.jpg")
        if prefix:
            wrong = {**camera, "t_03": 9.0}
            (keyframes / f"cameras/{name}.json").write_text(json.dumps(wrong))
            photograph.save(keyframes / f"images/{name}.jpg")
        depth = millimetres(scene, image.name)[::2, ::2]
        PilImage.fromarray(depth).save(keyframes / f"depth/{name}.png")
        levels = np.array([0, 127, 255], np.uint8)[confidence_levels(depth.shape)]
        PilImage.fromarray(levels).save(keyframes / f"confidence/{name}.png")
    return folder


def check_depths(scene, truth):
    """Depth of every other pixel, to the millimetre, with its confidence."""
    for image, known in zip(scene.images, truth.images, strict=True):
        depth = scene.depths.read(image.name)
        stored = millimetres(truth, known.name)[::2, ::2]
        np.testing.assert_array_equal(np.nan_to_num(1000 * depth.values).round(), stored)
        np.testing.assert_array_equal(depth.confidence, confidence_levels(stored.shape))


def change(path, **fields):
    """Change fields of a record; those that are None are removed."""
    record = {**json.loads(path.read_text()), **fields}
    path.write_text(json.dumps({k: v for k, v in record.items() if v is not None}))


def check_cameras(scene, truth):
    """Poses to rounding, and intrinsics, in the order of ``truth``."""
    assert len(scene.images) == len(truth.images)
    for image, known in zip(scene.images, truth.images, strict=True):
        np.testing.assert_allclose(
            image.camera.world_from_cam, known.camera.world_from_cam, atol=1e-6
        )
        np.testing.assert_allclose(image.camera.K, known.camera.K, rtol=1e-6)
        assert (image.camera.width, image.camera.height) == (96, 72)
