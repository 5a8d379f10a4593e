"""COLMAP's cameras, images and points3D: binary files (read, written) and text files (read).

``where`` is the file and line or record that an error names; ``starts`` [N + 1] are the byte
offsets of N point records, followed by the end of the last. Promise: writing what was read from a
binary file gives the same bytes; text and binary files of a model give bit-identical values.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Int64, UInt8

from splatseed.camera import MODELS, PANORAMA, Intrinsics
from splatseed.errors import OutputError, PointCloudError, SceneFormatError
from splatseed.io.camera_records import (
    MAX_ID,
    NotFiniteError,
    Unusable,
    check_pose,
    check_record,
    format_error,
    make_intrinsics,
)
from splatseed.io.files import ByteReader, StrPath, is_data, numbered_lines
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image
from splatseed.tracks import NO_POINT, Observations, Tracks

UNKNOWN_ERROR = -1.0
"""COLMAP's reprojection error of a point without one."""

_SPHERICAL = "SPHERICAL"
"""The name of COLMAP's model of panoramas before its release."""
_MAX_MODEL_ID = 100
"""Unknown camera model ids below this are reported as newer models, others as damage."""
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # camera id, model id, width, height; then the parameters
_POSE = struct.Struct("<I7dI")  # image id, wxyz quaternion, translation, camera id; then the name
MIN_IMAGE_BYTES = _POSE.size + 1 + 8
"""Smallest record of ``images.bin``: pose, an empty name's zero byte, feature count."""
_FEATURE = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_OBSERVATION = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
# A record of points3D.bin: a head of 51 bytes that ends with the track length L, then L
# observations of 8 bytes; unaligned.
_HEAD_BYTES, _PAIR_BYTES = _POINT.itemsize, _OBSERVATION.itemsize
_LENGTH_AT = 43  # of the track length within a head
_Points: TypeAlias = tuple[UInt8[np.ndarray, "N 3"], Tracks, Callable[[int], str]]
"""Colours, all other fields, and a function from point index to place in the file."""


def read_cameras(path: StrPath, unusable: Unusable | None = None) -> tuple[Intrinsics, ...]:
    """Read ``cameras.bin`` or ``cameras.txt``, in file order.

    Records that are not finite are moved to ``unusable``; if that is None, they raise.
    """
    path = Path(path)
    cameras: dict[int, Intrinsics] = {}
    for where, camera_id, *record in (_text_cameras if path.suffix == ".txt" else _binary_cameras)(
        path
    ):
        check_record(camera_id not in cameras, "each camera id once", where, f"{camera_id} again")
        try:
            cameras[camera_id] = make_intrinsics(where, camera_id, *record)
        except NotFiniteError as error:
            if unusable is None:
                raise
            unusable[camera_id] = error
    return tuple(cameras.values())


def read_images(
    path: StrPath, intrinsics: Sequence[Intrinsics], unusable: Unusable | None = None
) -> tuple[Image, ...]:
    """Read ``images.bin`` or ``images.txt``, in file order.

    Bytes of a name that are not UTF-8 become surrogates, as in ``os.fsdecode``.
    Images whose pose is not finite, or whose camera is in ``unusable``, are moved to ``unusable``
    by name; if that is None, they raise.
    """
    path = Path(path)
    cameras = {camera.camera_id: camera for camera in intrinsics}
    images: dict[int, Image] = {}
    names: set[str] = set()
    for record in (_text_images if path.suffix == ".txt" else _binary_images)(path):
        where, image_id, pose, camera_id, name, observations = record
        check_record(0 <= image_id <= MAX_ID, f"an image id from 0 to {MAX_ID}", where, image_id)
        check_record(image_id not in images, "each image id once", where, f"{image_id} again")
        check_record(bool(name), "an image name", where, "an empty one")
        check_record(name not in names, "each image name once", where, f"{name} again")
        of = f"of image {name!r}"
        names.add(name)
        if unusable is not None and camera_id in unusable:
            unusable[name] = unusable[camera_id]
            continue
        try:
            check_pose(pose, of, where)
        except NotFiniteError as error:
            if unusable is None:
                raise
            unusable[name] = error
            continue
        known = f"one of the {len(cameras)} camera records as that {of}"
        check_record(camera_id in cameras, known, where, f"camera id {camera_id}")
        ids = observations.point_ids
        in_range = bool((ids >= NO_POINT).all())
        check_record(in_range, f"point ids from -1 (none) to 2^63 - 1 {of}", where, "another")
        quat, translation = np.split(np.array(pose, np.float64), [4])
        lens = cameras[camera_id]
        images[image_id] = Image(name, image_id, lens, quat, translation, observations)
    return tuple(images.values())


