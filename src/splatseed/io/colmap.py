"""COLMAP's files: cameras, images and points3D, binary (read and written) and as text (read).

``where`` is the place that an error names; of N binary points, ``starts`` [N + 1] are the records'
byte offsets, ended by the end of the last. Promise: a binary file that was read is written back
byte for byte; both forms of a model give the same, to the last bit.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from splatseed.camera import CAMERA_MODELS, PANORAMA, Intrinsics, quat_from_rotation
from splatseed.errors import OutputError, PointCloudError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import COPY_AGAIN, ByteReader, StrPath, numbered_lines
from splatseed.io.origin import around_origin
from splatseed.io.photograph import lens_warnings
from splatseed.io.photograph_checks import image_warnings
from splatseed.io.ply import read_exact_ply
from splatseed.io.point_files import first_with_points, other_points
from splatseed.io.unusable import NotFiniteError, Unusable, check_enough, unusable_warning
from splatseed.pointcloud import PointCloud
from splatseed.scene import NO_POINT, Image, Observations, Scene, SceneSource, Tracks

MAX_ID = 2**32 - 1
"""Camera ids, image ids and feature indices are 32-bit in COLMAP's binary form."""
UNKNOWN_ERROR = -1.0
"""COLMAP's reprojection error of a point that has none yet."""

_MODEL_FILES = ("cameras", "images", "points3D")
IMAGE_DIRS = ("images", "images_2", "images_4", "images_8", "image", "input")
_MAX_SIZE = 2**31 - 1
_MOST_MODELS = 100
"""An unknown camera model with a lower id is taken for a newer one, not for damage."""
_RIGID_TOLERANCE = 1e-3  # of rotation @ rotation.T against the identity
_NORM_RANGE = (1e-100, 1e100)  # inside it the square of a quaternion's norm is a normal float
_POINT_SUFFIXES = (".bin", ".txt", ".ply")
_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")  # camera id, model id, width, height; then the parameters
_POSE = struct.Struct("<I7dI")  # image id, wxyz quaternion, translation, camera id; then the name
LEAST_IMAGE_BYTES = _POSE.size + 1 + 8
"""Of a record in ``images.bin``: an empty name's end, and the number of features."""
_FEATURE = np.dtype([("xy", "<f8", 2), ("point_id", "<u8")])
_POINT = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
_OBSERVATION = np.dtype([("image_id", "<u4"), ("point2d_idx", "<u4")])
# A record of points3D.bin is a head of 51 bytes, whose last field is the track's length L, then L
# observations of 8 bytes; nothing is aligned.
_HEAD_BYTES, _PAIR_BYTES = _POINT.itemsize, _OBSERVATION.itemsize
_LENGTH_AT = 43  # of the track length within a head
_Points: TypeAlias = tuple[UInt8[np.ndarray, "N 3"], Tracks, Callable[[int], str]]
"""Colours, all else, and the place of point i in the file."""


def read_cameras(path: StrPath, unusable: Unusable | None = None) -> tuple[Intrinsics, ...]:
    """The camera records of a ``cameras.bin`` or ``cameras.txt``, in file order.

    Records that are not finite are left out and added to ``unusable``; without it they are errors.
    """
    path = Path(path)
    cameras: dict[int, Intrinsics] = {}
    for where, camera_id, *record in (_text_cameras if path.suffix == ".txt" else _binary_cameras)(
        path
    ):
        _require(camera_id not in cameras, "each camera id once", where, f"{camera_id} again")
        try:
            cameras[camera_id] = make_intrinsics(where, camera_id, *record)
        except NotFiniteError as error:
            if unusable is None:
                raise
            unusable[camera_id] = error
    return tuple(cameras.values())


