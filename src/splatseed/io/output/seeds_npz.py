"""``seeds.npz``: attributes of an output's points that point files have no field for.

Notation: N points, in the order of the point files; ``source`` uint8 [N], ``normals`` float16 [N,
3], ``sizes`` float32 [N] and ``confidence`` float16 [N], in the scene's world, each present if
known for any point; ``digest`` is the fingerprint of the positions they belong to. Promise: equal
clouds give equal bytes; a file that is damaged or belongs to other points is reported and not
used; no pickle is loaded, and nothing is allocated on the word of a header.
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float32, UInt8
from numpy.lib import format as npy_format

from splatseed.errors import PointCloudError
from splatseed.io.files import ARCHIVE_FAILURES
from splatseed.pointcloud import ATTRIBUTES, GENERATED, ORIGINAL, PointCloud

SEEDS = "seeds.npz"

_STORED: dict[str, tuple[tuple[int, ...], np.dtype[Any]]] = {
    "source": ((), np.dtype("u1")),
    # Half precision rotates a normal by 0.03 degrees at most; sizes have no bounded range.
    **{
        name: (shape, np.dtype("<f4" if name == "sizes" else "<f2"))
        for name, shape in ATTRIBUTES.items()
    },
}
"""Shape of one point's value, and type in the file."""
_DIGEST_BYTES = 16
_RUN = 1 << 20
"""Bytes that are compressed at once."""
_MOST_HEADER = 4096


class KnownOfSeeds(NamedTuple):
    """What a file says about a cloud's points.

    Args:
        points: The cloud with the attributes in the file, and its ``source`` if it has one.
        has_source: Whether it has one.
        warning: Why the file was ignored; empty if it was not.
    """

    points: PointCloud
    has_source: bool = False
    warning: str = ""


def write_seeds(folder: Path, points: PointCloud) -> None:
    """Write the file into an output, if there is anything to write.

    Args:
        folder: The output.
        points: The cloud, in the order of the point files.

    Raises:
        OSError: It cannot be written.
    """
    arrays = _known(points)
    if not arrays:
        return
    digest = np.frombuffer(_digest(points.xyz), np.uint8)
    np.savez_compressed(folder / SEEDS, digest=digest, **arrays)  # type: ignore[arg-type]  # savez takes arrays by name


class PositionDigest:
    """The fingerprint of positions that come a piece at a time."""

    def __init__(self) -> None:
        self._hash = hashlib.blake2b(digest_size=_DIGEST_BYTES)

    def add(self, xyz: Float32[np.ndarray, "n 3"]) -> None:
        """Take the next positions."""
        self._hash.update(_plain_rows(xyz))

    def bytes(self) -> bytes:
        """The fingerprint of all of them."""
        return self._hash.digest()


def write_origins(folder: Path, digest: bytes, runs: Sequence[tuple[int, int]]) -> None:
    """Write the file for points of which only the origin is known, too many for memory.

    Args:
        folder: The output.
        digest: The fingerprint of all positions.
        runs: Codes and how many points in a row have each.

    Raises:
        OSError: It cannot be written.
    """
    total = sum(count for _, count in runs)
    header = {"descr": "|u1", "fortran_order": False}
    if all(code in {ORIGINAL, GENERATED} for code, count in runs if count):
        return  # as in write_seeds: the other files say as much
    with zipfile.ZipFile(folder / SEEDS, "w", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("digest.npy", "w", force_zip64=True) as member:
            npy_format.write_array(member, np.frombuffer(digest, np.uint8))
        with archive.open("source.npy", "w", force_zip64=True) as member:
            npy_format.write_array_header_1_0(member, {**header, "shape": (total,)})
            for code, count in runs:
                for first in range(0, count, _RUN):
                    member.write(bytes([code]) * min(_RUN, count - first))


def read_seeds(folder: Path, points: PointCloud) -> KnownOfSeeds:
    """What the file in a folder says about the points read from there; unchanged without a file.

    Args:
        folder: The scene's root.
        points: The cloud, in the order of the point files.
    """
    path = folder / SEEDS
    try:
        if not path.is_file():
            return KnownOfSeeds(points)
        with zipfile.ZipFile(path) as archive:
            digest = _member(archive, "digest", (_DIGEST_BYTES,), np.dtype("u1"))
            if digest.tobytes() != _digest(points.xyz):
                told = f"{SEEDS} was ignored: it belongs to other points than the scene's."
                return KnownOfSeeds(points, warning=told)
            arrays = _members(archive, len(points))
        return KnownOfSeeds(points.replace(**arrays), "source" in arrays)
    except (*ARCHIVE_FAILURES, PointCloudError) as error:
        told = f"{SEEDS} was ignored: it is damaged, or not splatseed's"
        return KnownOfSeeds(points, warning=f"{told} ({type(error).__name__}).")


def _known(points: PointCloud) -> dict[str, np.ndarray]:
    """Arrays with more information than the other files hold, as they are stored."""
    arrays: dict[str, np.ndarray] = {}
    if not np.isin(points.source, (ORIGINAL, GENERATED)).all():
        arrays["source"] = points.source
    arrays |= {n: values for n, values in points.attributes.items() if not np.isnan(values).all()}
    return {name: values.astype(_STORED[name][1]) for name, values in arrays.items()}


def _digest(xyz: Float32[np.ndarray, "N 3"]) -> bytes:
    """A fingerprint of positions, equal for both zeros and for any byte order."""
    return hashlib.blake2b(_plain_rows(xyz), digest_size=_DIGEST_BYTES).digest()


def _plain_rows(xyz: Float32[np.ndarray, "N 3"]) -> bytes:
    rows = np.ascontiguousarray(xyz + np.float32(0.0), "<f4")  # adding turns -0.0 into 0.0
    return rows.tobytes()


def _members(archive: zipfile.ZipFile, num_points: int) -> dict[str, np.ndarray]:
    """Our arrays in an archive, as a cloud has them."""
    there = {name.removesuffix(".npy") for name in archive.namelist()}
    arrays = {
        name: _member(archive, name, (num_points, *shape), dtype)
        for name, (shape, dtype) in _STORED.items()
        if name in there
    }
    return {n: a if n == "source" else a.astype(np.float32) for n, a in arrays.items()}


def _member(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], dtype: np.dtype[Any]
) -> np.ndarray | UInt8[np.ndarray, " N"]:
    """An array that must have just this shape and type.

    Raises:
        ValueError: It has another, or fewer bytes than that.
        KeyError: There is none.
    """
    info = archive.getinfo(f"{name}.npy")
    count = int(np.prod(shape, dtype=np.int64))
    if info.file_size > count * dtype.itemsize + _MOST_HEADER:
        raise ValueError(name)
    stream = io.BytesIO(archive.read(info))
    version = npy_format.read_magic(stream)
    if version != (1, 0) or npy_format.read_array_header_1_0(stream) != (shape, False, dtype):
        raise ValueError(name)
    return np.frombuffer(stream.getvalue(), dtype, count, stream.tell()).reshape(shape)
