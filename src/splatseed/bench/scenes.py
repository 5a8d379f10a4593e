"""Scenes of a benchmark: open, check and fingerprint them.

``survey`` detects before any run what would make every run on a scene fail. A fingerprint depends
on content, not on paths or on the order of files: the bytes of photographs and scans, the values of
depth maps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatseed.depthmap import DepthMaps
from splatseed.errors import SceneNotFoundError
from splatseed.io import load_originals
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap_model import scene_root
from splatseed.io.downsampling import reduced_size
from splatseed.io.exclusion import exclude
from splatseed.io.files import open_file, read_bytes
from splatseed.io.load import search_depths, with_depths_in
from splatseed.io.photograph import photograph_bytes
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.photos.camera_check import stray_cameras
from splatseed.photos.loading import refuse_distortion
from splatseed.progress import Note, Progress, in_threads, silent, silent_note
from splatseed.runtime.fingerprint import fingerprint, fingerprint_all
from splatseed.scene import Scene

DEMO = "demo:"
"""The path of the synthetic room, which is written to the benchmark's folder on demand."""


@dataclass(frozen=True)
class PlannedScene:
    """A scene of a plan."""

    path: str
    """The scene's folder; ``DEMO`` for the synthetic room."""
    name: str = ""
    """The name in tables; if empty, that of the folder."""
    images: str = ""
    """The folder of photographs in the scene, such as ``images_4``; detected if empty."""
    depth: str = ""
    """The folder of depth maps; searched in the scene if empty."""
    cloud: str = ""
    """The file of a scan in the scene's frame."""
    exclude: tuple[str, ...] = ()
    """Photographs to leave out: names or patterns."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "exclude", tuple(self.exclude))  # JSON has lists

    @property
    def is_demo(self) -> bool:
        """Whether the scene is the synthetic room."""
        return self.path == DEMO

    @property
    def label(self) -> str:
        """The name in tables."""
        return self.name or ("demo" if self.is_demo else self.root.name)

    @property
    def root(self) -> Path:
        """The scene's folder, even if ``path`` is the folder of the COLMAP model."""
        return scene_root(Path(self.path).resolve())


