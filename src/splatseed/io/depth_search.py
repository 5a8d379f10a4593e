"""Finding the depth maps of a scene's images: by time in an RGB-D capture, else by name."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io.depth_files import KINDS, SUFFIXES
from splatseed.io.depth_maps import DepthFiles, match_by_name
from splatseed.io.rgbd import find_tum_depths, is_tum
from splatseed.scene import Scene


def find_depths(
    scene: Scene, path: Path, *, kind: DepthKind | None = None, scale: float | None = None
) -> DepthFiles:
    """The depth maps in a folder that belong to images of a scene.

    Args:
        scene: The scene.
        path: The folder: maps named like the images, with subfolders, or a COLMAP dense workspace,
            an RGB-D capture in NICE-SLAM's or TUM's layout, or the output of ``splatseed depth``.
        kind: What the values are; None: what the folder or file itself says, else planar z.
        scale: Stored units per scene unit; None: what the folder itself says, else 1000 for
            integers and 1 for floats.

    Returns:
        The maps, read one by one on demand. An image without a map is not among them.

    Raises:
        ParameterError: The kind is unknown, or the scale is not a positive number.
        SceneNotFoundError: There is no such folder, or no image has a map in it.
        SceneFormatError: Two images share a map, or the folder's description is damaged.
    """
    if kind is not None and kind not in KINDS:
        raise ParameterError(
            f"a kind of depth: {', '.join(KINDS)}", found=repr(kind), fix="Choose one of them."
        )
    if scale is not None and not (math.isfinite(scale) and scale > 0):
        raise ParameterError(
            "a scale of depth above 0", found=f"{scale}", fix="Give stored units per scene unit."
        )
    root = Path(path)
    if not root.is_dir():
        raise SceneNotFoundError(
            f"a folder of depth maps at {root}",
            found="a file" if root.exists() else "nothing",
            fix="Name the folder that the maps lie in.",
        )
    maps = search_depths(scene, root)
    if maps is None:
        name = scene.images[0].name if scene.images else ""
        raise SceneNotFoundError(
            f"depth maps of the scene's images in {root}"
            + (f", such as {name}{SUFFIXES[0]} or {Path(name).stem}.png" if name else ""),
            found="none" if name else "a scene without images",
            fix="Name maps as their images are, with subfolders and another suffix.",
        )
    return replace(maps, kind=kind or maps.kind, scale=scale or maps.scale)


def with_own_depths(scene: Scene) -> Scene:
    """The scene with the depth maps that lie in its own folder, if it has none and there are some.

    Raises:
        SceneFormatError: Two images share a map, or the folder's description is damaged.
    """
    if scene.depths is not None or scene.source is None:
        return scene
    return scene.replace(depths=search_depths(scene, scene.source.root))


def search_depths(scene: Scene, root: Path) -> DepthFiles | None:
    """As ``find_depths``, but None where no image has a map.

    Raises:
        SceneFormatError: Two images share a map, or the folder's description is damaged.
    """
    if is_tum(root) and (maps := find_tum_depths(scene, root)) is not None:
        return maps
    if (maps := match_by_name(scene, root)) is not None:
        return maps
    capture = root.resolve().parent  # perhaps the folder of depth images was named
    return find_tum_depths(scene, capture) if is_tum(capture) else None