def make_intrinsics(
    where: str, camera_id: int, model: str, width: int, height: int, params: Sequence[float]
) -> Intrinsics:
    """A checked camera record; a ``NotFiniteError`` if its numbers make no camera."""
    _require(0 <= camera_id <= MAX_ID, f"a camera id from 0 to {MAX_ID}", where, camera_id)
    fits = 0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE
    _require(fits, "a camera with a size in pixels", where, f"{width} x {height}")
    _require_finite(
        all(map(math.isfinite, params)), "finite camera parameters", where, tuple(params)
    )
    try:
        camera = Intrinsics(camera_id, model, width, height, tuple(params))
    except SceneFormatError as error:
        expected = f"{error.expected} in {where}"
        raise SceneFormatError(expected, found=error.found, fix=error.fix) from None
    lengths = camera.params[: CAMERA_MODELS[model].num_focal]
    found = ", ".join(f"{each:g}" for each in lengths)
    _require_finite(min(lengths) > 0, "a focal length above 0", where, found)
    return camera


def read_images(
    path: StrPath, intrinsics: Sequence[Intrinsics], unusable: Unusable | None = None
) -> tuple[Image, ...]:
    """The image records of an ``images.bin`` or ``images.txt``, in file order.

    Those whose pose is not finite, or whose camera is among ``unusable``, are left out and added to
    it by name; without it they are errors.
    """
    path = Path(path)
    cameras = {camera.camera_id: camera for camera in intrinsics}
    images: dict[int, Image] = {}
    names: set[str] = set()
    for record in (_text_images if path.suffix == ".txt" else _binary_images)(path):
        where, image_id, pose, camera_id, name, observations = record
        _require(0 <= image_id <= MAX_ID, f"an image id from 0 to {MAX_ID}", where, image_id)
        _require(image_id not in images, "each image id once", where, f"{image_id} again")
        _require(bool(name), "an image name", where, "an empty one")
        _require(name not in names, "each image name once", where, f"{name} again")
        of = f"of image {name!r}"
        names.add(name)
        if unusable is not None and camera_id in unusable:
            unusable[name] = unusable[camera_id]
            continue
        try:
            _check_pose(pose, of, where)
        except NotFiniteError as error:
            if unusable is None:
                raise
            unusable[name] = error
            continue
        known = f"one of the {len(cameras)} camera records as that {of}"
        _require(camera_id in cameras, known, where, f"camera id {camera_id}")
        ids = observations.point_ids
        in_range = bool((ids >= NO_POINT).all())
        _require(in_range, f"point ids from -1 (none) to 2^63 - 1 {of}", where, "another")
        quat, translation = np.split(np.array(pose, np.float64), [4])
        lens = cameras[camera_id]
        images[image_id] = Image(name, image_id, lens, quat, translation, observations)
    return tuple(images.values())


def _check_pose(pose: Sequence[float], of: str, where: str) -> None:
    _require_finite(all(map(math.isfinite, pose)), f"a finite pose {of}", where, tuple(pose))
    is_rotation = _NORM_RANGE[0] < math.hypot(*pose[:4]) < _NORM_RANGE[1]
    _require_finite(is_rotation, f"a rotation quaternion {of}", where, tuple(pose[:4]))


def read_points3d(path: StrPath) -> tuple[PointCloud, Tracks]:
    """The points of a ``points3D.bin`` or ``points3D.txt`` in file order, and their tracks.

    Nothing is repaired; what is beyond float32 is infinite in the cloud, to be seen and dropped.
    """
    path = Path(path)
    rgb, tracks, place = (_text_points if path.suffix == ".txt" else _binary_points)(path)
    ids = tracks.point_ids
    if (ids < 0).any():
        where = f"{path}, {place(int((ids < 0).argmax()))}"
        raise _bad(f"a point id from 0 to {2**63 - 1}", where, "one outside")
    if not (ids[1:] > ids[:-1]).all():  # the usual order needs no sort
        order = np.argsort(ids, kind="stable")
        again = order[1:][ids[order[1:]] == ids[order[:-1]]]
        if len(again):
            i = int(again.min())
            raise _bad("each point id once", f"{path}, {place(i)}", f"{ids[i]} a second time")
    with np.errstate(over="ignore"):
        return PointCloud(tracks.xyz.astype(np.float32), rgb), tracks


