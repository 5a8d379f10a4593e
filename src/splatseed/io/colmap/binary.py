"""COLMAP models in binary form: ``cameras.bin``, ``images.bin``, ``points3D.bin``.

Notation: ``_id`` comes from the file. Layouts as COLMAP's documentation of its output format gives
them, little-endian. In ``points3D.bin``, N records hold T observations in all, and ``starts``
[N + 1] are the records' byte offsets, ended by the end of the last. Promise: a file that was read
is written back byte for byte; a malformed one raises a single error that names the file, the record
and the byte; points are looped over in Python only to find where each record begins. Writers write
straight to ``path`` and let ``OSError`` pass: their caller stages the output.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError
from splatseed.io.colmap.model import (
    UNKNOWN_ERROR,
    check_unique,
    make_image,
    make_intrinsics,
    make_points,
    point_columns,
)
from splatseed.io.files import ByteReader
from splatseed.pointcloud import PointCloud
from splatseed.scene import NO_POINT, Image, Observations, Tracks

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # camera id, model id, width, height; then the parameters
_POSE = struct.Struct("<I7dI")  # image id, wxyz quaternion, translation, camera id; then the name
_FEATURE = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_OBSERVATION = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
# A record of points3D.bin is a head of 51 bytes, whose last field is the track's length L, then L
# observations of 8 bytes; nothing is aligned.
_HEAD_BYTES, _PAIR_BYTES = _POINT.itemsize, _OBSERVATION.itemsize
_LENGTH_AT = 43  # of the track length within a head
_POINTS_AT_ONCE = 1 << 18  # bounds the writer's memory to some tens of megabytes


def read_cameras(path: Path) -> tuple[Intrinsics, ...]:
    """The camera records of a ``cameras.bin``, in file order.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, or a camera model is unknown.
    """
    reader = ByteReader(path)
    count = reader.count(_CAMERA.size + 3 * 8, "cameras")
    cameras = tuple(_read_camera(reader, i, count) for i in range(count))
    reader.finish()
    ids = np.array([camera.camera_id for camera in cameras], np.int64)
    check_unique("camera id", ids, path, _record)
    return cameras


def _read_camera(reader: ByteReader, idx: int, count: int) -> Intrinsics:
    reader.record = f"{_record(idx)} of {count}"
    where = reader.where
    camera_id, model_id, width, height = reader.unpack(_CAMERA)
    model = next((m for m in CAMERA_MODELS.values() if m.model_id == model_id), None)
    if model is None:
        raise reader.error("the id of a COLMAP camera model", str(model_id))
    params = reader.unpack(struct.Struct(f"<{model.num_params}d"))
    return make_intrinsics(where, camera_id, model.name, width, height, params)


def read_images(path: Path, intrinsics: Sequence[Intrinsics]) -> tuple[Image, ...]:
    """The image records of an ``images.bin``, in file order, with their features.

    Args:
        path: The file.
        intrinsics: The camera records that the images refer to.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, a pose is not finite, or an image names a
            camera that is not there.
    """
    reader = ByteReader(path)
    cameras = {camera.camera_id: camera for camera in intrinsics}
    count = reader.count(_POSE.size + 1 + 8, "images")
    images = tuple(_read_image(reader, cameras, i, count) for i in range(count))
    reader.finish()
    check_unique("image id", np.array([im.image_id for im in images], np.int64), path, _record)
    check_unique("image name", np.array([im.name for im in images], str), path, _record)
    return images


def _read_image(reader: ByteReader, cameras: dict[int, Intrinsics], idx: int, count: int) -> Image:
    reader.record = f"{_record(idx)} of {count}"
    where = reader.where
    image_id, *pose, camera_id = reader.unpack(_POSE)
    name = reader.text()
    features = reader.array(_FEATURE, reader.count(_FEATURE.itemsize, "features"))
    point_ids = features["point_id"].astype(np.int64)  # COLMAP's "none", 2^64 - 1, becomes -1
    if (point_ids < NO_POINT).any():
        raise reader.error("features with point ids below 2^63", "a larger one")
    return make_image(
        where,
        cameras,
        image_id=image_id,
        camera_id=camera_id,
        name=name,
        pose=pose,
        observations=Observations(features["xy"].astype(np.float64), point_ids),
    )


def read_points3d(path: Path) -> tuple[PointCloud, Tracks]:
    """The points of a ``points3D.bin`` in file order, and their tracks.

    Coordinates may be NaN or infinite; nothing is repaired here.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: It is unreadable or malformed, or a point id occurs twice or exceeds
            2^63 - 1.
    """
    reader = ByteReader(path)
    count = reader.count(_POINT.itemsize, "points")
    starts = _scan_records(reader.data, reader.offset, count)
    complete = len(starts) - 1
    reader.offset = int(starts[complete])
    if complete < count:
        reader.record = f"{_record(complete)} of {count}"
        raise reader.error("a whole point record", f"{reader.remaining} bytes to the file's end")
    reader.finish()
    buffer = np.frombuffer(reader.data, np.uint8)
    points = _anywhere(buffer, _HEAD_BYTES)[starts[:-1]].view(_POINT)
    observations = _anywhere(buffer, _PAIR_BYTES)[_pair_offsets(starts)].view(_OBSERVATION)
    tracks = Tracks(
        point_ids=points["id"].astype(np.int64),
        xyz=points["xyz"].astype(np.float64),
        errors=points["error"].astype(np.float64),
        offsets=(starts - starts[0] - _HEAD_BYTES * np.arange(len(starts))) // _PAIR_BYTES,
        image_ids=observations["image_id"].astype(np.uint32),
        point2d_idx=observations["point2d_idx"].astype(np.uint32),
    )
    return make_points(path, _record, points["rgb"].copy(), tracks)


def write_cameras(path: Path, intrinsics: Sequence[Intrinsics]) -> None:
    """Write a ``cameras.bin``.

    Raises:
        OutputError: A value does not fit its field.
        OSError: The file cannot be written.
    """
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(intrinsics)))
        for camera in intrinsics:
            where = f"camera {camera.camera_id}"
            head = (CAMERA_MODELS[camera.model].model_id, camera.width, camera.height)
            file.write(_pack(_CAMERA, where, camera.camera_id, *head))
            file.write(np.array(camera.params, "<f8").tobytes())


def write_images(path: Path, images: Sequence[Image]) -> None:
    """Write an ``images.bin``; images without observations get zero features.

    Raises:
        OutputError: A name holds a zero byte or is not Unicode, or a value does not fit its field.
        OSError: The file cannot be written.
    """
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(images)))
        for image in images:
            pose = (*image.quat.tolist(), *image.translation.tolist())
            values = (image.image_id, *pose, image.intrinsics.camera_id)
            file.write(_pack(_POSE, f"image {image.name!r}", *values))
            name = image.name.encode("utf-8", errors="replace")
            if b"\0" in name or name.decode("utf-8") != image.name:
                raise OutputError(
                    "image names in UTF-8 without a zero byte",
                    found=f"{image.name!r}",
                    fix="Rename the image.",
                )
            features = np.empty(len(image.observations or ()), _FEATURE)
            if image.observations is not None:
                features["xy"] = image.observations.xy
                features["point_id"] = image.observations.point_ids.astype(np.uint64)
            file.write(name + b"\0" + _COUNT.pack(len(features)) + features.tobytes())


def _pack(layout: struct.Struct, where: str, *values: float) -> bytes:
    try:
        return layout.pack(*values)
    except struct.error as error:
        raise OutputError(
            f"values of {where} that COLMAP's binary form can hold",
            found=f"{values} ({error})",
            fix="Ids and sizes are non-negative, ids below 2^32.",
        ) from None


def write_points3d(path: Path, points: PointCloud, tracks: Tracks | None) -> None:
    """Write a ``points3D.bin``.

    Args:
        path: The file.
        points: The cloud.
        tracks: Ids, float64 positions, errors and tracks of the first ``len(tracks)`` points. The
            others get the ids that follow the largest, error -1 (COLMAP's "unknown") and no track.
            Without it all points do, with ids from 1.

    Raises:
        PointCloudError: There are more tracks than points.
        OSError: The file cannot be written.
    """
    heads = np.zeros(len(points), _POINT)
    heads["id"], heads["xyz"], heads["error"] = point_columns(points, tracks)
    heads["rgb"] = points.rgb
    if tracks is not None:
        heads["length"][: len(tracks)] = tracks.lengths
    num_tracked = len(tracks) if tracks is not None else 0
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(points)))
        if tracks is not None:
            for start in range(0, num_tracked, _POINTS_AT_ONCE):
                stop = min(start + _POINTS_AT_ONCE, num_tracked)
                file.write(_joined_records(heads[start:stop], tracks, start, stop).data)
        file.write(heads[num_tracked:].view(np.uint8).data)  # a record without a track is its head


def set_point_count(path: Path, count: int) -> None:
    """Change the number of points that a ``points3D.bin`` promises, before more are appended.

    Raises:
        OSError: The file cannot be written.
    """
    with path.open("r+b") as file:
        file.write(_COUNT.pack(count))


def point_rows(
    first_id: int, xyz: Float32[np.ndarray, "n 3"], rgb: UInt8[np.ndarray, "n 3"]
) -> memoryview:
    """Records of points without a track, as ``write_points3d`` writes them.

    Args:
        first_id: The id of the first; the others follow.
        xyz: Positions.
        rgb: Colours.
    """
    heads = np.zeros(len(xyz), _POINT)
    heads["id"] = np.arange(first_id, first_id + len(xyz))
    heads["xyz"], heads["rgb"], heads["error"] = xyz, rgb, UNKNOWN_ERROR
    return heads.view(np.uint8).data


def _joined_records(
    heads: np.ndarray, tracks: Tracks, start: int, stop: int
) -> UInt8[np.ndarray, " B"]:
    """The bytes of the records of points ``start`` to ``stop``, which have tracks."""
    first, last = tracks.offsets[start], tracks.offsets[stop]
    observations = np.empty(last - first, _OBSERVATION)
    observations["image_id"] = tracks.image_ids[first:last]
    observations["point2d_idx"] = tracks.point2d_idx[first:last]
    starts = (tracks.offsets[start : stop + 1] - first) * _PAIR_BYTES
    starts += np.arange(len(starts)) * _HEAD_BYTES
    buffer = np.empty(starts[-1], np.uint8)
    _anywhere(buffer, _HEAD_BYTES)[starts[:-1]] = heads.view(f"V{_HEAD_BYTES}")
    _anywhere(buffer, _PAIR_BYTES)[_pair_offsets(starts)] = observations.view(f"V{_PAIR_BYTES}")
    return buffer


def _record(idx: int) -> str:
    return f"record {idx + 1}"


def _scan_records(data: bytes, first: int, count: int) -> Int64[np.ndarray, " K+1"]:
    """The offsets of ``count`` records that begin at ``first``, then the end of the last.

    Returns:
        Offsets of the K records that lie whole inside the data, and where the next one begins; K is
        less than ``count`` if the data ends within that one.
    """
    at, last = first, len(data) - _HEAD_BYTES
    starts = [at]
    length_at = _COUNT.unpack_from
    for _ in range(count):  # a record's place is known only from the one before it
        if at > last:
            break
        at += _HEAD_BYTES + _PAIR_BYTES * length_at(data, at + _LENGTH_AT)[0]
        if at > len(data):
            break
        starts.append(at)
    return np.array(starts, np.int64)


def _anywhere(buffer: UInt8[np.ndarray, " B"], size: int) -> np.ndarray:
    """The ``size`` bytes from each byte of a buffer on, as one element: a view."""
    return np.ndarray(max(len(buffer) - size + 1, 0), f"V{size}", buffer, strides=(1,))


def _pair_offsets(starts: Int64[np.ndarray, " N+1"]) -> Int64[np.ndarray, " T"]:
    """Where each observation stands."""
    lengths = (np.diff(starts) - _HEAD_BYTES) // _PAIR_BYTES
    before = np.cumsum(lengths) - lengths
    offsets = np.repeat(starts[:-1] + _HEAD_BYTES - _PAIR_BYTES * before, lengths)
    offsets += _PAIR_BYTES * np.arange(len(offsets))
    return offsets