@dataclass(frozen=True)
class SceneFacts(PlannedScene):
    """A surveyed scene: its name, absolute paths, sizes and fingerprints.

    ``num_points`` counts the distinct finite points. ``pixels`` and ``long_side`` are those of the
    first photograph. A digest is empty if the scene has no such files.
    """

    digest: str = ""
    num_points: int = 0
    num_images: int = 0
    pixels: int = 1
    long_side: int = 1
    depth_digest: str = ""
    cloud_digest: str = ""

    def pixels_at(self, factor: float) -> int:
        """The pixels of the first photograph, downsampled by a factor."""
        return math.prod(reduced_size(self.long_side, self.pixels // self.long_side, factor))


_DEMO_FACTS = SceneFacts(
    DEMO, "demo", digest="not made yet", num_points=11_364, num_images=40, pixels=400 * 300,
    long_side=400, depth_digest="not made yet",
)  # fmt: skip
"""The synthetic room before it is written; ``num_points`` is approximate."""


def open_scene(scene: PlannedScene) -> Scene:
    """Open a scene with its original points, and with depth maps if their folder is given.

    Raises:
        SceneNotFoundError: There is no scene or folder, or half of the photographs are missing.
        SceneFormatError: A file is invalid.
    """
    opened = exclude(load_originals(Path(scene.path)), scene.exclude)
    if scene.images:
        folder = (opened.source.root or Path()) / scene.images
        if not folder.is_dir():
            expected = f"the folder {scene.images} of photographs in {scene.path}"
            raise SceneNotFoundError(expected, found="none", fix="Name another, or none.")
        opened = opened.replace(source=replace(opened.source, image_dir=folder))
    if opened.images and opened.source.image_dir is not None:
        opened = with_photographs(opened)
    return with_depths_in(opened, Path(scene.depth)) if scene.depth else opened


def survey(
    planned: PlannedScene,
    *,
    demo: Path | None = None,
    with_depth: bool = False,
    with_cloud: bool = False,
    columns: Sequence[str] = (),
    progress: Progress = silent,
    note: Note = silent_note,
) -> SceneFacts:
    """Check a scene and all files that runs on it read.

    Args:
        planned: The scene.
        demo: The folder of the synthetic room, which is written if missing; None to use its known
            facts.
        with_depth: Whether a method needs depth maps.
        with_cloud: Whether a method needs the scan.
        columns: Those of a scan that is a text file, as of ``open_cloud``.
        progress: Reports progress.
        note: Takes what was found out about the scene.

    Raises:
        SceneNotFoundError: There is no scene, or a file is missing.
        SceneFormatError: A file is invalid, or cameras have distortion.
    """
    if planned.is_demo:
        if demo is None:
            return replace(_DEMO_FACTS, name=planned.label)
        planned = replace(planned, path=str(demo), name=planned.label)
        if not demo.is_dir():
            from splatseed.synthetic import make_capture, write_capture  # noqa: PLC0415  (Numba)

            progress("make the demo scene", 0.0)
            write_capture(make_capture(), demo)
    path = Path(planned.path)
    scene = open_scene(replace(planned, depth=""))
    if scene.source.image_dir is None or not scene.images:
        fix = "Name a scene with images: a point cloud alone cannot be trained."
        raise SceneNotFoundError(f"photographs in {path}", found="none", fix=fix)
    for image in scene.images:
        refuse_distortion(image, path)
    size = check_sizes(scene.images)[scene.images[0].name]
    maps = scan = ""
    if with_cloud and planned.cloud:
        scan = str(Path(planned.cloud).resolve())
        open_cloud(Path(planned.cloud), columns)  # reports an invalid header now
    depth = Path(planned.depth or scene.source.root or path)
    if with_depth and (planned.depth or search_depths(scene, depth) is not None):
        maps, scene = str(depth.resolve()), with_depths_in(scene, depth)
    split = [scene.listed.finding(given=False)] if scene.listed else []
    for finding in (*scene.findings, *split, *stray_cameras(scene)):
        note(finding)
    return SceneFacts(
        str(path.resolve()), planned.label, planned.images, maps, scan, planned.exclude,
        num_points=len(scene.points), num_images=len(scene.images), pixels=size[0] * size[1],
        long_side=max(size), **fingerprints(scene, maps, scan, progress),
    )  # fmt: skip


def fingerprints(
    scene: Scene, depth: str, cloud: str, progress: Progress = silent
) -> dict[str, str]:
    """Compute the digests of ``SceneFacts``; empty if the path of depth maps or scan is."""
    maps = scene.depths if depth else None
    return {
        "digest": "" if scene.source.image_dir is None else scene_digest(scene, progress),
        "depth_digest": "" if maps is None else _depth_digest(maps, progress),
        "cloud_digest": _cloud_digest(Path(cloud), progress) if cloud else "",
    }


def scene_digest(scene: Scene, progress: Progress = silent) -> str:
    """Fingerprint points, tracks, cameras, photographs and masks."""
    parts: list[object] = [scene.points.xyz, scene.points.rgb]
    if scene.tracks is not None:
        tracks = scene.tracks
        parts += [tracks.xyz, tracks.errors, tracks.offsets, tracks.image_ids]
    images = sorted(scene.images, key=lambda image: image.name)
    for image in images:
        lens = image.intrinsics
        parts.append((image.name, lens.model, lens.width, lens.height))
        parts += [np.array(lens.params, np.float64), image.quat, image.translation]
        if image.observations is not None:
            parts += [image.observations.xy, image.observations.point_ids]
    if scene.absent:
        parts.append(sorted(scene.absent))
    if scene.listed is not None:
        parts.append((sorted(scene.listed.train), sorted(scene.listed.test)))

    def of_file(i: int) -> str:
        name = images[i].name
        content = photograph_bytes(images[i].path)
        if scene.masks is not None and name in scene.masks.files:
            content += read_bytes(scene.masks.files[name])
        return fingerprint(content)

    files = _of_files(of_file, len(images), "fingerprint photographs", progress)
    return fingerprint(*parts, files)


def _depth_digest(maps: DepthMaps, progress: Progress) -> str:
    names = sorted(maps)

    def of_map(i: int) -> str:
        depth_map = maps.read(names[i])
        return fingerprint(f"{names[i]}\n{depth_map.kind}\n".encode(), depth_map.values)

    return fingerprint(_of_files(of_map, len(names), "fingerprint depth", progress))


def _cloud_digest(path: Path, progress: Progress) -> str:
    progress("fingerprint the scan", 0.0)
    with open_file(path) as file:
        return fingerprint_all(iter(lambda: file.read(1 << 22), b""))


def _of_files(of_file: Callable[[int], str], count: int, stage: str, progress: Progress) -> bytes:
    """Fingerprint files in several threads; returns the bytes of all fingerprints in order."""
    digests = [""] * count

    def work(start: int, _stop: int) -> None:
        digests[start] = of_file(start)

    in_threads(work, count, 1, stage, progress)
    return bytes.fromhex("".join(digests))
