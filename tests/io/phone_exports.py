"""The made room as phone apps would export it: photographs, poses, depth and its confidence."""

from __future__ import annotations

import io
import json
import struct
from contextlib import suppress
from importlib import import_module
from zipfile import ZipFile

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import quat_from_rotation
from splatseed.viewer.videos import write_video

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


def _xyzw(matrix):
    return np.roll(quat_from_rotation(matrix[:3, :3]), -1).tolist()


def record3d_metadata(scene, step=1):
    """Record3D's metadata, with a pose for ``step`` times as many frames as photographs."""
    poses, pinholes = [], []
    for image in scene.images:
        pose = world_from_cam(image)
        poses += [[*_xyzw(pose), *pose[:3, 3]], *[[0, 0, 0, 1, 9, 9, 9]] * (step - 1)]
        pinholes += [image.camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()] * step
    width, height = scene.images[0].camera.width, scene.images[0].camera.height
    K = scene.images[0].camera.K.T.ravel().tolist()
    sizes = {"w": width, "h": height, "dw": width // 2, "dh": height // 2}
    return {"poses": poses, "K": K, "perFrameIntrinsicCoeffs": pinholes, "fps": 60, **sizes}


def write_record3d(scene, folder, step=1):
    """Record3D's "EXR + RGB", every ``step``-th frame; depth as EXR if OpenEXR is there."""
    root = folder / "EXR_RGBD"
    for each in (root / "rgb", root / "depth"):
        each.mkdir(parents=True)
    for i, image in enumerate(scene.images):
        photograph = PilImage.open(image.path).convert("RGB")
        photograph.save(root / f"rgb/{step * i}.jpg", quality=95)
        with suppress(ImportError):
            openexr = import_module("OpenEXR")
            header = {"type": openexr.scanlineimage, "compression": openexr.ZIP_COMPRESSION}
            depth = scene.depths.read(image.name).values[::2, ::2]
            file = openexr.File(header, {"R": np.ascontiguousarray(depth)})
            file.write(str(root / f"depth/{step * i}.exr"))
    (root / "metadata.json").write_text(json.dumps(record3d_metadata(scene, step)))
    return folder


def stored_lzfse(data):
    """A stream of LZFSE with one block that is not compressed."""
    return b"bvx-" + struct.pack("<I", len(data)) + data + b"bvx$"


def write_r3d(scene, path, step=1):
    """Record3D's archive, every ``step``-th frame."""
    with ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(record3d_metadata(scene, step)))
        archive.writestr("icon", b"a thumbnail")
        for i, image in enumerate(scene.images):
            photograph, name = io.BytesIO(), f"rgbd/{step * i}"
            PilImage.open(image.path).convert("RGB").save(photograph, "jpeg", quality=95)
            depth = millimetres(scene, image.name)[::2, ::2] / np.float32(1000)
            depth[depth == 0] = np.nan
            archive.writestr(f"{name}.jpg", photograph.getvalue())
            archive.writestr(f"{name}.depth", stored_lzfse(depth.astype("<f4").tobytes()))
            archive.writestr(f"{name}.conf", stored_lzfse(confidence_levels(depth.shape).tobytes()))
    return path


def write_stray(scene, folder, lens=True):
    """Stray Scanner's recording; intrinsics of each frame only in newer versions (``lens``)."""
    for each in (folder / "depth", folder / "confidence"):
        each.mkdir(parents=True)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    lines[0] += ", fx, fy, cx, cy, distortion_center_x, distortion_center_y" if lens else ""
    photographs = []
    for i, image in enumerate(scene.images):
        pose = image.camera.world_from_cam
        K = image.camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        pinhole = [*K[[0, 1, 0, 1], [0, 1, 2, 2]], "", ""] if lens else []
        row = [100 + i / 60, f"{i:06}", *pose[:3, 3], *_xyzw(pose), *pinhole]
        lines.append(", ".join(map(str, row)))
        photographs.append(np.array(PilImage.open(image.path).convert("RGB")))
        depth = millimetres(scene, image.name)[::2, ::2]
        PilImage.fromarray(depth).save(folder / f"depth/{i:06}.png")
        PilImage.fromarray(confidence_levels(depth.shape)).save(folder / f"confidence/{i:06}.png")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    text = "\n".join(", ".join(map(str, row)) for row in K.tolist())
    (folder / "camera_matrix.csv").write_text(text)
    height, width, _ = photographs[0].shape
    write_video(folder / "rgb.mp4", photographs, (width, height), 60)
    return folder
