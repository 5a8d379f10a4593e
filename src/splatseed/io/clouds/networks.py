"""Point maps that networks export: NPZ archives of DUSt3R, MASt3R, VGGT and their kin, and GLB.

NPZ: positions are the first of ``POSITIONS`` that is there, of shape [..., 3]; colours the first of
``COLORS`` with as many values, which may hold channels before rows and columns, as networks have
images; ``MASKS`` say which points count, and of ``CONFIDENCES`` those below ``LEAST`` are left out.
GLB (binary glTF): where some primitives are points, only those are read, as exporters draw cameras
as triangles beside them; else the vertices of all meshes. Colours are ``COLOR_0``; nodes'
transforms are applied. Promise: arrays are read in parts, whether compressed or not; pickled
objects, and what glTF's extensions compress, are refused. (trimesh reads a GLB whole, and takes
vertices that it cannot decompress for zeros.)
"""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import rotation_from_quat
from splatseed.errors import SceneFormatError
from splatseed.io.cloud_file import RGB, XYZ, Block, CloudFile, RowCloud, color_bytes
from splatseed.io.files import guarded, open_file, read_npy_header
from splatseed.runtime.memory import check_memory

POSITIONS = ("world_points", "pts3d", "points3d", "points", "xyz", "point_map", "pointmap")
COLORS = ("rgb", "colors", "colours", "color", "images", "imgs", "image", "rgb_img")
MASKS = ("mask", "masks", "valid", "valid_mask")
CONFIDENCES = ("world_points_conf", "conf", "confs", "confidence")
LEAST = 1.5
"""Least confidence that counts: these networks give 1 where they know nothing, and 3 to 30 on
surfaces."""
_STRAIGHTEN = "Save the array row by row: numpy.ascontiguousarray."
_GLTF = (b"glTF", 2, 0x4E4F534A)
"""Magic, version, and the mark of the description."""
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"VEC3": 3, "VEC4": 4}
_POINTS, _TRIANGLES = 0, 4
_WHOLE_NPZ = "an archive of NumPy arrays"
_WHOLE_GLB = "a complete .glb file with vertices"


class _Member(NamedTuple):
    """An array of an archive; ``turned`` if stored column by column, and so read whole."""

    name: str
    shape: tuple[int, ...]
    dtype: np.dtype[Any]
    turned: bool

    @property
    def size(self) -> int:
        """How many values it has."""
        return int(np.prod(self.shape, dtype=np.int64))


class NpzCloud(CloudFile):
    """An .npz archive with an array of points.

    Raises:
        SceneFormatError: It is no archive, or has no array of points, or arrays do not fit.
    """

    def __init__(self, path: Path) -> None:
        members = _members(path)
        points = next((members[name] for name in POSITIONS if name in members), None)
        if points is None or points.shape[-1:] != (3,) or points.dtype.kind not in "fiu":
            found = ", ".join(f"{m.name} {list(m.shape)}" for m in members.values())
            raise SceneFormatError(
                f"{path} to hold points: one of {', '.join(POSITIONS)}, of shape [..., 3]",
                found=found[:200] or "no arrays",
                fix="Save the points under one of these names.",
            )
        count = points.size // 3

        def beside(names: tuple[str, ...], size: int) -> _Member | None:
            there = (members[name] for name in names if name in members)
            return next((m for m in there if m.size == size and m.dtype.kind in "bfiu"), None)

        self._points, self._color = points, beside(COLORS, 3 * count)
        self._mask, self._confidence = beside(MASKS, count), beside(CONFIDENCES, count)
        shape = self._color.shape if self._color else ()
        self._planar = shape[-1:] != (3,) and shape[-3:-2] == (3,)
        if not self._planar and shape[-1:] != (3,):
            self._color = None
        super().__init__(path, (*XYZ, *RGB) if self._color else XYZ, count)

    def _sample(self) -> Block:
        values: Any = self._color and next(_parts(self.path, self._color, 1 << 20), np.empty(0))
        return dict.fromkeys(RGB, values)

    def _blocks(self, size: int) -> Iterator[Block]:
        streams = {"xyz": _parts(self.path, self._points, 3 * size)}
        if self._color:
            streams["rgb"] = self._painted(self._color, size)
        if self._mask:
            streams["mask"] = _parts(self.path, self._mask, size)
        if self._confidence:
            streams["confidence"] = _parts(self.path, self._confidence, size)
        for values in zip(*streams.values(), strict=True):
            parts = dict(zip(streams, values, strict=True))
            table = parts["xyz"].reshape(-1, 3)
            valid = np.ones(len(table), bool)
            if "mask" in parts:
                valid &= parts["mask"] != 0
            if "confidence" in parts:
                valid &= parts["confidence"] >= LEAST
            block = dict(zip(XYZ, table[valid].T, strict=True))
            if "rgb" in parts:
                block |= zip(RGB, parts["rgb"][valid].T, strict=True)
            yield block

    def _painted(self, color: _Member, size: int) -> Iterator[np.ndarray]:
        """Colours [n, 3], ``size`` points at a time."""
        pixels = int(np.prod(color.shape[-2:])) if self._planar else size
        held = np.empty((0, 3), color.dtype)
        for part in _parts(self.path, color, 3 * pixels):
            rgb = part.reshape(3, -1).T if self._planar else part.reshape(-1, 3)
            held = np.concatenate([held, rgb])
            while len(held) >= size:
                yield held[:size]
                held = held[size:]
        if len(held):
            yield held


