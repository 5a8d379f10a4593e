"""PlayCanvas's SOG, version 2: a .zip of lossless WebP pictures and ``meta.json``.

Notation: each picture has one pixel per Gaussian; a *codebook* is 256 numbers that bytes stand for,
a *palette* a table of coefficients that Gaussians share. Source: the format's specification by
PlayCanvas.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8

from splatseed.errors import SceneFormatError
from splatseed.export.codebook import codebook, codes, palette
from splatseed.export.formats import CONVERTER
from splatseed.export.packing import (
    SH_COUNTS,
    from_smallest_three,
    morton_order,
    opacity_bytes,
    opacity_logits,
    smallest_three,
)
from splatseed.io.files import ARCHIVE_FAILURES, read_bytes
from splatseed.literal import told
from splatseed.progress import Progress, silent
from splatseed.splat.gaussians import Gaussians

Pixels = UInt8[np.ndarray, "N 4"]

VERSION = 2
META = "meta.json"
PER_ROW = 64
"""Palette entries per row of the centroid picture."""
MOST_LEVELS, LEAST_LEVELS = 16, 10
"""The palette grows with the number of Gaussians, from 2^10 to 2^16 entries at most."""
MOST_BYTES = 2**31
MOST_META = 1 << 24
"""Larger parts of an archive are refused unread; meta.json takes some kilobytes."""
QUAT_MARK = 252
"""Alpha of a rotation whose largest component is the first; SOG's marker."""
FIX = "Copy the file again, or export it again."
STAMP = (1980, 1, 1, 0, 0, 0)
"""The timestamp of each picture in the zip, fixed so that equal Gaussians give equal bytes."""


