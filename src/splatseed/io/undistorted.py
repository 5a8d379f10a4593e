"""Depth maps of the distorted photographs that ``splatseed undistort`` or ``sfm`` started from.

Output of these commands has ``distorted.json``, with the original lenses: by image name, ``model``,
``width``, ``height`` and ``params`` in COLMAP's terms. If the undistorted photographs have another
size, maps of the original size are undistorted on reading; if they have another aspect ratio, so
are a sensor's maps, which have confidences, of the original aspect ratio. Other maps are taken to
be made from the undistorted photographs, since a network's may have any size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from splatseed.camera import Intrinsics
from splatseed.io.camera_records import make_intrinsics
from splatseed.io.depth_files import read_stored
from splatseed.io.depth_maps import DepthFiles, Undistortion
from splatseed.io.files import read_json, translate_errors
from splatseed.io.staging import write_json
from splatseed.scene import Scene

LENSES = "distorted.json"
"""The file of the lenses, in the folder of an undistorted scene."""


def write_lenses(folder: Path, lenses: Mapping[str, Intrinsics]) -> None:
    """Write the lenses of photographs with distortion, by image name, if there are any."""
    bent = {
        name: {"model": lens.model, "width": lens.width, "height": lens.height,
               "params": list(lens.params)}
        for name, lens in sorted(lenses.items())
        if lens.has_distortion
    }  # fmt: skip
    if bent:
        write_json(folder / LENSES, bent)


def fitted_to_undistorted(scene: Scene, maps: DepthFiles) -> DepthFiles:
    """Return maps with the undistortion that the scene's photographs have had, if they need it."""
    path = scene.source.root and scene.source.root / LENSES
    if path is None or not path.is_file() or maps.lens is not None:
        return maps
    images = [image for image in scene.images if image.name in maps]
    before = _read_lenses(path)
    cameras = {im.name: im.intrinsics for im in images if im.name in before}
    if not cameras:
        return maps
    name, camera = next(iter(cameras.items()))
    height, width = read_stored(maps.paths[name]).values.shape
    lens = before[name]
    same_size = (width, height) == (lens.width, lens.height) != (camera.width, camera.height)
    same_shape = (
        width * lens.height == height * lens.width
        and width * camera.height != height * camera.width
    )
    if not (same_size or (same_shape and maps.confidences)):
        return maps
    share = width / lens.width  # of a photograph's pixels
    reduced = {
        name: camera.resized(round(camera.width * share), round(camera.height * share))
        for name, camera in cameras.items()
    }
    return replace(maps, lens=Undistortion(before, reduced))


def _read_lenses(path: Path) -> dict[str, Intrinsics]:
    content = read_json(path)
    fix = "Undistort the scene again."
    with translate_errors(path, "lenses by image name, as splatseed undistort writes", fix=fix):
        return {
            name: make_intrinsics(
                f"{path}, {name}", 1, each["model"], each["width"], each["height"], each["params"]
            )
            for name, each in content.items()
        }