def read_points3d(path: StrPath) -> tuple[PointCloud, Tracks]:
    """Read ``points3D.bin`` or ``points3D.txt``: the points in file order, and their tracks.

    Nothing is repaired; positions beyond float32's range become infinite in the cloud.
    """
    path = Path(path)
    rgb, tracks, place = (_text_points if path.suffix == ".txt" else _binary_points)(path)
    ids = tracks.point_ids
    if (ids < 0).any():
        where = f"{path}, {place(int((ids < 0).argmax()))}"
        raise format_error(f"a point id from 0 to {2**63 - 1}", where, "one outside")
    if not (ids[1:] > ids[:-1]).all():  # usually ascending: no sort needed
        order = np.argsort(ids, kind="stable")
        again = order[1:][ids[order[1:]] == ids[order[:-1]]]
        if len(again):
            i = int(again.min())
            raise format_error(
                "each point id once", f"{path}, {place(i)}", f"{ids[i]} a second time"
            )
    with np.errstate(over="ignore"):
        return PointCloud(tracks.xyz.astype(np.float32), rgb), tracks


# Binary files


def _binary_cameras(path: Path) -> Iterator[tuple[Any, ...]]:
    reader = ByteReader(path)
    for where in reader.records(_CAMERA.size, "cameras"):
        camera_id, model_id, *size = reader.unpack(_CAMERA)
        model = next((m for m in MODELS.values() if m.model_id == model_id), None)
        if model is None and len(MODELS) <= model_id < _MAX_MODEL_ID:
            raise SceneFormatError(
                f"the id of a camera model of COLMAP 4.2 or older, 0 to {len(MODELS) - 1}, in "
                f"{where}",
                found=f"{model_id}, of a newer COLMAP",
                fix="Undistort the scene to PINHOLE with that COLMAP (colmap image_undistorter).",
            )
        if model is None:
            raise reader.error("the id of a COLMAP camera model", str(model_id))
        params = reader.unpack(struct.Struct(f"<{model.num_params}d"))
        yield where, camera_id, model.name, *size, params


def _binary_images(path: Path) -> Iterator[tuple[Any, ...]]:
    reader = ByteReader(path)
    for where in reader.records(MIN_IMAGE_BYTES, "images"):
        image_id, *pose, camera_id = reader.unpack(_POSE)
        name = reader.text()
        features = reader.array(_FEATURE, reader.count(_FEATURE.itemsize, "features"))
        ids = features["point_id"].astype(np.int64)  # COLMAP's "none", 2^64 - 1, becomes -1
        observations = Observations(features["xy"].astype(np.float64), ids)
        yield where, image_id, pose, camera_id, name, observations


def _binary_points(path: Path) -> _Points:
    reader = ByteReader(path)
    count = reader.count(_HEAD_BYTES, "points")
    starts = _scan_records(reader.data, reader.offset, count)
    complete = len(starts) - 1
    reader.offset = int(starts[complete])
    if complete < count:
        reader.record = f"record {complete + 1} of {count}"
        raise reader.error("a complete point record", f"{reader.remaining} remaining bytes")
    reader.finish()
    buffer = np.frombuffer(reader.data, np.uint8)
    points = _unaligned_view(buffer, _HEAD_BYTES)[starts[:-1]].view(_POINT)
    observations = _unaligned_view(buffer, _PAIR_BYTES)[_pair_offsets(starts)].view(_OBSERVATION)
    tracks = Tracks(
        point_ids=points["id"].astype(np.int64),
        xyz=points["xyz"].astype(np.float64),
        errors=points["error"].astype(np.float64),
        offsets=(starts - starts[0] - _HEAD_BYTES * np.arange(len(starts))) // _PAIR_BYTES,
        image_ids=observations["image_id"].astype(np.uint32),
        point2d_idx=observations["point2d_idx"].astype(np.uint32),
    )
    return points["rgb"].copy(), tracks, lambda i: f"record {i + 1}"


