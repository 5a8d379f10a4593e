"""Fingerprints of what runs depend on: a scene's content, photographs, depth maps and scan.

Promise: a fingerprint depends on content alone, not on where files are, when they were written, or
the order in which a system lists them; photographs and scans count byte for byte, depth maps as
they are read.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TypeVar

import numpy as np

from splatseed.depthmap import DepthMaps
from splatseed.io.files import open_file
from splatseed.io.photograph import photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

Item = TypeVar("Item")

SIZE = 16
"""Bytes of a fingerprint."""
PIECE = 1 << 22
"""Bytes of a scan that are read at a time."""


def scene_digest(scene: Scene, folder: Path, progress: Progress = silent) -> str:
    """Fingerprint of a scene's points, tracks, cameras and photographs: 32 hexadecimal digits.

    Args:
        scene: The scene.
        folder: Where its photographs lie.
        progress: Told how far reading is.

    Raises:
        SceneNotFoundError: A photograph is missing.
        SceneFormatError: One cannot be read.
    """
    digest = hashlib.blake2b(digest_size=SIZE)
    _update(digest, (scene.points.xyz, scene.points.rgb))
    if scene.tracks is not None:
        tracks = scene.tracks
        _update(digest, (tracks.xyz, tracks.errors, tracks.offsets, tracks.image_ids))
    images = sorted(scene.images, key=lambda image: image.name)
    for image in images:
        _update_camera(digest, image)
    if scene.listed is not None:
        digest.update(
            repr((sorted(scene.listed.train), sorted(scene.listed.test))).encode(
                "utf-8", "backslashreplace"
            )
        )
    photographs = [folder / image.name for image in images]
    for each in _in_threads(_of_file, photographs, "fingerprint photographs", progress):
        digest.update(each)
    return digest.hexdigest()


def depth_digest(maps: DepthMaps, progress: Progress = silent) -> str:
    """Fingerprint of a scene's depth maps as they are read: 32 hexadecimal digits.

    Args:
        maps: The maps.
        progress: Told how far reading is.

    Raises:
        SceneNotFoundError: A file is gone.
        SceneFormatError: One is not what its format promises.
    """

    def of_map(name: str) -> bytes:
        depth_map = maps.read(name)
        digest = hashlib.blake2b(f"{name}\n{depth_map.kind}\n".encode(), digest_size=SIZE)
        _update(digest, (depth_map.values,))
        return digest.digest()

    digest = hashlib.blake2b(digest_size=SIZE)
    for each in _in_threads(of_map, sorted(maps), "fingerprint depth", progress):
        digest.update(each)
    return digest.hexdigest()


def cloud_digest(path: Path, progress: Progress = silent) -> str:
    """Fingerprint of a scan's file, byte for byte: 32 hexadecimal digits.

    Args:
        path: The file.
        progress: Told how far reading is.

    Raises:
        SceneNotFoundError: There is no such file.
    """
    digest, done = hashlib.blake2b(digest_size=SIZE), 0
    with open_file(path) as file:
        size = max(os.fstat(file.fileno()).st_size, 1)
        while piece := file.read(PIECE):
            digest.update(piece)
            done += len(piece)
            progress("fingerprint the scan", done / size)
    return digest.hexdigest()


def _update_camera(digest: hashlib.blake2b, image: Image) -> None:
    lens = image.intrinsics
    words = (image.name, lens.model, lens.width, lens.height)
    digest.update(repr(words).encode("utf-8", "backslashreplace"))
    _update(digest, (np.array(lens.params, np.float64), image.quat, image.translation))
    if image.observations is not None:
        _update(digest, (image.observations.xy, image.observations.point_ids))


def _update(digest: hashlib.blake2b, arrays: Iterable[np.ndarray]) -> None:
    """Hashed with shapes, so that two arrays are never taken for one."""
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.tobytes())


def _of_file(path: Path) -> bytes:
    return hashlib.blake2b(photograph_bytes(path), digest_size=SIZE).digest()


def _in_threads(
    work: Callable[[Item], bytes], items: Sequence[Item], stage: str, progress: Progress
) -> Iterable[bytes]:
    """The work's results in the order of the items."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, each in enumerate(pool.map(work, items), start=1):
            yield each
            progress(stage, done / len(items))
