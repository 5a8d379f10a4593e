"""A COLMAP dense workspace, as its ``stereo_fusion`` takes it, from maps of our own.

Notation: ``images/``, ``sparse/`` and ``stereo/`` as COLMAP's image_undistorter lays them out. COLMAP
places pixel (column, row) of a map at (column, row) of its camera where everyone else, and its own
sparse model, has (column + 0.5, row + 0.5). Promise: depths are those along COLMAP's rays, so that
fused points lie where the scene has them, whatever the size of the maps; the folder appears whole or
not at all; photographs are linked, or copied, and never written to.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from operator import length_hint
from pathlib import Path

import numpy as np

from splatseed.camera import CAMERA_MODELS
from splatseed.errors import OutputError, ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.io._image_folders import bring, image_folders
from splatseed.io._layouts import write_json
from splatseed.io.dense.colmap_files import write_consistency_graph, write_map
from splatseed.io.dense.maps import DenseMap, check_map, depth_along, scaled_K
from splatseed.io.dense.overlap import OverlapPoints
from splatseed.io.dense.report import DenseCount, DenseReport
from splatseed.io.dense.sparse_model import Size, SparseModel, photograph_model
from splatseed.io.depth_folder import safe_parts
from splatseed.io.photograph import open_photograph, photograph_bytes
from splatseed.io.staging import MANIFEST, output_folder
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

__all__ = ["check_dense_scene", "write_dense_workspace"]

_KINDS = ("photometric", "geometric")
"""COLMAP's two passes; stereo_fusion reads the second unless told otherwise."""
_ASPECT_SLACK = 0.02
_CORNER = 0.0
"""Where COLMAP's dense stereo has a pixel's centre."""


