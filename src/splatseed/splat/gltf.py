"""Read Gaussians in glTF, by its extension KHR_gaussian_splatting: .glb, and .gltf with buffers.

Sizes are lengths, opacities from 0 to 1, rotations xyzw, and harmonics as in 3DGS. glTF's axes are
left, up, front; ours are right, down, front: x and y change sign. A node's transform applies to its
Gaussians. Source: KhronosGroup/glTF (extensions/2.0/Khronos/KHR_gaussian_splatting), of 2026.
"""

from __future__ import annotations

import base64
import dataclasses
import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from jaxtyping import Float64

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.clouds.networks import placed_meshes
from splatseed.io.files import read_bytes, translate_errors
from splatseed.progress import Note, silent_note
from splatseed.requirements import require
from splatseed.similarity import similarity_of
from splatseed.splat.gaussians import PARAMETERS, Gaussians
from splatseed.splat.model_frame import transform_gaussians
from splatseed.splat.parameters import check_parameters
from splatseed.splat.spz import axis_signs

MAGIC = b"glTF"
EXTENSION = "KHR_gaussian_splatting"
_LEFT_UP_FRONT = 7
"""glTF's axes, as ``spz`` numbers them."""
_BASE = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective"}
"""Properties of the extension, and the values that splatseed renders."""
_JSON, _BINARY = 0x4E4F534A, 0x004E4942
"""Types of a .glb's chunks."""
_KINDS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MAX_DEGREE = 3
_COMPLETE = f"a complete glTF with Gaussians ({EXTENSION})"
_FIX = "Export a .ply or .spz where it came from."


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode the Gaussians of all nodes."""
    with translate_errors(path, _COMPLETE, fix=_FIX):
        content, buffers = _contents(path)
        parts = list(_placed(path, content, buffers, note))
        if not parts:
            raise SceneFormatError(
                f"{path} to hold trained Gaussians ({EXTENSION})",
                found="points or meshes without this extension",
                fix="As a scan, it is read by splatseed upsample SCENE --cloud.",
            )
        rest = max(part.shN.shape[1] for part in parts)
        parts = [_padded(part, rest) for part in parts]
        signs = axis_signs(_LEFT_UP_FRONT)
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in PARAMETERS
        }
        text = "The axes of the model were read as glTF's: left, up, front."
        fix = "If it is upside down, they had not been converted (docs/models.md)."
        note(Finding("gltf-axes", text, "info", fix=fix))
        arrays["means"] = arrays["means"] * signs.position
        w, x, y, z = arrays["quats"].T
        arrays["quats"] = np.stack([-z, -y, x, w], axis=1)  # turned by 180 degrees about z
        arrays["shN"] = arrays["shN"] * signs.sh[:rest, None]
        return Gaussians(**arrays)


def _contents(path: Path) -> tuple[Mapping[str, Any], Sequence[bytes]]:
    """Return the JSON and the buffers of a .glb or .gltf."""
    data = read_bytes(path)
    if not data.startswith(MAGIC):
        content = json.loads(data)
        return content, [_buffer(path, each["uri"]) for each in content["buffers"]]
    chunks: dict[int, bytes] = {}
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        chunks.setdefault(kind, data[at + 8 : at + 8 + length])
        at += 8 + length
    return json.loads(chunks[_JSON]), [chunks.get(_BINARY, b"")]


def _buffer(path: Path, uri: str) -> bytes:
    if uri.startswith("data:"):
        return base64.b64decode(uri.partition(",")[2])
    return read_bytes(path.parent / Path(unquote(uri)).name)


def _placed(
    path: Path, content: Mapping[str, Any], buffers: Sequence[bytes], note: Note
) -> Iterator[Gaussians]:
    """Yield the Gaussians of each primitive, in the scene's frame."""
    for mesh, matrix in placed_meshes(content):
        world = similarity_of(matrix)
        for primitive in content["meshes"][mesh]["primitives"]:
            extension = primitive.get("extensions", {}).get(EXTENSION)
            if extension is None:
                continue
            _check(path, extension)
            if world is None:
                raise ValueError("a node that mirrors, shears or stretches its Gaussians")
            part = _primitive(path, content, buffers, primitive["attributes"], note)
            if (world.rotation != np.eye(3)).any():
                require("torch")  # rotates harmonics
                part = transform_gaussians(part, world)
            elif (matrix != np.eye(4)).any():
                part = dataclasses.replace(
                    part,
                    means=world.points(part.means).astype(np.float32),
                    scales=part.scales + np.float32(np.log(world.scale)),
                )
            yield part


