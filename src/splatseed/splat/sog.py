"""Read and write PlayCanvas's SOG: a .zip of lossless WebP images and ``meta.json``.

Images have one pixel per Gaussian. A *codebook* maps bytes to 256 numbers, a *palette* maps labels
to vectors of harmonics. Equal Gaussians give equal bytes. Version 2 is written; version 1, without
a number, is read: in place of codebooks its bytes are steps between bounds, and opacities are
logits. Source: PlayCanvas's specification, and splat-transform for version 1.
"""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from jaxtyping import Float32, Float64, Int64, UInt8
from PIL import Image

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import read_bytes, translate_errors
from splatseed.progress import Note, Progress, silent, silent_note
from splatseed.splat.cleaning import MAX_LOG_SCALE
from splatseed.splat.gaussians import SH_COUNTS, Gaussians
from splatseed.splat.packing import (
    Fit,
    best_fit,
    clipped_findings,
    coarse_findings,
    from_smallest_three,
    left_out_finding,
    morton_order,
    opacity_bytes,
    opacity_logits,
    rounded_bytes,
    shells_of,
    smallest_three,
)

CONVERTER = "npx @playcanvas/splat-transform"
"""The converter by the authors of SOG and compressed PLY."""

_VERSION = 2
META = "meta.json"
"""The description of a model, in an archive or a folder."""
_ANTIALIASED = "antialiased"
"""Value of ``model`` in meta.json for antialiased rendering."""
_PER_ROW = 64  # palette entries per row of the centroid image
_MAX_LEVELS = 16  # the palette grows with the number of Gaussians, to 2^16 entries
_MAX_BYTES, _MAX_META = 1 << 31, 1 << 24
"""Size limits, in bytes, of an archive's image and meta.json; larger ones are refused unread."""
_QUAT_ALPHA = 252
"""Alpha of a rotation whose largest component is the first."""
_CODES = 256
_LLOYD_STEPS, _POWER_STEPS = 20, 3
"""Iterations of Lloyd's algorithm for codebooks, and of the power method for a group's principal
direction, of which a rough one suffices."""
_STAMP = (1980, 1, 1, 0, 0, 0)
"""Fixed timestamp in the zip, so that equal Gaussians give equal bytes."""


