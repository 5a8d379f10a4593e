"""Point maps that networks export: NPZ archives of DUSt3R, MASt3R, VGGT and similar, and GLB.

NPZ: positions are the first array of ``POSITIONS`` found, of shape [..., 3]; colours the first of
``COLORS`` of the same size, with channels last or before rows and columns. ``MASKS`` select points;
points whose ``CONFIDENCES`` are below ``MIN_CONFIDENCE`` are dropped. GLB (binary glTF): if any
primitive is of points, only those are read, since exporters draw cameras as triangles beside them;
otherwise the vertices of all meshes. (trimesh loads the whole file into memory, and turns vertices
that it cannot decompress into zeros; here they are refused.)
"""

from __future__ import annotations

import json
import math
import struct
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.cloud_file import RGB, XYZ, Block, CloudFile, RowCloud, to_uint8
from splatseed.io.files import open_file, read_npy, read_npy_header, translate_errors
from splatseed.runtime.memory import check_memory

POSITIONS = ("world_points", "pts3d", "points3d", "points", "xyz", "point_map", "pointmap")
COLORS = ("rgb", "colors", "colours", "color", "images", "imgs", "image", "rgb_img")
MASKS = ("mask", "masks", "valid", "valid_mask")
CONFIDENCES = ("world_points_conf", "conf", "confs", "confidence")
MIN_CONFIDENCE = 1.5
"""Lowest confidence kept: these networks give 1 where they are uncertain, 3 to 30 on surfaces."""
_FEWER = "Save fewer views per archive, or the points as a binary PLY, which is read in chunks."
_NONE = ((), False, np.dtype(object))
_SAMPLED = 1 << 18
_GLTF = (b"glTF", 2, 0x4E4F534A)
"""Magic, version, and the type of the JSON chunk."""
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"VEC3": 3, "VEC4": 4}
_POINTS, _TRIANGLES = 0, 4
_NPZ = "an archive of NumPy arrays"
_GLB = "a complete .glb file with vertices"


class NpzCloud(CloudFile):
    """An .npz archive with an array of points; one array at a time must fit in memory."""

    def __init__(self, path: Path) -> None:
        shapes: dict[str, tuple[int, ...]] = {}
        with translate_errors(path, _NPZ), zipfile.ZipFile(path) as archive:
            for name in archive.namelist():
                with archive.open(name) as file:
                    shape, _, dtype = read_npy_header(file) if name.endswith(".npy") else _NONE
                if dtype.kind in "bfiu":
                    shapes[name.removesuffix(".npy")] = shape
        points = next((name for name in POSITIONS if name in shapes), "")
        if shapes.get(points, ())[-1:] != (3,):
            found = ", ".join(f"{name} {list(shape)}" for name, shape in shapes.items())
            raise SceneFormatError(
                f"{path} to hold points: one of {', '.join(POSITIONS)}, of shape [..., 3]",
                found=found[:200] or "no arrays",
                fix="Save the points under one of these names.",
            )
        count = math.prod(shapes[points]) // 3

        def beside(names: Sequence[str], size: int) -> str | None:
            return next((n for n in names if n in shapes and math.prod(shapes[n]) == size), None)

        color = beside(COLORS, 3 * count)
        if color and 3 not in (shapes[color][-1:] + shapes[color][-3:-2]):
            color = None
        self._names = (points, color, beside(MASKS, count), beside(CONFIDENCES, count))
        super().__init__(path, (*XYZ, *RGB) if color else XYZ, count)

    def _sample(self) -> Block:
        color = self._array(self._names[1])
        return dict.fromkeys(RGB, None if color is None else color[:_SAMPLED])

    def _blocks(self, size: int) -> Iterator[Block]:
        points, color, mask, confidence = map(self._array, self._names)
        assert points is not None  # noqa: S101  (its name is known)
        valid = np.ones(len(points), bool)
        if mask is not None:
            valid &= mask[:, 0] != 0
        if confidence is not None:
            valid &= confidence[:, 0] >= MIN_CONFIDENCE
        for start in range(0, len(points), size):
            part = slice(start, start + size)
            block = dict(zip(XYZ, points[part][valid[part]].T, strict=True))
            if color is not None:
                block |= zip(RGB, color[part][valid[part]].T, strict=True)
            yield block

    def _array(self, name: str | None) -> np.ndarray | None:
        """Read an array, one row per point."""
        if name is None:
            return None
        with translate_errors(self.path, _NPZ), zipfile.ZipFile(self.path) as archive:
            info = archive.getinfo(f"{name}.npy")
            check_memory(2 * info.file_size, 1, "bytes of arrays", fix=_FEWER)
            with archive.open(info) as file:
                array = read_npy(file, info.file_size)
            if name in COLORS and array.shape[-1] != 3:  # channels come before rows and columns
                array = np.moveaxis(array, -3, -1)
            width = 3 if name in (*POSITIONS, *COLORS) else 1
            return array.reshape(-1, width)


