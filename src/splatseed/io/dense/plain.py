"""A plain folder of stereo maps, as ``--method depth`` reads them.

Notation: for the image ``a/b.jpg`` there are ``a/b.jpg.npy``, its planar depth, and
``a/b.jpg.stereo.npz`` with the rest: ``normal``, ``confidence``, ``agreeing``, ``sources`` and
``K``.
Promise: readers of depth maps take the first file and ignore the second.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from operator import length_hint
from pathlib import Path

import numpy as np

from splatseed.errors import ParameterError
from splatseed.io.dense.maps import DenseMap, check_map, depth_along, scaled_K
from splatseed.io.dense.report import DenseCount, DenseReport
from splatseed.io.depth.folder import depth_folder, safe_parts
from splatseed.progress import Progress, silent
from splatseed.scene import Scene


def write_dense_maps(
    scene: Scene,
    maps: Iterable[DenseMap],
    path: str | Path,
    *,
    overwrite: bool = False,
    provenance: Mapping[str, object] | None = None,
    progress: Progress = silent,
) -> DenseReport:
    """Write a folder of depth maps of kind "z"; ``splatseed.io.find_depths`` reads them.

    Args:
        scene: The scene of the maps.
        maps: The maps of some of its images, in any order and of any size; consumed one by one.
        path: The folder to make.
        overwrite: Whether an earlier output of splatseed may be replaced.
        provenance: How the maps came about, for ``splatseed.json``.
        progress: Called with the stage and the fraction done.

    Returns:
        What was written.

    Raises:
        ParameterError: There is no map, or one does not belong to the scene.
        OutputError: The folder is taken or cannot be written.
    """
    images = {image.name: image for image in scene.images}
    count, total = DenseCount(), length_hint(maps, len(images)) or 1
    protect = scene.source.inputs if scene.source else ()
    with depth_folder(
        Path(path), "z", overwrite=overwrite, protect=protect, provenance=provenance
    ) as writer:
        for dense in maps:
            check_map(dense, images)
            height, width = dense.depth.shape
            K = scaled_K(images[dense.name].camera, width, height)  # as readers scale it
            writer.write(dense.name, depth_along(dense, K, 0.5))
            _write_rest(writer.folder, dense)
            count.add(dense)
            progress("write maps", min(len(count.names) / total, 1.0))
        if not count.names:
            raise ParameterError("at least one depth map", found="none", fix="Make some first.")
    return count.report(Path(path))


def _write_rest(folder: Path, dense: DenseMap) -> None:
    path = folder.joinpath(*safe_parts(f"{dense.name}.stereo.npz"))
    with path.open("xb") as file:
        np.savez(
            file,
            normal=np.asarray(dense.normal, np.float32),
            confidence=np.asarray(dense.confidence, np.float32),
            agreeing=np.asarray(dense.agreeing, np.uint8),
            sources=np.array(dense.sources, np.str_),
            K=np.asarray(dense.camera.K, np.float64),
        )