def encode(gaussians: Gaussians, progress: Progress = silent) -> bytes:
    """The bytes of a file with the Gaussians, in Z-curve order."""
    order = morton_order(gaussians.means)
    low, high, positions = _encoded_positions(gaussians.means[order])
    largest, three = smallest_three(gaussians.quats[order])
    # The three smaller components in RGB, 252 + the index of the largest in A.
    quats = np.column_stack([_byte(three * np.sqrt(0.5) * 255 + 127.5), QUAT_MARK + largest])
    scales, sh0 = codebook(gaussians.scales), codebook(gaussians.sh0)
    colors = codes(gaussians.sh0[order, 0], sh0)
    opacity = opacity_bytes(gaussians.opacities[order])
    pictures = {
        "means_l.webp": _grid(positions & 255),  # 16 bits: low bytes, then high ones
        "means_u.webp": _grid(positions >> 8),
        "quats.webp": _grid(quats),
        "scales.webp": _grid(codes(gaussians.scales[order], scales)),
        "sh0.webp": _grid(np.column_stack([colors, opacity])),
    }
    meta: dict[str, Any] = {
        "version": VERSION,
        "asset": {"generator": "splatseed"},
        "count": len(order),
        "means": {"mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": sh0.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.shN.shape[1] and len(order) > 1:
        meta["shN"], more = _encoded_harmonics(gaussians.shN[order], progress)
        pictures.update(more)
    return _zipped(meta, pictures)


def decode(path: Path) -> Gaussians:
    """The Gaussians in a file, or in the unpacked folder that a ``meta.json`` lies in.

    Raises:
        SceneNotFoundError: There is no such file, or a picture beside its ``meta.json`` is missing.
        SceneFormatError: It is damaged, or of another version.
    """
    try:
        return _decoded(path, _opened(path))
    except ARCHIVE_FAILURES as error:
        raise _damaged(path, told(error)) from None


def _decoded(path: Path, content: Callable[[str], bytes]) -> Gaussians:
    meta = json.loads(content(META))
    if "means" not in meta:  # of every version; a run's metrics.json has none
        raise _damaged(path, "JSON that describes no Gaussians")
    if meta.get("version") != VERSION:
        raise SceneFormatError(
            f"{path} to be a SOG of version {VERSION}",
            found=f"version {meta.get('version', 1)}",
            fix=f"Convert it: {CONVERTER} IN OUT.sog.",
        )
    count = int(meta["count"])
    if count < 1:
        raise _damaged(path, f"{count} Gaussians")

    def pixels(part: str, which: int = 0, least: int = count) -> UInt8[np.ndarray, "P 4"]:
        name = meta[part]["files"][which]
        rows = _picture(content(name)).reshape(-1, 4)
        if len(rows) < least:
            raise _damaged(path, f"{len(rows):,} pixels in {name}, of {least:,}")
        return rows[:least]

    low, high = (pixels("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
    quats, sh0 = pixels("quats"), pixels("sh0")
    centers = {part: np.array(meta[part]["codebook"], np.float32) for part in ("scales", "sh0")}
    return Gaussians(
        means=_decoded_positions(low | high << 8, meta["means"]),
        scales=centers["scales"][pixels("scales")[:, :3]],
        quats=from_smallest_three(
            np.clip(quats[:, 3].astype(np.int64) - QUAT_MARK, 0, 3),
            ((quats[:, :3] / 255 - 0.5) * np.sqrt(2)).astype(np.float32),
        ),
        opacities=opacity_logits(sh0[:, 3]),
        sh0=centers["sh0"][sh0[:, None, :3]],
        shN=_decoded_harmonics(meta["shN"], pixels, count)
        if "shN" in meta
        else np.zeros((count, 0, 3), np.float32),
    )


def _encoded_positions(
    means: Float32[np.ndarray, "N 3"],
) -> tuple[list[float], list[float], Int64[np.ndarray, "N 3"]]:
    # sign(p) log(1 + |p|): finer steps near the middle of the scene
    curved = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = curved.min(axis=0), curved.max(axis=0)
    extent = np.where(high > low, high - low, 1)
    return low.tolist(), high.tolist(), np.rint((curved - low) / extent * 65535).astype(np.int64)


def _decoded_positions(
    values: np.ndarray, meta: dict[str, list[float]]
) -> Float32[np.ndarray, "N 3"]:
    low, high = (np.array(meta[end], np.float64) for end in ("mins", "maxs"))
    curved = low + values / 65535 * (high - low)
    return np.asarray(np.sign(curved) * np.expm1(np.abs(curved)), np.float32)


def _encoded_harmonics(
    shN: Float32[np.ndarray, "N K 3"], progress: Progress
) -> tuple[dict[str, Any], dict[str, Pixels]]:
    count, rest, _ = shN.shape
    levels = int(np.clip(np.log2(count), 0, MOST_LEVELS))
    if count >= 2**LEAST_LEVELS:  # as in PlayCanvas's writer: 1024 for each 1024 Gaussians
        levels = int(np.clip(np.log2(count), LEAST_LEVELS, MOST_LEVELS))
    entries, labels = palette(shN.reshape(count, -1), levels, progress)
    centers = codebook(entries)
    table = codes(entries, centers).reshape(len(entries), rest, 3)
    # Entries are bytes of a third codebook, 64 entries per row.
    rows = -(-len(entries) // PER_ROW)
    picture = np.full((rows * PER_ROW, rest, 4), 255, np.uint8)
    picture[: len(table), :, :3] = table
    low_high = np.column_stack([labels & 255, labels >> 8, np.zeros(count, np.int64)])
    meta = {
        "count": len(entries),
        "bands": SH_COUNTS.index(rest),
        "codebook": centers.tolist(),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }
    pictures = {
        "shN_centroids.webp": picture.reshape(rows, PER_ROW * rest, 4),
        "shN_labels.webp": _grid(low_high),
    }
    return meta, pictures


def _decoded_harmonics(
    meta: dict[str, Any], pixels: Callable[..., UInt8[np.ndarray, "P 4"]], count: int
) -> Float32[np.ndarray, "N K 3"]:
    rest, entries = SH_COUNTS[int(meta["bands"])], int(meta["count"])
    centers = np.array(meta["codebook"], np.float32)
    table = centers[pixels("shN", 0, entries * rest)[:, :3].reshape(entries, rest, 3)]
    labels = pixels("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
    return np.asarray(table[labels].reshape(count, rest, 3))


def _byte(values: Float64[np.ndarray, "..."]) -> UInt8[np.ndarray, "..."]:
    return np.asarray(np.clip(np.rint(values), 0, 255), np.uint8)


def _grid(values: np.ndarray) -> UInt8[np.ndarray, "H W 4"]:
    """One pixel per row of 3 or 4 bytes, in a near-square picture; sides are multiples of 4."""
    width = 4 * int(np.ceil(np.sqrt(len(values)) / 4))
    height = 4 * int(np.ceil(len(values) / width / 4))
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _zipped(meta: dict[str, Any], pictures: dict[str, Pixels]) -> bytes:
    from PIL import Image  # noqa: PLC0415  (slow to import)

    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(META, STAMP), json.dumps(meta))
        for name, pixels in pictures.items():
            picture = io.BytesIO()
            # exact keeps colours where alpha is 0, which opacities and quaternions need.
            Image.fromarray(pixels).save(picture, "WEBP", lossless=True, exact=True, quality=75)
            archive.writestr(zipfile.ZipInfo(name, STAMP), picture.getvalue())
    return file.getvalue()


def _opened(path: Path) -> Callable[[str], bytes]:
    """A function that returns the content of a named part."""
    if path.name.lower().endswith(".json"):
        return lambda name: read_bytes(path if name == META else path.parent / Path(name).name)
    archive = zipfile.ZipFile(io.BytesIO(read_bytes(path)))

    def content(name: str) -> bytes:
        if archive.getinfo(name).file_size > (MOST_META if name == META else MOST_BYTES):
            raise _damaged(path, f"{name} of {archive.getinfo(name).file_size:,} bytes")
        return archive.read(name)

    return content


def _picture(data: bytes) -> UInt8[np.ndarray, "H W 4"]:
    from PIL import Image  # noqa: PLC0415  (slow to import)

    try:
        with Image.open(io.BytesIO(data)) as picture:
            return np.asarray(picture.convert("RGBA"))
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(error) from None


def _damaged(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(f"{path} to be a whole SOG", found=found[:200], fix=FIX)