def rigid_pose(
    where: str, world_from_cam: Float64[np.ndarray, "R 4"]
) -> tuple[Float64[np.ndarray, " 4"], Float64[np.ndarray, " 3"]]:
    """Quaternion and translation of ``cam_from_world``; a fourth row must be 0, 0, 0, 1."""
    rotation = world_from_cam[:3, :3].T
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers are not rigid either
        off = np.abs(rotation @ rotation.T - np.eye(3)).max()
        proper = np.linalg.det(rotation) > 0
    affine = np.allclose(world_from_cam[3:], [[0, 0, 0, 1]], atol=_RIGID_TOLERANCE)
    if not (off <= _RIGID_TOLERANCE and proper and affine):
        expected = f"a rotation and a translation as world_from_cam in {where}"
        fix = "Remove the scale from the poses (and from the points)."
        raise SceneFormatError(expected, found="a scaled, sheared or mirrored one", fix=fix)
    return quat_from_rotation(rotation), -rotation @ world_from_cam[:3, 3]


# The binary form


def _binary_cameras(path: Path) -> Iterator[tuple[Any, ...]]:
    reader = ByteReader(path)
    for where in reader.records(_CAMERA.size, "cameras"):
        camera_id, model_id, *size = reader.unpack(_CAMERA)
        known = (*CAMERA_MODELS.values(), PANORAMA)
        model = next((m for m in known if m.model_id == model_id), None)
        if model is None and len(known) <= model_id < _MOST_MODELS:
            raise SceneFormatError(
                f"the id of a camera model of COLMAP 4.2 or older, 0 to {len(known) - 1}, in "
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
    for where in reader.records(LEAST_IMAGE_BYTES, "images"):
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
    return points["rgb"].copy(), tracks, lambda i: f"record {i + 1}"


def _scan_records(data: bytes, first: int, count: int) -> Int64[np.ndarray, " K+1"]:
    """The offsets of ``count`` records that begin at ``first``, then the end of the last."""
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


def write_cameras(path: StrPath, intrinsics: Sequence[Intrinsics]) -> None:
    """Write a ``cameras.bin``."""
    path = Path(path)
    with path.open("wb") as file:
        file.write(_COUNT.pack(len(intrinsics)))
        for camera in intrinsics:
            where = f"camera {camera.camera_id}"
            head = (CAMERA_MODELS[camera.model].model_id, camera.width, camera.height)
            file.write(_pack(_CAMERA, where, camera.camera_id, *head))
            file.write(np.array(camera.params, "<f8").tobytes())


def write_images(path: StrPath, images: Sequence[Image]) -> None:
    """Write an ``images.bin``; images without observations get zero features."""
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
            fix="Ids and sizes are non-negative, ids below 2^32.",
        ) from None


