"""Scenes of a benchmark: opening one, checking it before it is run, and its fingerprints.

Whatever would make every run on a scene fail is detected here, before any run. A fingerprint
depends on content alone: not on where files are, or the order in which a system lists them;
photographs and scans count byte for byte, depth maps as read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatseed.depthmap import DepthMaps
from splatseed.errors import SceneNotFoundError
from splatseed.io import find_depths, load_originals
from splatseed.io.clouds import open_cloud
from splatseed.io.colmap_model import scene_root
from splatseed.io.files import open_file, read_bytes
from splatseed.io.load import search_depths
from splatseed.io.photograph import photograph_bytes
from splatseed.io.photograph_checks import check_sizes, with_photographs
from splatseed.photos.sight import stray_notes
from splatseed.photos.view import check_lens
from splatseed.progress import Progress, in_threads, silent
from splatseed.runtime.fingerprint import fingerprint, fingerprint_all
from splatseed.scene import Scene

DEMO = "demo:"
"""The path of the synthetic room, which is made in the benchmark's folder on demand."""


@dataclass(frozen=True)
class PlannedScene:
    """A scene of a plan."""

    path: str
    """Its folder; ``DEMO`` for the synthetic room."""
    name: str = ""
    """Its name in tables; the folder's name when left empty."""
    images: str = ""
    """The folder of photographs within it, such as ``images_4``; detected when left empty."""
    depth: str = ""
    """The folder of its depth maps; looked for in the scene when left out."""
    cloud: str = ""
    """The file of its scan, in the scene's frame."""

    @property
    def is_demo(self) -> bool:
        """Whether it is the synthetic room."""
        return self.path == DEMO

    @property
    def label(self) -> str:
        """Its name, or its folder's."""
        return self.name or ("demo" if self.is_demo else self.root.name)

    @property
    def root(self) -> Path:
        """Its folder, also where that of its model is named."""
        return scene_root(Path(self.path).resolve())


@dataclass(frozen=True)
class SceneFacts(PlannedScene):
    """A scene after ``survey``: with its name, absolute paths, and what they hold.

    ``num_points`` are distinct finite ones, which plain ``SFM`` trains from; ``pixels`` and
    ``long_side`` are the first photograph's; digests are fingerprints, empty without such files.
    """

    digest: str = ""
    num_points: int = 0
    num_images: int = 0
    pixels: int = 1
    long_side: int = 1
    depth_digest: str = ""
    cloud_digest: str = ""
    warnings: tuple[str, ...] = ()

    def pixels_at(self, factor: int) -> int:
        """Pixels of the first photograph, downsampled by a whole factor."""
        short_side = self.pixels // self.long_side
        return (self.long_side // factor) * (short_side // factor)


_DEMO_FACTS = SceneFacts(
    DEMO, "demo", digest="not made yet", num_points=11_364, num_images=40, pixels=400 * 300,
    long_side=400, depth_digest="not made yet",
)  # fmt: skip
"""Facts about the synthetic room before it is made; the number of points is approximate."""


def open_scene(scene: PlannedScene) -> Scene:
    """A scene with its original points, and with the depth maps that are named.

    Raises:
        SceneNotFoundError: There is no scene, no such folder, or less than half its photographs.
        SceneFormatError: A file is not what its format promises.
    """
    opened = load_originals(Path(scene.path))
    if scene.images:
        if opened.source is None or not (opened.source.root / scene.images).is_dir():
            expected = f"the folder {scene.images} of photographs in {scene.path}"
            raise SceneNotFoundError(expected, found="none", fix="Name another, or none.")
        source = replace(opened.source, image_dir=opened.source.root / scene.images)
        opened = opened.replace(source=source)
    if opened.images and opened.source is not None and opened.source.image_dir is not None:
        opened = with_photographs(opened)
    return opened.replace(depths=find_depths(opened, Path(scene.depth))) if scene.depth else opened


def survey(
    planned: PlannedScene,
    *,
    demo: Path | None = None,
    with_depth: bool = False,
    with_cloud: bool = False,
    progress: Progress = silent,
) -> SceneFacts:
    """Check a scene and all files that a run on it reads.

    ``demo`` is where the synthetic room is, or is to be made; None for its known facts. Depth maps
    are looked for if they are needed and none are named.

    Raises:
        SceneNotFoundError: There is no scene, or a file is missing.
        SceneFormatError: A file is not what its format promises, or cameras have distortion.
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
    folder = scene.source.image_dir if scene.source else None
    if scene.source is None or folder is None or not scene.images:
        fix = "Name a scene with images: a point cloud alone cannot be trained."
        raise SceneNotFoundError(f"photographs in {path}", found="none", fix=fix)
    for image in scene.images:
        check_lens(image, path)
    size = check_sizes(scene.images, folder)[scene.images[0].name]
    maps = scan = ""
    if with_cloud and planned.cloud:
        scan = str(Path(planned.cloud).resolve())
        open_cloud(Path(planned.cloud))  # a header that makes no sense is told now
    depth = Path(planned.depth) if planned.depth else scene.source.root
    if with_depth and (planned.depth or search_depths(scene, depth) is not None):
        maps, scene = str(depth.resolve()), scene.replace(depths=find_depths(scene, depth))
    told = [*scene.warnings, *([scene.listed.sentence] if scene.listed else [])]
    told += stray_notes(scene)
    return SceneFacts(
        str(path.resolve()), planned.label, planned.images, maps, scan,
        num_points=len(scene.points), num_images=len(scene.images), pixels=size[0] * size[1],
        long_side=max(size), **fingerprints(scene, maps, scan, progress), warnings=tuple(told),
    )  # fmt: skip


def fingerprints(
    scene: Scene, depth: str, cloud: str, progress: Progress = silent
) -> dict[str, str]:
    """The digests of ``SceneFacts``, as files are now; empty without a path of depth or scan."""
    folder = scene.source.image_dir if scene.source else None
    maps = scene.depths if depth else None
    return {
        "digest": "" if folder is None else scene_digest(scene, folder, progress),
        "depth_digest": "" if maps is None else _depth_digest(maps, progress),
        "cloud_digest": _cloud_digest(Path(cloud), progress) if cloud else "",
    }


def scene_digest(scene: Scene, folder: Path, progress: Progress = silent) -> str:
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
        content = photograph_bytes(folder / name)
        if scene.masks is not None and name in scene.masks.files:
            content += read_bytes(scene.masks.files[name])
        return fingerprint(content)

    files = _of_files(of_file, len(images), "fingerprint photographs", progress)
    return fingerprint(*parts, files)


def _depth_digest(maps: DepthMaps, progress: Progress) -> str:
    """Fingerprint depth maps as they are read."""
    names = sorted(maps)

    def of_map(i: int) -> str:
        depth_map = maps.read(names[i])
        return fingerprint(f"{names[i]}\n{depth_map.kind}\n".encode(), depth_map.values)

    return fingerprint(_of_files(of_map, len(names), "fingerprint depth", progress))


def _cloud_digest(path: Path, progress: Progress) -> str:
    """Fingerprint the bytes of a scan's file."""
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