def _scan_records(data: bytes, first: int, count: int) -> Int64[np.ndarray, " K+1"]:
    """Return the offsets of ``count`` records from ``first`` on, and the end of the last."""
    at, last = first, len(data) - _HEAD_BYTES
    starts = [at]
    length_at = _COUNT.unpack_from
    for _ in range(count):  # each record's length is in its head
        if at > last:
            break
        at += _HEAD_BYTES + _PAIR_BYTES * length_at(data, at + _LENGTH_AT)[0]
        if at > len(data):
            break
        starts.append(at)
    return np.array(starts, np.int64)


def _unaligned_view(buffer: UInt8[np.ndarray, " B"], size: int) -> np.ndarray:
    """View a buffer as overlapping items of ``size`` bytes, one starting at each byte."""
    return np.ndarray(max(len(buffer) - size + 1, 0), f"V{size}", buffer, strides=(1,))


def _pair_offsets(starts: Int64[np.ndarray, " N+1"]) -> Int64[np.ndarray, " T"]:
    """Return the byte offset of each observation."""
    lengths = (np.diff(starts) - _HEAD_BYTES) // _PAIR_BYTES
    before = np.cumsum(lengths) - lengths
    offsets = np.repeat(starts[:-1] + _HEAD_BYTES - _PAIR_BYTES * before, lengths)
    offsets += _PAIR_BYTES * np.arange(len(offsets))
    return offsets


def write_cameras(path: StrPath, intrinsics: Sequence[Intrinsics]) -> None:
    """Write ``cameras.bin``."""
    path = Path(path)
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(intrinsics)))
        for camera in intrinsics:
            where = f"camera {camera.camera_id}"
            head = (MODELS[camera.model].model_id, camera.width, camera.height)
            file.write(_pack(_CAMERA, where, camera.camera_id, *head))
            file.write(np.array(camera.params, "<f8").tobytes())


def write_images(path: StrPath, images: Sequence[Image]) -> None:
    """Write ``images.bin``; images without observations get zero features."""
    path = Path(path)
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(images)))
        for image in images:
            pose = (*image.quat.tolist(), *image.translation.tolist())
            values = (image.image_id, *pose, image.intrinsics.camera_id)
            file.write(_pack(_POSE, f"image {image.name!r}", *values))
            name = image.name.encode("utf-8", errors="replace")
            if b"\0" in name or name.decode("utf-8") != image.name:
                expected = "image names in UTF-8 without a zero byte"
                raise OutputError(expected, found=f"{image.name!r}", fix="Rename the image.")
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
            fix="Ids and sizes must be non-negative, ids below 2^32.",
        ) from None


def write_points3d(path: StrPath, points: PointCloud, tracks: Tracks | None) -> None:
    """Write ``points3D.bin``; tracks belong to the first points.

    The other points get ids above the largest, error -1 (COLMAP's "unknown") and no track.
    """
    path = Path(path)
    check_tracks(points, tracks)
    known = len(tracks) if tracks is not None else 0
    heads = np.zeros(len(points), _POINT)
    heads["xyz"], heads["rgb"], heads["error"] = points.xyz, points.rgb, UNKNOWN_ERROR
    first_new = 1
    if tracks is not None and known:
        first_new = int(tracks.point_ids.max()) + 1
        heads["id"][:known], heads["xyz"][:known] = tracks.point_ids, tracks.xyz
        heads["error"][:known], heads["length"][:known] = tracks.errors, tracks.lengths
    heads["id"][known:] = np.arange(first_new, first_new + len(points) - known)
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(points)))
        if tracks is not None:
            file.write(_joined_records(heads[:known], tracks).data)
        file.write(heads[known:].view(np.uint8).data)  # without a track, a record is just its head