def write_dense_workspace(
    scene: Scene,
    maps: Iterable[DenseMap],
    path: str | Path,
    *,
    overwrite: bool = False,
    copy_images: bool = False,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DenseReport:
    """Write a folder that ``colmap stereo_fusion --workspace_path`` turns into a point cloud.

    A map is written under both of COLMAP's names, photometric and geometric, and once more as
    ``.npy`` with depths at pixel centres, which ``find_depths`` prefers.

    Args:
        scene: A scene with photographs and pinhole cameras.
        maps: Of some of its images, in any order and of any size; taken one by one.
        path: The folder to make.
        overwrite: Whether an earlier output of splatseed may be replaced.
        copy_images: Copy the photographs instead of linking them.
        provenance: How the maps came about, for ``splatseed.json``.
        progress: Told how many maps are written.

    Returns:
        What was written.

    Raises:
        ParameterError: There is no map, or one does not belong to the scene.
        SceneNotFoundError: The scene has no photographs, or one is missing.
        SceneFormatError: A camera has distortion, or a photograph has not its shape.
        OutputError: The folder is taken or cannot be written, or an image's name leads out of it.
    """
    model = photograph_model(scene, check_dense_scene(scene))
    count, overlap = DenseCount(), OverlapPoints()
    total = length_hint(maps, len(scene.images)) or 1
    with output_folder(
        Path(path), kind="depth", overwrite=overwrite, protect=_inputs(scene)
    ) as folder:
        _bring_photographs(scene, folder, copy=copy_images)
        stereo = _Stereo(folder / "stereo", model)
        progress("write maps", 0.0)
        for dense in maps:
            stereo.write(dense)
            count.add(dense)
            overlap.add(dense)
            progress("write maps", min(len(count.names) / total, 1.0))
        if not count.names:
            raise ParameterError("at least one depth map", found="none", fix="Make some first.")
        stereo.write_lists()
        model.write(folder / "sparse", overlap)
        write_json(folder / MANIFEST, dict(provenance or {}))
    return count.report(Path(path))


def check_dense_scene(scene: Scene) -> dict[str, Size]:
    """Check that a scene can become a dense workspace, before any work is done.

    Returns:
        Width and height of each photograph, by its name.

    Raises:
        SceneNotFoundError: It has no photographs, or one is missing.
        SceneFormatError: A camera has distortion, or a photograph is not of its shape.
        OutputError: An image's name leads out of its folder.
    """
    folder = scene.source.image_dir if scene.source else None
    if folder is None or not scene.images:
        raise SceneNotFoundError(
            "a scene with photographs",
            found="no images" if folder else "no folder of images",
            fix="Name a scene with cameras, and put its photographs into a folder named images.",
        )
    return {image.name: _checked_size(image, folder) for image in scene.images}


def _checked_size(image: Image, folder: Path) -> Size:
    lens = image.intrinsics
    if not lens.is_pinhole and any(lens.params[CAMERA_MODELS[lens.model].num_focal + 2 :]):
        raise SceneFormatError(
            "cameras without lens distortion (PINHOLE), as COLMAP's dense tools need them",
            found=f"{lens.model} for {image.name}",
            fix="Undistort the scene first: splatseed undistort SCENE -o OUT.",
        )
    if "/".join(safe_parts(image.name)) != image.name or "\n" in image.name:
        raise OutputError(
            "image names that stay inside their folder",
            found=repr(image.name),
            fix="Rename the image.",
        )
    path = folder / image.name
    size = open_photograph(path, photograph_bytes(path)).size
    if abs(size[0] / size[1] / (lens.width / lens.height) - 1) > _ASPECT_SLACK:
        raise SceneFormatError(
            f"{path} to have the shape of its camera, {lens.width} x {lens.height}",
            found=f"{size[0]} x {size[1]}",
            fix="Use the images that the model was made from, or a resized copy of them.",
        )
    return size


def _inputs(scene: Scene) -> tuple[Path, ...]:
    """What was read, which the output must stay apart from."""
    source = scene.source
    if source is None:
        return ()
    return tuple(each for each in (source.root, source.model_dir, source.image_dir) if each)


def _bring_photographs(scene: Scene, folder: Path, *, copy: bool) -> list[str]:
    sources = image_folders(scene)
    photographs = {
        name: source
        for name, source in sources.items()
        if name == "images" or name.startswith("images/")
    }
    return bring(photographs, folder, copy=copy)


class _Stereo:
    """The folder ``stereo`` while it is being written."""

    def __init__(self, folder: Path, model: SparseModel) -> None:
        self._folder = folder
        self._images, self._idxs = model.by_name, model.image_idxs
        self._sources: dict[str, tuple[str, ...]] = {}
        for name in ("depth_maps", "normal_maps", "consistency_graphs"):
            (folder / name).mkdir(parents=True)

    def write(self, dense: DenseMap) -> None:
        """Write one map."""
        check_map(dense, self._images)
        if dense.name in self._sources:
            raise ParameterError(
                "one depth map an image", found=f"two for {dense.name}", fix="Leave one out."
            )
        self._sources[dense.name] = dense.sources
        height, width = dense.depth.shape
        K = scaled_K(self._images[dense.name].camera, width, height)  # as COLMAP scales it
        depth = depth_along(dense, K, _CORNER)
        unknown = ~np.isfinite(depth)
        normal = np.where(unknown[..., None], np.float32(0), dense.normal)
        agreeing = np.where(unknown, np.uint8(0), dense.agreeing)
        idxs = [self._idxs[name] for name in dense.sources]
        for kind in _KINDS:
            file = f"{dense.name}.{kind}.bin"
            write_map(self._folder / "depth_maps" / file, depth)
            write_map(self._folder / "normal_maps" / file, normal)
            write_consistency_graph(self._folder / "consistency_graphs" / file, agreeing, idxs)
        centred = self._folder / "depth_maps" / f"{dense.name}.npy"
        np.save(centred, depth_along(dense, K, 0.5), allow_pickle=False)

    def write_lists(self) -> None:
        """Write which images to match with which, and which to fuse, ordered as in the model."""
        names = [name for name in self._images if name in self._sources]
        matches = [f"{name}\n{_matches(self._sources[name])}\n" for name in names]
        (self._folder / "patch-match.cfg").write_text("".join(matches), encoding="utf-8")
        fused = "".join(f"{name}\n" for name in names)
        (self._folder / "fusion.cfg").write_text(fused, encoding="utf-8")


def _matches(sources: tuple[str, ...]) -> str:
    """The line of sources; COLMAP's own choice where there are none or a comma would split names."""
    if not sources or any("," in name for name in sources):
        return "__auto__, 20"
    return ", ".join(sources)
