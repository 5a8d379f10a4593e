"""Scenes of a benchmark: opening one, and checking it before it is run.

Promise: a benchmark always opens a scene in the same way; whatever would make every run on a scene
fail (no photographs, lenses with distortion, unreadable depth or scan) is detected here, before any
run.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from splatseed.bench.planning.digest import cloud_digest, depth_digest, scene_digest
from splatseed.errors import SceneNotFoundError
from splatseed.io import find_depths, load_originals
from splatseed.io.clouds import open_cloud
from splatseed.io.depth_search import search_depths
from splatseed.io.photograph import open_photograph, photograph_bytes
from splatseed.progress import Progress, silent
from splatseed.scene import Scene
from splatseed.splat.gaussians import stray_note, stray_views
from splatseed.views.view import check_lens, poses_of


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
        images: The folder of photographs within the scene's; empty for the default one.
        depth_path: Where its depth maps lie, absolute; empty without.
        depth_digest: Their fingerprint; empty without.
        warnings: What is odd about it, one sentence each.
        long_side: Pixels of its longer side.
        cloud_path: The file of its scan, absolute; empty without.
        cloud_digest: Its fingerprint; empty without.
    """

    name: str
    path: str
    digest: str
    num_points: int
    num_images: int
    pixels: int
    images: str = ""
    depth_path: str = ""
    depth_digest: str = ""
    warnings: tuple[str, ...] = ()
    long_side: int = 0
    cloud_path: str = ""
    cloud_digest: str = ""

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
        scene = _with_images(scene, images)
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
    folder = _photographs(scene, path)
    for image in scene.images:
        check_lens(image, path)
    first = folder / scene.images[0].name
    size = open_photograph(first, photograph_bytes(first)).size
    maps = _depth_folder(scene, depth) if with_depth else None
    return SceneFacts(
        name=name,
        path=str(path.resolve()),
        digest=scene_digest(scene, folder, progress),
        num_points=len(scene.points),
        num_images=len(scene.images),
        pixels=size[0] * size[1],
        images=images,
        depth_path="" if maps is None else str(maps.resolve()),
        depth_digest="" if maps is None else depth_digest(find_depths(scene, maps), progress),
        warnings=(
            *scene.warnings,
            *([scene.listed.sentence] if scene.listed else []),
            *map(stray_note, stray_views(poses_of(scene.images))),
        ),
        long_side=max(size),
        cloud_path="" if cloud is None else str(cloud.resolve()),
        cloud_digest="" if cloud is None else _cloud_digest(cloud, progress),
    )


def _cloud_digest(path: Path, progress: Progress) -> str:
    """The fingerprint of a scan whose header makes sense."""
    open_cloud(path)
    return cloud_digest(path, progress)


def _with_images(scene: Scene, name: str) -> Scene:
    source = scene.source
    if source is None or not (source.root / name).is_dir():
        root = source.root if source else "the scene"
        raise SceneNotFoundError(
            f"the folder {name} in {root}",
            found="no such folder",
            fix="Name another folder of photographs, or none.",
        )
    return scene.replace(source=dataclasses.replace(source, image_dir=source.root / name))


def _photographs(scene: Scene, path: Path) -> Path:
    folder = scene.source.image_dir if scene.source else None
    if folder is None or not scene.images:
        raise SceneNotFoundError(
            f"photographs in {path}",
            found="none",
            fix="Name a scene with images: a point cloud alone cannot be trained.",
        )
    return folder


def _depth_folder(scene: Scene, depth: Path | None) -> Path | None:
    """Where the depth maps lie: what is named, else the scene's own folder if it has some."""
    if depth is not None:
        find_depths(scene, depth)
        return depth
    root = scene.source.root if scene.source else None
    return root if root is not None and search_depths(scene, root) is not None else None