def _members(path: Path) -> dict[str, _Member]:
    """The arrays of an archive by name."""
    members = {}
    with guarded(path, _WHOLE_NPZ), zipfile.ZipFile(path) as archive:
        for name in archive.namelist():
            if name.endswith(".npy"):
                with archive.open(name) as file:
                    shape, fortran, dtype = read_npy_header(file)
                if not dtype.hasobject:
                    key = name.removesuffix(".npy")
                    members[key] = _Member(key, shape, dtype, fortran and len(shape) > 1)
    return members


def _parts(path: Path, member: _Member, size: int) -> Iterator[np.ndarray]:
    """The values of an array in order, flat, ``size`` at a time."""
    left = member.size
    if member.turned:
        check_memory(2 * left * member.dtype.itemsize, 1, "bytes", fix=_STRAIGHTEN)
        for values in _parts(path, member._replace(turned=False), max(left, 1)):
            straight = values.reshape(member.shape, order="F").ravel()
            yield from (straight[start : start + size] for start in range(0, left, size))
        return
    name = f"{member.name}.npy"
    with guarded(path, _WHOLE_NPZ), zipfile.ZipFile(path) as archive, archive.open(name) as file:
        read_npy_header(file)
        while left:
            count = min(size, left)
            data = file.read(count * member.dtype.itemsize)
            yield np.frombuffer(data, member.dtype, count)
            left -= count


class _Part(NamedTuple):
    """Vertices of one primitive under one node, whose transform is ``matrix``."""

    mode: int
    matrix: Float64[np.ndarray, "4 4"]
    position: RowCloud
    color: RowCloud | None


class GlbCloud(CloudFile):
    """A .glb file.

    Raises:
        SceneFormatError: It is no binary glTF, has no vertices, or is cut short.
    """

    def __init__(self, path: Path) -> None:
        with guarded(path, _WHOLE_GLB), open_file(path) as file:
            magic, version, _, length, kind = struct.unpack("<4sIIII", file.read(20))
            if (magic, version, kind) != _GLTF or length > path.stat().st_size:
                raise ValueError("no binary glTF of version 2")
            content = json.loads(file.read(length))
            parts = list(_primitives(path, content, file.tell() + 8))
            drawn = [part for part in parts if part.mode == _POINTS]
            self._parts = drawn or parts
            if not self._parts:
                raise ValueError("no vertices")
        colored = all(part.color for part in self._parts)
        count = sum(part.position.num_rows for part in self._parts)
        super().__init__(path, (*XYZ, *RGB) if colored else XYZ, count)
        if drawn and len(drawn) < len(parts):
            self.warnings = ("It holds points and meshes: the meshes are left out.",)

    def _sample(self) -> Block:
        return dict.fromkeys(RGB, np.empty(0, np.uint8))  # blocks have bytes

    def _blocks(self, size: int) -> Iterator[Block]:
        with guarded(self.path, _WHOLE_GLB):
            for part in self._parts:
                for start in range(0, part.position.num_rows, size):
                    with np.errstate(invalid="ignore", over="ignore"):
                        xyz = part.position.rows(start, size)["values"].astype(np.float64)
                        xyz = xyz @ part.matrix[:3, :3].T + part.matrix[:3, 3]
                    block = dict(zip(XYZ, xyz.T, strict=True))
                    if part.color and self.has_color:
                        values = part.color.rows(start, size)["values"][:, :3]
                        # Integers are normalised to their range, as glTF has them.
                        is_float = values.dtype.kind == "f"
                        full = 1 if is_float else np.iinfo(values.dtype).max
                        block |= zip(RGB, color_bytes(values, full).T, strict=True)
                    yield block


def _primitives(path: Path, content: Mapping[str, Any], body: int) -> Iterator[_Part]:
    """The primitives of the scene's nodes; the binary part begins at ``body``."""
    for mesh, matrix in _placed(content):
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
                raise ValueError("not a colour for each vertex")
            yield _Part(mode, matrix, tables["POSITION"], color)


def _placed(content: Mapping[str, Any]) -> Iterator[tuple[int, Float64[np.ndarray, "4 4"]]]:
    """Meshes with the transform from their own frame to the scene's."""
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
    """A node's transform: a matrix by columns, or translation, rotation xyzw and scale."""
    if "matrix" in node:
        return np.array(node["matrix"], np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = node.get("rotation", (0.0, 0.0, 0.0, 1.0))
    matrix[:3, :3] = rotation_from_quat(np.array([w, x, y, z])) * node.get("scale", (1.0, 1.0, 1.0))
    matrix[:3, 3] = node.get("translation", (0.0, 0.0, 0.0))
    return matrix


def _table(path: Path, content: Mapping[str, Any], index: int, body: int) -> RowCloud:
    """The rows of an accessor, which may lie between those of others."""
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
