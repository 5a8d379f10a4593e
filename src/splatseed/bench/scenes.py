"""Scenes of a benchmark: opening one, checking it before it is run, and its fingerprints.

Promise: a benchmark always opens a scene in the same way; whatever would make every run on a scene
fail (no photographs, lenses with distortion, unreadable depth or scan) is detected here, before any
run. A fingerprint depends on content alone, not on where files are, when they were written, or the
order in which a system lists them; photographs and scans count byte for byte, depth maps as read.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from splatseed.depthmap import DepthMaps
from splatseed.errors import SceneNotFoundError
from splatseed.io import find_depths, load_originals
from splatseed.io.clouds import open_cloud
from splatseed.io.files import open_file
from splatseed.io.load import search_depths
from splatseed.io.photograph import open_photograph, photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.splat.gaussians import stray_note, stray_views
from splatseed.views.view import check_lens, poses_of

Item = TypeVar("Item")
_SIZE = 16
"""Bytes of a fingerprint."""


@dataclass(frozen=True)
class SceneFacts:
    """Facts about a scene.

    Args:
        name: The scene's name in tables.
        path: Its folder, absolute.
        digest: Fingerprint of its points, cameras and photographs.
        num_points: Distinct finite points, which plain ``SFM`` trains from.
        num_images: Number of photographs.
        pixels: Pixels of the first photograph, as in its file.
        long_side: Pixels of its longer side.
        images: The folder of photographs within the scene's; empty for the default one.
        depth_path: Where its depth maps lie, absolute; empty without.
        depth_digest: Their fingerprint; empty without.
        cloud_path: The file of its scan, absolute; empty without.
        cloud_digest: Its fingerprint; empty without.
        warnings: What is odd about it, one sentence each.
    """

    name: str
    path: str
    digest: str
    num_points: int
    num_images: int
    pixels: int
    long_side: int
    images: str = ""
    depth_path: str = ""
    depth_digest: str = ""
    cloud_path: str = ""
    cloud_digest: str = ""
    warnings: tuple[str, ...] = ()

    def pixels_at(self, factor: int) -> int:
        """Pixels of the first photograph, downsampled by a whole factor."""
        short_side = self.pixels // self.long_side
        return (self.long_side // factor) * (short_side // factor)


def open_scene(path: Path, *, images: str = "", depth: Path | None = None) -> Scene:
    """A scene with its original points, as a run begins with it.

    Args:
        path: Its folder.
        images: The folder of photographs within it; the default one when left out.
        depth: The folder of its depth maps, if needed.

    Raises:
        SceneNotFoundError: There is no scene, or no such folder.
        SceneFormatError: A file is not what its format promises.
    """
    scene = load_originals(path)
    if images:
        if scene.source is None or not (scene.source.root / images).is_dir():
            raise SceneNotFoundError(
                f"the folder {images} in {path}",
                found="no such folder",
                fix="Name another folder of photographs, or none.",
            )
        source = dataclasses.replace(scene.source, image_dir=scene.source.root / images)
        scene = scene.replace(source=source)
    return scene if depth is None else scene.replace(depths=find_depths(scene, depth))


def survey(
    path: Path,
    name: str,
    *,
    images: str = "",
    depth: Path | None = None,
    with_depth: bool = False,
    cloud: Path | None = None,
    progress: Progress = silent,
) -> SceneFacts:
    """Check a scene and all files that a run on it reads.

    Args:
        path: Where it lies.
        name: What to call it.
        images: The folder of photographs within it; the one that is found when left out.
        depth: The folder of its depth maps; if left out, they are looked for in the scene's.
        with_depth: Whether depth maps are needed at all.
        cloud: The file of its scan, if needed.
        progress: Told how far reading is.

    Raises:
        SceneNotFoundError: There is no scene, or a file is missing.
        SceneFormatError: A file is not what its format promises, or cameras have distortion.
    """
    scene = open_scene(path, images=images)
    folder = scene.source.image_dir if scene.source else None
    if folder is None or not scene.images:
        raise SceneNotFoundError(
            f"photographs in {path}",
            found="none",
            fix="Name a scene with images: a point cloud alone cannot be trained.",
        )
    for image in scene.images:
        check_lens(image, path)
    first = folder / scene.images[0].name
    size = open_photograph(first, photograph_bytes(first)).size
    maps = _depth_folder(scene, depth) if with_depth else None
    if cloud is not None:
        open_cloud(cloud)  # a header that makes no sense is told now
    return SceneFacts(
        name=name,
        path=str(path.resolve()),
        digest=scene_digest(scene, folder, progress),
        num_points=len(scene.points),
        num_images=len(scene.images),
        pixels=size[0] * size[1],
        long_side=max(size),
        images=images,
        depth_path="" if maps is None else str(maps.resolve()),
        depth_digest="" if maps is None else depth_digest(find_depths(scene, maps), progress),
        cloud_path="" if cloud is None else str(cloud.resolve()),
        cloud_digest="" if cloud is None else cloud_digest(cloud, progress),
        warnings=(
            *scene.warnings,
            *([scene.listed.sentence] if scene.listed else []),
            *map(stray_note, stray_views(poses_of(scene.images))),
        ),
    )


def _depth_folder(scene: Scene, depth: Path | None) -> Path | None:
    """Where the depth maps lie: what is named, else the scene's own folder if it has some."""
    if depth is not None:
        find_depths(scene, depth)
        return depth
    root = scene.source.root if scene.source else None
    return root if root is not None and search_depths(scene, root) is not None else None


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
    digest = hashlib.blake2b(digest_size=_SIZE)
    _add(digest, scene.points.xyz, scene.points.rgb)
    if scene.tracks is not None:
        tracks = scene.tracks
        _add(digest, tracks.xyz, tracks.errors, tracks.offsets, tracks.image_ids)
    images = sorted(scene.images, key=lambda image: image.name)
    for image in images:
        lens = image.intrinsics
        _add_words(digest, (image.name, lens.model, lens.width, lens.height))
        _add(digest, np.array(lens.params, np.float64), image.quat, image.translation)
        if image.observations is not None:
            _add(digest, image.observations.xy, image.observations.point_ids)
    if scene.listed is not None:
        _add_words(digest, (sorted(scene.listed.train), sorted(scene.listed.test)))
    photographs = [folder / image.name for image in images]

    def of_file(path: Path) -> bytes:
        return hashlib.blake2b(photograph_bytes(path), digest_size=_SIZE).digest()

    for each in _in_threads(of_file, photographs, "fingerprint photographs", progress):
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
        digest = hashlib.blake2b(f"{name}\n{depth_map.kind}\n".encode(), digest_size=_SIZE)
        _add(digest, depth_map.values)
        return digest.digest()

    digest = hashlib.blake2b(digest_size=_SIZE)
    for each in _in_threads(of_map, sorted(maps), "fingerprint depth", progress):
        digest.update(each)
    return digest.hexdigest()


def cloud_digest(path: Path, progress: Progress = silent) -> str:
    """Fingerprint of a scan's file, byte for byte: 32 hexadecimal digits.

    Args:
        path: The file.
        progress: Told that it is read.

    Raises:
        SceneNotFoundError: There is no such file.
    """
    progress("fingerprint the scan", 0.0)
    digest = hashlib.blake2b(digest_size=_SIZE)
    with open_file(path) as file:
        while piece := file.read(1 << 22):
            digest.update(piece)
    return digest.hexdigest()


def _add(digest: hashlib.blake2b, *arrays: np.ndarray) -> None:
    """Arrays, hashed with their shapes so that two are never taken for one."""
    for array in arrays:
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(array.tobytes())


def _add_words(digest: hashlib.blake2b, words: tuple[object, ...]) -> None:
    digest.update(repr(words).encode("utf-8", "backslashreplace"))


def _in_threads(
    work: Callable[[Item], bytes], items: Sequence[Item], stage: str, progress: Progress
) -> Iterable[bytes]:
    """The work's results in the order of the items."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for done, each in enumerate(pool.map(work, items), start=1):
            yield each
            progress(stage, done / len(items))