class _Part(NamedTuple):
    """Vertices of a primitive of a node; ``matrix`` maps them to the scene."""

    mode: int
    matrix: Float64[np.ndarray, "4 4"]
    position: RowCloud
    color: RowCloud | None


class GlbCloud(CloudFile):
    """A .glb file."""

    def __init__(self, path: Path) -> None:
        with translate_errors(path, _GLB), open_file(path) as file:
            magic, version, _, length, kind = struct.unpack("<4sIIII", file.read(20))
            if (magic, version, kind) != _GLTF or length > path.stat().st_size:
                raise ValueError("no binary glTF of version 2")
            content = json.loads(file.read(length))
            parts = list(_primitives(path, content, file.tell() + 8))
            points = [part for part in parts if part.mode == _POINTS]
            self._parts = points or parts
            if not self._parts:
                raise ValueError("no vertices")
        colored = all(part.color for part in self._parts)
        count = sum(part.position.num_rows for part in self._parts)
        super().__init__(path, (*XYZ, *RGB) if colored else XYZ, count)
        if points and len(points) < len(parts):
            text = "It holds points and meshes: the meshes are left out."
            self.findings = (Finding("meshes-left-out", text),)

    def _sample(self) -> Block:
        return dict.fromkeys(RGB, np.empty(0, np.uint8))  # blocks have bytes

    def _blocks(self, size: int) -> Iterator[Block]:
        with translate_errors(self.path, _GLB):
            for part in self._parts:
                for start in range(0, part.position.num_rows, size):
                    with np.errstate(invalid="ignore", over="ignore"):
                        xyz = part.position.rows(start, size)["values"].astype(np.float64)
                        xyz = xyz @ part.matrix[:3, :3].T + part.matrix[:3, 3]
                    block = dict(zip(XYZ, xyz.T, strict=True))
                    if part.color and self._rgb:
                        values = part.color.rows(start, size)["values"][:, :3]
                        # glTF normalises integers by their largest value.
                        full = 1 if values.dtype.kind == "f" else np.iinfo(values.dtype).max
                        block |= zip(RGB, to_uint8(values, full).T, strict=True)
                    yield block


def _primitives(path: Path, content: Mapping[str, Any], body: int) -> Iterator[_Part]:
    for mesh, matrix in placed_meshes(content):
        for primitive in content["meshes"][mesh]["primitives"]:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise ValueError("vertices compressed by Draco")
            tables = {
                name: _table(path, content, accessor, body)
                for name, accessor in primitive["attributes"].items()
                if name in {"POSITION", "COLOR_0"}
            }
            mode, color = int(primitive.get("mode", _TRIANGLES)), tables.get("COLOR_0")
            if color and color.num_rows != tables["POSITION"].num_rows:
                raise ValueError("not one colour per vertex")
            yield _Part(mode, matrix, tables["POSITION"], color)


def placed_meshes(content: Mapping[str, Any]) -> Iterator[tuple[int, Float64[np.ndarray, "4 4"]]]:
    """Yield meshes with the transform from their frame to the scene's."""
    nodes, scenes = content.get("nodes", []), content.get("scenes")
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in children]
    if scenes:
        roots = scenes[content.get("scene", 0)].get("nodes", roots)
    waiting, seen = [(root, np.eye(4)) for root in reversed(roots)], set[int]()
    while waiting:
        index, above = waiting.pop()
        if index in seen:
            raise ValueError("nodes with several parents")
        seen.add(index)
        node = nodes[index]
        matrix = above @ _matrix(node)
        if "mesh" in node:
            yield node["mesh"], matrix
        waiting += [(child, matrix) for child in reversed(node.get("children", []))]


def _matrix(node: Mapping[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """Return a node's transform, stored as a column-major matrix or as translation, xyzw, scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix[:3, :3] = rotation_from_quat(np.array([w, x, y, z])) * node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _table(path: Path, content: Mapping[str, Any], index: int, body: int) -> RowCloud:
    """Return the rows of an accessor, which may be interleaved with others."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "sparse" in accessor:
        raise ValueError("vertices in another file, or sparse")
    item = np.dtype((_TYPES[accessor["componentType"]], (_WIDTHS[accessor["type"]],)))
    stride, at = int(view.get("byteStride", 0)) or item.itemsize, int(accessor.get("byteOffset", 0))
    within = at % stride if stride > item.itemsize else 0
    layout: Any = {"names": ["values"], "formats": [item], "offsets": [within], "itemsize": stride}
    start = body + int(view.get("byteOffset", 0)) + at - within
    return RowCloud(path, np.dtype(layout), start, int(accessor["count"]))