def write_points3d(path: StrPath, points: PointCloud, tracks: Tracks | None) -> None:
    """Write a ``points3D.bin``; tracks belong to the first points.

    The others get the ids that follow the largest, error -1 (COLMAP's "unknown") and no track.
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
        file.write(heads[known:].view(np.uint8).data)  # a record without a track is its head


def _joined_records(heads: np.ndarray, tracks: Tracks) -> UInt8[np.ndarray, " B"]:
    """The bytes of the records of points that have tracks."""
    observations = np.empty(len(tracks.image_ids), _OBSERVATION)
    observations["image_id"], observations["point2d_idx"] = tracks.image_ids, tracks.point2d_idx
    starts = tracks.offsets * _PAIR_BYTES + np.arange(len(heads) + 1) * _HEAD_BYTES
    buffer = np.empty(starts[-1], np.uint8)
    _anywhere(buffer, _HEAD_BYTES)[starts[:-1]] = heads.view(f"V{_HEAD_BYTES}")
    _anywhere(buffer, _PAIR_BYTES)[_pair_offsets(starts)] = observations.view(f"V{_PAIR_BYTES}")
    return buffer


def check_tracks(points: PointCloud, tracks: Tracks | None) -> None:
    """Raise a ``PointCloudError`` if there are more tracks than points."""
    if tracks is not None and len(tracks) > len(points):
        raise PointCloudError(
            "at most one track per point",
            found=f"{len(tracks)} tracks for {len(points)} points",
            fix="Replace the points by Scene.replace, which drops tracks that do not fit.",
        )


# The text form


def _text_cameras(path: Path) -> Iterator[tuple[Any, ...]]:
    for where, line in _data_lines(path):
        row = line.split()
        with _parsed(where, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]", row):
            record = (int(row[0]), row[1], int(row[2]), int(row[3]), tuple(map(float, row[4:])))
        yield where, *record


def _text_images(path: Path) -> Iterator[tuple[Any, ...]]:
    """As ``_binary_images``; the line after an image's is always its features, and may be blank."""
    lines = numbered_lines(path)
    for where, line in lines:
        if not _is_data(line):
            continue
        row = line.strip().split(maxsplit=9)  # a name may hold spaces
        with _parsed(where, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", row):
            pose = tuple(map(float, row[1:8]))
            image_id, camera_id, name = int(row[0]), int(row[8]), row[9]
        # The last image of a file cut by an editor may lack its empty feature line.
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
    """Turn what a block raises over the words of a line into an error that shows the line."""
    try:
        yield
    except (ValueError, IndexError, OverflowError):
        fields = " ".join(row)
        line = repr(fields if len(fields) <= 80 else f"{fields[:77]}...") if row else "an empty one"
        raise _bad(layout, where, line) from None


def _data_lines(path: Path) -> Iterator[tuple[str, str]]:
    return (each for each in numbered_lines(path) if _is_data(each[1]))


def _is_data(line: str) -> bool:
    stripped = line.lstrip()
    return bool(stripped) and not stripped.startswith("#")


def _require(holds: bool, expected: str, where: str, found: object) -> None:
    if not holds:
        raise _bad(expected, where, str(found))


def _require_finite(holds: bool, expected: str, where: str, found: object) -> None:
    if not holds:
        raise NotFiniteError(f"{expected} in {where}", found=str(found), fix=COPY_AGAIN)


def _bad(expected: str, where: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found, fix=COPY_AGAIN)


# A model: a folder with cameras, images and points3D, each as .bin, else .txt


def find_model(*folders: Path) -> Path | None:
    """The first of the given folders that holds a model."""
    return next((f for f in folders if any(model_file(f, name) for name in _MODEL_FILES)), None)


def model_file(model_dir: Path, name: str) -> Path | None:
    """The file of a model that is read for cameras, images or points3D."""
    if name == "points3D":
        return first_with_points(_point_files(model_dir))
    candidates = (model_dir / f"{name}{suffix}" for suffix in (".bin", ".txt"))
    return next((path for path in candidates if path.is_file()), None)


def _point_files(model_dir: Path) -> list[Path]:
    paths = (model_dir / f"points3D{suffix}" for suffix in _POINT_SUFFIXES)
    return [path for path in paths if path.is_file()]


def _other_points(model_dir: Path, root: Path, read: Path, points: PointCloud) -> list[str]:
    """Notes on other files of points, from which other trainers may start."""
    files, notes = _point_files(model_dir), list[str]()
    for i, path in enumerate(files):
        before = " and ".join(each.name for each in files[:i])
        notes += other_points(read, points.xyz, path, f"move {before} out of {model_dir}")
    place = f"copy it to {model_dir / 'points3D.ply'}"
    if first := [each.name for each in files if each.suffix != ".ply"]:
        place += f" and move {' and '.join(first)} out of that folder"
    return notes + other_points(read, points.xyz, root / "init.ply", place)


def scene_root(model_dir: Path) -> Path:
    """The scene's folder: the model's without ``sparse/0`` or ``sparse``, or ``colmap`` above."""
    parts = model_dir.absolute().parts
    levels = 1 if parts[-1] == "sparse" else 2 if parts[-2:-1] == ("sparse",) else 0
    if not levels:
        return model_dir
    above = model_dir.absolute().parents[levels - 1]
    levels += above.name == "colmap" and not any((above / name).is_dir() for name in IMAGE_DIRS)
    named = model_dir if len(model_dir.parts) >= levels else model_dir.absolute()
    return named.parents[levels - 1]


def read_colmap_scene(model_dir: StrPath) -> Scene:
    """The scene of a model: its images, its points, and warnings for the user."""
    model_dir = Path(model_dir)
    root = scene_root(model_dir)
    intrinsics, images, unusable = _read_model(model_dir)
    points, exact, tracks, points_path = read_model_points(model_dir)
    image_dir = _image_dir(root, images)
    warnings = [*image_warnings(images, image_dir, root), *lens_warnings(images)]
    warnings += unusable_warning(unusable, len(images))
    warnings += _other_points(model_dir, root, points_path, points)
    if (root / "transforms.json").is_file():
        warnings.append(f"{root / 'transforms.json'} is there too; name it to read it instead.")
    if not images and (tracks is not None or intrinsics or image_dir is not None):
        tracks, path = None, model_file(model_dir, "images")  # tracks name images
        why = f"{path} lists no images" if path else f"{model_dir} has no images.bin or images.txt"
        warnings.append(
            f"{why}, so no photograph has a pose: copy the whole model, or make one with splatseed"
            " sfm IMAGES -o SCENE. Points can be interpolated, but nothing can be trained."
        )
    source = SceneSource("colmap", root, points_path, model_dir, image_dir)
    scene = Scene(
        points, images, intrinsics, tracks, source, tuple(warnings), absent=tuple(unusable)
    )
    return around_origin(scene, exact)


def _image_dir(root: Path, images: Sequence[Image]) -> Path | None:
    """The first known folder with all images, else with the most; the first at all without any."""
    folders = [root / name for name in IMAGE_DIRS if (root / name).is_dir()]
    held = dict[Path, int]()
    for folder in (*folders, root):
        held[folder] = sum((folder / image.name).is_file() for image in images)
        if held[folder] == len(images) > 0:
            break
    best = max(held, key=lambda folder: held[folder])
    return best if held[best] else next(iter(folders), None)


def read_model_cameras(model_dir: Path) -> tuple[tuple[Intrinsics, ...], tuple[Image, ...]]:
    """The camera and the image records of a model that can be used."""
    return _read_model(model_dir)[:2]


def _read_model(
    model_dir: Path,
) -> tuple[tuple[Intrinsics, ...], tuple[Image, ...], Mapping[str, NotFiniteError]]:
    """The same, and what is wrong with other images, by name.

    Raises:
        NotFiniteError: Fewer than half of the images can be used.
    """
    cameras_path, images_path = model_file(model_dir, "cameras"), model_file(model_dir, "images")
    if cameras_path is None and images_path is not None:
        expected = f"cameras.bin or cameras.txt beside {images_path}"
        raise SceneNotFoundError(expected, found="neither", fix="Copy the whole model.")
    bad: Unusable = {}
    intrinsics = read_cameras(cameras_path, bad) if cameras_path else ()
    images = read_images(images_path, intrinsics, bad) if images_path else ()
    unusable = {name: error for name, error in bad.items() if isinstance(name, str)}
    check_enough(unusable, len(images))
    return intrinsics, images, unusable


def read_model_points(
    model_dir: Path,
) -> tuple[PointCloud, Float64[np.ndarray, "N 3"], Tracks | None, Path]:
    """The points of a model, ``points3D.ply`` if need be, and their positions in double precision.

    Also their tracks, if any, and their file.
    """
    path = model_file(model_dir, "points3D")
    if path is None:
        return PointCloud.empty(), np.empty((0, 3)), None, model_dir / "points3D.bin"
    if path.suffix == ".ply":
        return *read_exact_ply(path), None, path
    points, tracks = read_points3d(path)
    return points, tracks.xyz, tracks, path
