"""A COLMAP dense workspace from our own maps, as its ``stereo_fusion`` takes it.

Notation: ``images/``, ``sparse/`` and ``stereo/`` as COLMAP's image_undistorter lays them out.
COLMAP places pixel (column, row) of a map at (column, row) of its camera, whereas everyone else,
its own sparse model included, has (column + 0.5, row + 0.5). Promise: depths are those along
COLMAP's rays, so fused points lie where the scene has them, whatever the size of the maps; the
folder appears whole or not at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from operator import length_hint
from pathlib import Path

import numpy as np

from splatseed.errors import ParameterError
from splatseed.io.dense.colmap_files import write_consistency_graph, write_map
from splatseed.io.dense.maps import DenseMap, check_map, depth_along, scaled_K
from splatseed.io.dense.overlap import OverlapPoints
from splatseed.io.dense.photographs import Undistort, bring_photographs, check_image
from splatseed.io.dense.report import DenseCount, DenseReport
from splatseed.io.dense.sparse_model import Size, SparseModel, photograph_model
from splatseed.io.photograph import photograph_folder
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.progress import Progress, silent
from splatseed.scene import Scene

_KINDS = ("photometric", "geometric")
"""COLMAP's two passes; stereo_fusion reads the second unless told otherwise."""
_CORNER = 0.0
"""The offset of a pixel's centre in COLMAP's dense stereo."""


def write_dense_workspace(
    scene: Scene,
    maps: Iterable[DenseMap],
    path: str | Path,
    *,
    overwrite: bool = False,
    copy_images: bool = False,
    undistort: Undistort | None = None,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DenseReport:
    """Write a folder that ``colmap stereo_fusion --workspace_path`` turns into a point cloud.

    A map is written under both of COLMAP's names, photometric and geometric, and once more as
    ``.npy`` with depths at pixel centres, which ``find_depths`` prefers.

    Args:
        scene: A scene with photographs.
        maps: Maps of some of its images, in any order and of any size; taken one by one.
        path: The folder to make.
        overwrite: Whether an earlier output of splatseed may be replaced.
        copy_images: Copy the photographs instead of linking them.
        undistort: Removes lens distortion from a photograph, such as
            ``splatseed.views.undistortion.undistort``. The workspace then holds the undistorted
            photographs and pinhole cameras of the same matrix, which the maps belong to. Without
            it, distorted cameras are refused.
        provenance: How the maps came about, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Returns:
        What was written.

    Raises:
        ParameterError: There is no map, or one does not belong to the scene.
        SceneNotFoundError: The scene has no photographs, or one is missing.
        SceneFormatError: A camera has distortion that is not removed, or a photograph differs from
            its camera in aspect ratio.
        OutputError: The folder is taken or cannot be written, or an image's name leads out of it.
    """
    model = photograph_model(scene, check_dense_scene(scene, undistorts=undistort is not None))
    count, overlap = DenseCount(), OverlapPoints()
    total = length_hint(maps, len(scene.images)) or 1
    inputs = scene.source.inputs if scene.source else ()
    with output_folder(Path(path), kind="depth", overwrite=overwrite, protect=inputs) as folder:
        bring_photographs(scene, folder, undistort, progress, copy=copy_images)
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


def check_dense_scene(scene: Scene, *, undistorts: bool = False) -> dict[str, Size]:
    """Check that a scene can become a dense workspace, before any work is done.

    Args:
        scene: The scene.
        undistorts: Whether distortion will be removed.

    Returns:
        Width and height of each photograph, by its name.

    Raises:
        SceneNotFoundError: It has no photographs, or one is missing.
        SceneFormatError: A camera has distortion that stays, or a photograph differs from it in
            aspect ratio.
        OutputError: An image's name leads out of its folder.
    """
    folder = photograph_folder(scene)
    return {image.name: check_image(image, folder, undistorts=undistorts) for image in scene.images}


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
                "one depth map per image", found=f"two for {dense.name}", fix="Leave one out."
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
        """Write which images to match with which, and which to fuse, in the model's order."""
        names = [name for name in self._images if name in self._sources]
        matches = [f"{name}\n{_matches(self._sources[name])}\n" for name in names]
        (self._folder / "patch-match.cfg").write_text("".join(matches), encoding="utf-8")
        fused = "".join(f"{name}\n" for name in names)
        (self._folder / "fusion.cfg").write_text(fused, encoding="utf-8")


def _matches(sources: tuple[str, ...]) -> str:
    """The line of sources.

    COLMAP's own choice where there are none or a comma would split names.
    """
    if not sources or any("," in name for name in sources):
        return "__auto__, 20"
    return ", ".join(sources)