def encode(
    gaussians: Gaussians, note: Note = silent_note, progress: Progress = silent
) -> list[bytes]:
    """Encode Gaussians in Z-curve order."""
    gaussians = _within_steps(gaussians, note)
    for finding in clipped_findings(".sog", gaussians, sizes=(-MAX_LOG_SCALE, MAX_LOG_SCALE)):
        note(finding)
    order = morton_order(gaussians.means)
    curved = _curved(gaussians.means[order])
    low, high = curved.min(axis=0), curved.max(axis=0)
    positions = np.rint((curved - low) / np.where(high > low, high - low, 1) * 65535)
    positions = positions.astype(np.int64)
    largest, three = smallest_three(gaussians.quats[order])
    # The three smaller components in RGB, 252 + the index of the largest in A.
    smaller = rounded_bytes(three * np.sqrt(0.5) * 255 + 127.5)
    quats = np.column_stack([smaller, _QUAT_ALPHA + largest])
    logs = np.clip(gaussians.scales, -MAX_LOG_SCALE, MAX_LOG_SCALE)
    scales, sh0 = codebook(logs), codebook(gaussians.sh0)
    colors = codes(gaussians.sh0[order, 0], sh0)
    opacity = opacity_bytes(gaussians.opacities[order])
    images = {
        "means_l.webp": _grid(positions & 255),  # 16 bits: low bytes, then high ones
        "means_u.webp": _grid(positions >> 8),
        "quats.webp": _grid(quats),
        "scales.webp": _grid(codes(logs[order], scales)),
        "sh0.webp": _grid(np.column_stack([colors, opacity])),
    }
    files = ["means_l.webp", "means_u.webp"]
    meta: dict[str, Any] = {
        "version": _VERSION,
        "asset": {"generator": "splatseed"},
        "count": len(order),
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": files},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": sh0.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.antialiased:
        meta["model"] = _ANTIALIASED
    count, rest, _ = gaussians.shN.shape
    if rest and count > 1:
        levels = min(int(np.log2(count)), _MAX_LEVELS)
        entries, labels = palette(gaussians.shN[order].reshape(count, -1), levels, progress)
        book = codebook(entries)
        # Entries are bytes of a third codebook, 64 entries per row.
        table = np.full((-(-len(entries) // _PER_ROW) * _PER_ROW, rest, 4), 255, np.uint8)
        table[: len(entries), :, :3] = codes(entries, book).reshape(-1, rest, 3)
        images["shN_centroids.webp"] = table.reshape(-1, _PER_ROW * rest, 4)
        blank = np.zeros(count, np.int64)
        images["shN_labels.webp"] = _grid(np.column_stack([labels & 255, labels >> 8, blank]))
        meta["shN"] = {
            "count": len(entries),
            "bands": SH_COUNTS.index(rest),
            "codebook": book.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(META, _STAMP), json.dumps(meta))
        for name, pixels in images.items():
            webp = io.BytesIO()
            # `exact` keeps colours where alpha is 0, as opacities and quaternions require.
            Image.fromarray(pixels).save(webp, "WEBP", lossless=True, exact=True, quality=75)
            archive.writestr(zipfile.ZipInfo(name, _STAMP), webp.getvalue())
    return [file.getvalue()]


def _curved(means: Float32[np.ndarray, "N 3"]) -> Float64[np.ndarray, "N 3"]:
    """Return sign(p) log(1 + |p|), which gives finer steps near the origin."""
    xyz = means.astype(np.float64)
    return np.asarray(np.sign(xyz) * np.log1p(np.abs(xyz)))


def _within_steps(gaussians: Gaussians, note: Note) -> Gaussians:
    """Drop distant Gaussians that would make the steps of all positions coarse."""
    shells, curved = shells_of(gaussians.means), _curved(gaussians.means)
    fits = []
    for last in np.unique(shells)[::-1]:
        kept = shells <= last
        step = np.ptp(curved[kept], axis=0) / 65535
        fits.append(Fit(kept, (step * np.exp(np.abs(curved))).max(axis=1)))
    chosen, _, coarse = best_fit(gaussians, fits)
    kept = fits[chosen].kept
    if not kept.all():
        nearest = np.abs(gaussians.means[~kept]).max(axis=1).min()
        note(left_out_finding(".sog", kept, f"{nearest:,.4g} units or more from the origin"))
    for finding in coarse_findings(".sog", coarse, kept):
        note(finding)
    return gaussians if kept.all() else gaussians.select(kept)


def decode(path: Path, note: Note = silent_note) -> Gaussians:
    """Decode a .sog file, or the unpacked folder of a ``meta.json``."""
    with translate_errors(path, "a complete SOG"):
        parts = _Parts.of(path)
        low, high = (parts.pixels("means", i)[:, :3].astype(np.uint16) for i in (0, 1))
        lower, upper = (np.array(parts.meta["means"][end], np.float64) for end in ("mins", "maxs"))
        curved = lower + (low | high << 8) / 65535 * (upper - lower)
        quats, sh0 = parts.pixels("quats"), parts.pixels("sh0")
        largest = np.clip(quats[:, 3].astype(np.int64) - _QUAT_ALPHA, 0, 3)
        three = (quats[:, :3] / 255 - 0.5) * np.sqrt(2)
        if parts.first:
            colors, opacities = np.split(parts.numbers("sh0", sh0), [3], axis=1)
        else:
            colors, opacities = parts.numbers("sh0", sh0[:, :3]), opacity_logits(sh0[:, 3])
        model = parts.meta.get("model", "default")
        if model not in {"default", _ANTIALIASED}:
            text = f"{path} is a model of kind {model}, read as Gaussians: renders may differ."
            note(Finding("other-renderer", text, subjects=(str(path),)))
        return Gaussians(
            means=np.asarray(np.sign(curved) * np.expm1(np.abs(curved)), np.float32),
            scales=parts.numbers("scales", parts.pixels("scales")[:, :3]),
            quats=from_smallest_three(largest, three.astype(np.float32)),
            opacities=opacities.reshape(parts.num),
            sh0=colors[:, None],
            shN=parts.harmonics(),
            antialiased=model == _ANTIALIASED,
        )


class _Parts(NamedTuple):
    """The parts of a file, which its description names."""

    content: Callable[[str], bytes]
    meta: Mapping[str, Any]
    num: int  # Gaussians
    first: bool  # version 1: bytes are steps between bounds, not indices of codebooks

    @classmethod
    def of(cls, path: Path) -> Self:
        content = _part_reader(path)
        meta = json.loads(content(META))
        if "means" not in meta:  # of every version; a run's metrics.json has none
            raise ValueError("JSON without Gaussians")
        version = meta.get("version", 1)
        if version not in {1, _VERSION}:
            raise SceneFormatError(
                f"{path} to be a SOG of version 1 or {_VERSION}",
                found=f"version {version}",
                fix="Export a .ply with the program that wrote it.",
            )
        count = int(meta["means"]["shape"][0] if version == 1 else meta["count"])
        if count < 1:
            raise ValueError(f"{count} Gaussians")
        return cls(content, meta, count, version == 1)

    def image(self, part: str, file_idx: int = 0) -> UInt8[np.ndarray, "H W 4"]:
        with Image.open(io.BytesIO(self.content(self.meta[part]["files"][file_idx]))) as picture:
            return np.asarray(picture.convert("RGBA"))

    def pixels(
        self, part: str, file_idx: int = 0, num: int | None = None
    ) -> UInt8[np.ndarray, "P 4"]:
        rows, num = self.image(part, file_idx).reshape(-1, 4), self.num if num is None else num
        if len(rows) < num:
            raise ValueError(f"{len(rows):,} pixels in an image of {part}, of {num:,}")
        return rows[:num]

    def numbers(self, part: str, codes: UInt8[np.ndarray, "P C"]) -> Float32[np.ndarray, "P C"]:
        if not self.first:
            return np.asarray(np.array(self.meta[part]["codebook"], np.float32)[codes])
        low, high = (np.array(self.meta[part][end], np.float64) for end in ("mins", "maxs"))
        return np.asarray(low + codes / 255 * (high - low), np.float32)

    def harmonics(self) -> Float32[np.ndarray, "N K 3"]:
        if "shN" not in self.meta:
            return np.zeros((self.num, 0, 3), np.float32)
        labels = self.pixels("shN", 1)[:, :2].astype(np.int64) @ np.array([1, 256])
        if self.first:
            rest, entries = self.image("shN").shape[1] // _PER_ROW, int(labels.max()) + 1
        else:
            rest = SH_COUNTS[int(self.meta["shN"]["bands"])]
            entries = int(self.meta["shN"]["count"])
        if rest not in SH_COUNTS:
            raise ValueError(f"harmonics of {rest} coefficients")
        table = self.numbers("shN", self.pixels("shN", 0, entries * rest)[:, :3])
        return np.asarray(table.reshape(entries, rest, 3)[labels])


def _grid(values: np.ndarray) -> UInt8[np.ndarray, "H W 4"]:
    """Arrange rows of 3 or 4 bytes as pixels of a near-square image; sides are multiples of 4."""
    width = 4 * int(np.ceil(np.sqrt(len(values)) / 4))
    height = 4 * int(np.ceil(len(values) / width / 4))
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _part_reader(path: Path) -> Callable[[str], bytes]:
    if path.name.lower().endswith(".json"):
        return lambda name: read_bytes(path if name == META else path.parent / Path(name).name)
    archive = zipfile.ZipFile(io.BytesIO(read_bytes(path)))
    folder = next((n for n in archive.namelist() if n.endswith(f"/{META}")), "").removesuffix(META)

    def content(name: str) -> bytes:
        name = folder + name
        if archive.getinfo(name).file_size > (_MAX_META if name.endswith(META) else _MAX_BYTES):
            raise ValueError(f"{name} of {archive.getinfo(name).file_size:,} bytes")
        return archive.read(name)

    return content


def codebook(values: Float32[np.ndarray, "..."]) -> Float64[np.ndarray, " 256"]:
    """Fit 256 ascending numbers that quantise values with small square error (1D Lloyd)."""
    ordered = np.sort(values.reshape(-1).astype(np.float64))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    # Half of the codes start evenly spaced, for the tails, and half at quantiles.
    ranks = np.quantile(ordered, (np.arange(_CODES // 2) + 0.5) / (_CODES // 2))
    centers = np.sort(np.concatenate([ranks, np.linspace(ordered[0], ordered[-1], _CODES // 2)]))
    for _ in range(_LLOYD_STEPS):
        edges = np.searchsorted(ordered, (centers[1:] + centers[:-1]) / 2)
        bounds = np.concatenate([[0], edges, [len(ordered)]])
        counts = np.diff(bounds)
        means = np.diff(sums[bounds]) / np.maximum(counts, 1)
        centers = np.sort(np.where(counts > 0, means, centers))
    return centers


def codes(
    values: Float32[np.ndarray, "..."], centers: Float64[np.ndarray, " 256"]
) -> UInt8[np.ndarray, "..."]:
    """Return the index of the nearest codebook number for each value."""
    return np.searchsorted((centers[1:] + centers[:-1]) / 2, values).astype(np.uint8)


def palette(
    vectors: Float32[np.ndarray, "N D"], levels: int, progress: Progress = silent
) -> tuple[Float32[np.ndarray, "K D"], Int64[np.ndarray, " N"]]:
    """Cluster N >= 2^levels vectors by recursive bisection; return the means and labels.

    Groups are halved along their principal direction.
    """
    count = 2**levels
    size = -(-len(vectors) // count)
    # Groups have one size, padded with the first vectors: a level is a few array operations.
    order = np.resize(np.arange(len(vectors)), size * count)[None]
    for level in range(levels):
        progress("encode", level / levels)
        along = _along_principal_axis(vectors, order)
        order = np.take_along_axis(order, np.argsort(along, axis=1, kind="stable"), axis=1)
        order = order.reshape(2 * len(order), -1)
    labels = np.empty(len(vectors), np.int64)
    labels[order] = np.arange(count)[:, None]
    sums = np.zeros((count, vectors.shape[1]))
    np.add.at(sums, labels, vectors)
    members = np.bincount(labels, minlength=count)
    return (sums / np.maximum(members, 1)[:, None]).astype(np.float32), labels


def _along_principal_axis(
    vectors: Float32[np.ndarray, "N D"], order: Int64[np.ndarray, "G M"]
) -> Float32[np.ndarray, "G M"]:
    """Project each vector on the principal direction of its group."""
    along = np.empty(order.shape, np.float32)
    step = max(1, 2**20 // order.shape[1])
    for first in range(0, len(order), step):
        part = vectors[order[first : first + step]]
        part = part - part.mean(axis=1, keepdims=True)
        axis = part[np.arange(len(part)), np.argmax((part**2).sum(axis=2), axis=1)]
        for _ in range(_POWER_STEPS):
            axis = np.einsum("gm,gmd->gd", np.einsum("gmd,gd->gm", part, axis), part)
            axis /= np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-20)
        along[first : first + step] = np.einsum("gmd,gd->gm", part, axis)
    return along
