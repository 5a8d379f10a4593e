"""GLB: binary glTF, in which DUSt3R, MASt3R, VGGT and trimesh export coloured points.

Where some primitives are points, only those are read, as exporters draw cameras as triangles beside
them; else the vertices of all meshes. Colours are ``COLOR_0``. Nodes' transforms are applied.
Promise: vertices are read by offset; what glTF's extensions compress is refused.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.io.clouds.cloud_file import CHUNK, CloudChunk, CloudFile
from splatseed.io.clouds.rows import COPY_AGAIN, check_size
from splatseed.io.files import open_file
from splatseed.literal import told

_MAGIC, _JSON = b"glTF", 0x4E4F534A
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"VEC3": 3, "VEC4": 4}
_POINTS, _TRIANGLES = 0, 4
_DEEPEST = 64


@dataclass(frozen=True, eq=False)
class _Accessor:
    """A column of the binary part.

    Args:
        offset: Where its first row begins in the file.
        stride: Bytes from row to row.
        count: Rows.
        width: Values in a row.
        dtype: Their type.
    """

    offset: int
    stride: int
    count: int
    width: int
    dtype: np.dtype[Any]

    def read(self, path: Path, start: int, size: int) -> np.ndarray:
        """Rows from ``start`` on, at most ``size``, [n, width]."""
        size = min(size, self.count - start)
        with open_file(path) as file:
            file.seek(self.offset + start * self.stride)
            data = file.read((size - 1) * self.stride + self.width * self.dtype.itemsize)
        shape, strides = (size, self.width), (self.stride, self.dtype.itemsize)
        return np.ndarray(shape, self.dtype, data, 0, strides)


@dataclass(frozen=True, eq=False)
class _Part:
    """Vertices of one primitive under one node."""

    mode: int
    matrix: Float64[np.ndarray, "4 4"]
    position: _Accessor
    color: _Accessor | None


class GlbCloud(CloudFile):
    """A .glb file.

    Raises:
        SceneFormatError: It is no binary glTF, has no vertices, or is cut short.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            content, body = _read_json(path)
            parts = list(_parts(path, content, body))
        except (KeyError, IndexError, TypeError, ValueError, struct.error) as error:
            raise _damaged(path, told(error)) from None
        drawn = [part for part in parts if part.mode == _POINTS]
        self._parts = tuple(drawn or parts)
        if not self._parts:
            raise _damaged(path, "no vertices")
        for part in self._parts:
            for each in (part.position, part.color):
                if each is not None and each.count:
                    last = each.offset + (each.count - 1) * each.stride
                    check_size(path, last + each.width * each.dtype.itemsize)
        self.count = sum(part.position.count for part in self._parts)
        self.colors = "rgb" if all(part.color for part in self._parts) else "none"
        if drawn and len(drawn) < len(parts):
            self.warnings = ("It holds points and meshes: the meshes are left out.",)

    def chunks(self, size: int = CHUNK) -> Iterator[CloudChunk]:
        """See ``CloudFile.chunks``."""
        for part in self._parts:
            for start in range(0, part.position.count, size):
                with np.errstate(invalid="ignore", over="ignore"):
                    xyz = part.position.read(self.path, start, size).astype(np.float64)
                    xyz = xyz @ part.matrix[:3, :3].T + part.matrix[:3, 3]
                rgb = None
                if self.colors == "rgb" and part.color is not None:
                    rgb = _bytes_of(part.color.read(self.path, start, size)[:, :3])
                yield CloudChunk(xyz, rgb)


def _bytes_of(values: np.ndarray) -> np.ndarray:
    """Colours as bytes; integers are normalised to their range, as glTF has them."""
    full = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    scaled = np.nan_to_num(values.astype(np.float64) * (255.0 / full), nan=128.0)
    return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def _read_json(path: Path) -> tuple[Mapping[str, Any], int]:
    """The description, and the offset of the binary part."""
    with open_file(path) as file:
        magic, version, _ = struct.unpack("<4sII", file.read(12))
        if magic != _MAGIC or version != 2:
            raise ValueError(f"magic {magic!r}, version {version}")
        length, kind = struct.unpack("<II", file.read(8))
        if kind != _JSON or length > path.stat().st_size:
            raise ValueError("no description at the start")
        content = json.loads(file.read(length))
        return content, file.tell() + 8


def _parts(path: Path, content: Mapping[str, Any], body: int) -> Iterator[_Part]:
    """The primitives of the scene's nodes."""
    for mesh, matrix in _placed(content):
        for primitive in content["meshes"][mesh]["primitives"]:
            if "KHR_draco_mesh_compression" in primitive.get("extensions", {}):
                raise _damaged(path, "vertices compressed by Draco")
            attributes = primitive["attributes"]
            color = attributes.get("COLOR_0")
            yield _Part(
                int(primitive.get("mode", _TRIANGLES)),
                matrix,
                _accessor(content, attributes["POSITION"], body),
                None if color is None else _accessor(content, color, body),
            )


def _placed(content: Mapping[str, Any]) -> Iterator[tuple[int, Float64[np.ndarray, "4 4"]]]:
    """Meshes with the transform from their own frame to the scene's."""
    nodes = content.get("nodes", [])
    scenes = content.get("scenes")
    children = {child for node in nodes for child in node.get("children", [])}
    roots = [i for i in range(len(nodes)) if i not in children]
    if scenes:
        roots = scenes[content.get("scene", 0)].get("nodes", roots)
    waiting = [(root, np.eye(4), 0) for root in reversed(roots)]
    while waiting:
        index, above, depth = waiting.pop()
        if depth > _DEEPEST:
            raise ValueError("nodes that contain each other")
        node = nodes[index]
        matrix = above @ _matrix(node)
        if "mesh" in node:
            yield node["mesh"], matrix
        below = reversed(node.get("children", []))
        waiting += [(child, matrix, depth + 1) for child in below]


def _matrix(node: Mapping[str, Any]) -> Float64[np.ndarray, "4 4"]:
    """A node's transform: a matrix by columns, or translation, rotation xyzw and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix[:3, :3] = rotation_from_quat(np.array([w, x, y, z])) * node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _accessor(content: Mapping[str, Any], index: int, body: int) -> _Accessor:
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    if view.get("buffer", 0) != 0 or "sparse" in accessor:
        raise ValueError("vertices in another file, or sparse")
    dtype, width = np.dtype(_TYPES[accessor["componentType"]]), _WIDTHS[accessor["type"]]
    offset = body + int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    stride = int(view.get("byteStride", 0)) or width * dtype.itemsize
    return _Accessor(offset, stride, int(accessor["count"]), width, dtype)


def _damaged(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to be a complete .glb file with vertices", found=found[:160], fix=COPY_AGAIN
    )