def _padded(gaussians: Gaussians, rest: int) -> Gaussians:
    """Add harmonics of 0 up to ``rest`` coefficients beyond the first."""
    more = ((0, 0), (0, rest - gaussians.shN.shape[1]), (0, 0))
    return dataclasses.replace(gaussians, shN=np.pad(gaussians.shN, more))


def _check(path: Path, extension: Mapping[str, Any]) -> None:
    """Raise unless these are Gaussians as of 3DGS, uncompressed and in sRGB."""
    others = [f"{name} {extension[name]!r}" for name in _BASE if name in extension]
    others = [each for each in others if each not in {f"{n} {v!r}" for n, v in _BASE.items()}]
    others += list(extension.get("extensions", {}))
    if others:
        raise SceneFormatError(
            f"{path} to hold Gaussians as of 3DGS, in sRGB and uncompressed",
            found=", ".join(others),
            fix=_FIX,
        )


def _primitive(
    path: Path,
    content: Mapping[str, Any],
    buffers: Sequence[bytes],
    attributes: Mapping[str, int],
    note: Note,
) -> Gaussians:
    prefix = f"{EXTENSION}:"
    named = {name.removeprefix(prefix): index for name, index in attributes.items()}
    rest = []
    for degree in range(1, _MAX_DEGREE + 1):
        names = [f"SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)]
        if not set(names) & named.keys():
            break
        rest += names
    own = ["POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"]
    if missing := [name for name in (*own, *rest) if name not in named]:
        raise ValueError(f"no attributes {', '.join(missing)}")
    check_parameters(path, named, (*own, *rest, "COLOR_0"), note)
    values = {name: _accessor(content, buffers, named[name]) for name in (*own, *rest)}
    with np.errstate(divide="ignore", invalid="ignore"):
        opacity = values["OPACITY"][:, 0]
        arrays = {
            "means": values["POSITION"],
            "scales": np.log(values["SCALE"]),
            "quats": np.roll(values["ROTATION"], 1, axis=1),
            "opacities": np.log(opacity) - np.log1p(-opacity),
            "sh0": values["SH_DEGREE_0_COEF_0"][:, None],
            "shN": np.stack([np.empty((len(opacity), 3)), *(values[name] for name in rest)], 1)[
                :, 1:
            ],
        }
    return Gaussians(**{name: array.astype(np.float32) for name, array in arrays.items()})


def _accessor(
    content: Mapping[str, Any], buffers: Sequence[bytes], index: int
) -> Float64[np.ndarray, "N C"]:
    """Read an accessor; normalised integers become fractions of their largest."""
    accessor = content["accessors"][index]
    view = content["bufferViews"][accessor["bufferView"]]
    if "sparse" in accessor or view.get("extensions"):
        raise ValueError(
            f"attributes that are sparse or compressed: {[*view.get('extensions', {})]}"
        )
    kind, width = np.dtype(_KINDS[accessor["componentType"]]), _WIDTHS[accessor["type"]]
    stride = int(view.get("byteStride", 0)) or kind.itemsize * width
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    raw = np.ndarray(
        (int(accessor["count"]), width), kind, buffers[int(view.get("buffer", 0))], start,
        (stride, kind.itemsize),
    )  # fmt: skip
    values = raw.astype(np.float64)
    if accessor.get("normalized") and kind.kind != "f":
        return np.asarray(np.maximum(values / np.iinfo(kind).max, -1.0))
    return values