def _joined_records(heads: np.ndarray, tracks: Tracks) -> UInt8[np.ndarray, " B"]:
    observations = np.empty(len(tracks.image_ids), _OBSERVATION)
    observations["image_id"], observations["point2d_idx"] = tracks.image_ids, tracks.point2d_idx
    starts = tracks.offsets * _PAIR_BYTES + np.arange(len(heads) + 1) * _HEAD_BYTES
    buffer = np.empty(starts[-1], np.uint8)
    _unaligned_view(buffer, _HEAD_BYTES)[starts[:-1]] = heads.view(f"V{_HEAD_BYTES}")
    _unaligned_view(buffer, _PAIR_BYTES)[_pair_offsets(starts)] = observations.view(
        f"V{_PAIR_BYTES}"
    )
    return buffer


def check_tracks(points: PointCloud, tracks: Tracks | None) -> None:
    """Raise ``PointCloudError`` if there are more tracks than points."""
    if tracks is not None and len(tracks) > len(points):
        raise PointCloudError(
            "at most one track per point",
            found=f"{len(tracks)} tracks for {len(points)} points",
            fix="Replace points with Scene.replace, which drops the tracks of removed points.",
        )


# Text files


def _text_cameras(path: Path) -> Iterator[tuple[Any, ...]]:
    for where, line in _data_lines(path):
        row = line.split()
        with _parsed(where, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", row):
            model = PANORAMA.name if row[1] == _SPHERICAL else row[1]
            record = (int(row[0]), model, int(row[2]), int(row[3]), tuple(map(float, row[4:])))
        yield where, *record


def _text_images(path: Path) -> Iterator[tuple[Any, ...]]:
    """Yield images as ``_binary_images`` does; each has a second line with its features."""
    lines = numbered_lines(path, errors="surrogateescape")  # in names; numbers are checked below
    for where, line in lines:
        if not is_data(line):
            continue
        row = line.strip().split(maxsplit=9)  # a name may hold spaces
        with _parsed(where, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", row):
            pose = tuple(map(float, row[1:8]))
            image_id, camera_id, name = int(row[0]), int(row[8]), row[9]
        # Editors may strip the last image's empty feature line.
        below, features = next(lines, (where, ""))
        fields = features.split()
        with _parsed(below, "X Y POINT3D_ID triples, or a blank line, after an image", fields):
            triples = np.array(fields, object).reshape(-1, 3)
            xy, ids = triples[:, :2].astype(np.float64), triples[:, 2].astype(np.int64)
        yield where, image_id, pose, camera_id, name, Observations(xy, ids)


def _text_points(path: Path) -> _Points:
    ids, lengths, pairs = array("q"), array("q", [0]), array("I")
    xyz, errors, rgb = array("d"), array("d"), bytearray()
    places = []
    for where, line in _data_lines(path):
        row = line.split()
        with _parsed(where, "POINT3D_ID X Y Z R G B ERROR and IMAGE_ID POINT2D_IDX pairs", row):
            if len(row) % 2:
                raise IndexError
            ids.append(int(row[0]))
            xyz.extend((float(row[1]), float(row[2]), float(row[3])))
            rgb += bytes((int(row[4]), int(row[5]), int(row[6])))  # from 0 to 255
            errors.append(float(row[7]))
            pairs.extend(map(int, row[8:]))
        lengths.append((len(row) - 8) // 2)
        places.append(where)
    image_ids, point2d_idx = np.array(pairs, np.uint32).reshape(-1, 2).T.copy()
    tracks = Tracks(
        point_ids=np.array(ids, np.int64),
        xyz=np.array(xyz, np.float64).reshape(-1, 3),
        errors=np.array(errors, np.float64),
        offsets=np.cumsum(lengths, dtype=np.int64),
        image_ids=image_ids,
        point2d_idx=point2d_idx,
    )
    colors = np.frombuffer(bytes(rgb), np.uint8).reshape(-1, 3)
    return colors, tracks, lambda i: places[i].rpartition(", ")[2]


@contextmanager
def _parsed(where: str, layout: str, row: Sequence[str]) -> Iterator[None]:
    """Turn parse errors of a line into ``SceneFormatError`` that shows the line."""
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        fields = " ".join(row)
        line = (
            repr(fields if len(fields) <= 80 else f"{fields[:77]}...") if row else "an empty line"
        )
        raise format_error(layout, where, line) from None


def _data_lines(path: Path) -> Iterator[tuple[str, str]]:
    return (each for each in numbered_lines(path) if is_data(each[1]))
