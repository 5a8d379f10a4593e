"""Writing stereo's depth and normal maps: a COLMAP dense workspace, or a plain folder.

Notation: ``K`` [3, 3] maps rays r = (x, y, 1) to pixels; a map's own pixel (column, row) has its
centre at (column + 0.5, row + 0.5). A workspace has ``images/``, ``sparse/`` and ``stereo/`` as
COLMAP's image_undistorter lays them out, for its ``stereo_fusion``; COLMAP places pixel (column,
row) of a map at (column, row) of its camera, whereas everyone else, its own sparse model included,
has (column + 0.5, row + 0.5). Files of floats (mvs/mat.h) and consistency graphs
(mvs/consistency_graph.h), little-endian, begin with the text ``W&H&C&``; a map follows with C x H x
W float32, one channel after another, a graph with int32: column, row, n and n image indices for
each pixel that has any. In a plain folder the image ``a/b.jpg`` has ``a/b.jpg.npy``, its planar
depth, and ``a/b.jpg.stereo.npz`` with the rest.

Promise: depths are those along COLMAP's rays, so fused points lie where the scene has them,
whatever the size of the maps; a pixel is moved along the plane given by its normal and never mixed
with its neighbours, so that no depth between two surfaces is invented; a folder appears whole or
not at all.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import length_hint
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float32, Float64, UInt8

from splatseed.camera import Camera
from splatseed.errors import ParameterError
from splatseed.io.dense_model import (
    OverlapPoints,
    Size,
    SparseModel,
    Undistort,
    bring_photographs,
    check_image,
    photograph_model,
    scaled_K,
)
from splatseed.io.depth_maps import depth_folder, safe_parts
from splatseed.io.photograph import photograph_folder
from splatseed.io.staging import MANIFEST, output_folder, write_json
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene

_MAX_SOURCES = 8
"""``agreeing`` has one bit per source."""
_MAX_CHANGE = 1.25
"""Planes seen at so grazing an angle that depth changes by more than this factor are left out."""
_SAME_POSE = 1e-6
_KINDS = ("photometric", "geometric")
"""COLMAP's two passes; stereo_fusion reads the second unless told otherwise."""


class DenseMap(Protocol):
    """Depth, normals and confidence of one image; ``splatseed.depth.stereo.StereoMap`` is one."""

    @property
    def name(self) -> str:
        """The image's name."""

    @property
    def camera(self) -> Camera:
        """The camera, in pixels of this map."""

    @property
    def depth(self) -> Float32[np.ndarray, "H W"]:
        """Planar z-depth in scene units; NaN where unknown."""

    @property
    def normal(self) -> Float32[np.ndarray, "H W 3"]:
        """Unit normals in camera axes, facing the camera; NaN where unknown."""

    @property
    def confidence(self) -> Float32[np.ndarray, "H W"]:
        """Confidence, 0 to 1; 0 where depth is NaN."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the views that it was compared with."""

    @property
    def agreeing(self) -> UInt8[np.ndarray, "H W"]:
        """Bit k is set where source k confirms the pixel."""


@dataclass(frozen=True)
class DenseReport:
    """What was written.

    Args:
        path: The output folder.
        num_maps: How many maps.
        num_pixels: Pixels of all maps.
        num_known: Pixels with a depth.
        empty: Names of images whose map has no depth at all.
    """

    path: Path
    num_maps: int = 0
    num_pixels: int = 0
    num_known: int = 0
    empty: tuple[str, ...] = ()

    @property
    def share_known(self) -> float:
        """The share of pixels with a depth, 0 to 1."""
        return self.num_known / max(self.num_pixels, 1)

    def with_map(self, dense: DenseMap) -> DenseReport:
        """The report after one more map."""
        known = int(np.count_nonzero(np.isfinite(dense.depth)))
        return DenseReport(
            self.path,
            self.num_maps + 1,
            self.num_pixels + dense.depth.size,
            self.num_known + known,
            self.empty if known else tuple(sorted((*self.empty, dense.name))),
        )


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
    report, total = DenseReport(Path(path)), length_hint(maps, len(images)) or 1
    protect = scene.source.inputs if scene.source else ()
    with depth_folder(
        Path(path), "z", overwrite=overwrite, protect=protect, provenance=provenance
    ) as writer:
        for dense in maps:
            _check_map(dense, images)
            height, width = dense.depth.shape
            K = scaled_K(images[dense.name].camera, width, height)  # as readers scale it
            writer.write(dense.name, depth_along(dense, K, 0.5))
            rest = writer.folder.joinpath(*safe_parts(f"{dense.name}.stereo.npz"))
            with rest.open("xb") as file:
                np.savez(
                    file,
                    normal=np.asarray(dense.normal, np.float32),
                    confidence=np.asarray(dense.confidence, np.float32),
                    agreeing=np.asarray(dense.agreeing, np.uint8),
                    sources=np.array(dense.sources, np.str_),
                    K=np.asarray(dense.camera.K, np.float64),
                )
            report = report.with_map(dense)
            progress("write maps", min(report.num_maps / total, 1.0))
        _check_any(report)
    return report


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
    report, overlap = DenseReport(Path(path)), OverlapPoints()
    total = length_hint(maps, len(scene.images)) or 1
    inputs = scene.source.inputs if scene.source else ()
    with output_folder(Path(path), kind="depth", overwrite=overwrite, protect=inputs) as folder:
        bring_photographs(scene, folder, undistort, progress, copy=copy_images)
        stereo = folder / "stereo"
        for name in ("depth_maps", "normal_maps", "consistency_graphs"):
            (stereo / name).mkdir(parents=True)
        sources: dict[str, tuple[str, ...]] = {}
        progress("write maps", 0.0)
        for dense in maps:
            if dense.name in sources:
                raise ParameterError(
                    "one depth map per image", found=f"two for {dense.name}", fix="Leave one out."
                )
            sources[dense.name] = dense.sources
            _write_stereo(stereo, model, dense)
            report = report.with_map(dense)
            overlap.add(dense.camera, dense.depth, (dense.name, *dense.sources), dense.agreeing)
            progress("write maps", min(report.num_maps / total, 1.0))
        _check_any(report)
        # Which images to match with which, and which to fuse, in the model's order.
        names = [name for name in model.by_name if name in sources]
        matches = [f"{name}\n{_matches(sources[name])}\n" for name in names]
        (stereo / "patch-match.cfg").write_text("".join(matches), encoding="utf-8")
        fused = "".join(f"{name}\n" for name in names)
        (stereo / "fusion.cfg").write_text(fused, encoding="utf-8")
        model.write(folder / "sparse", overlap)
        write_json(folder / MANIFEST, dict(provenance or {}))
    return report


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


def depth_along(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float32[np.ndarray, "H W"]:
    """The depth of each pixel's plane along another ray nearby; NaN where unknown.

    Args:
        dense: The map.
        K: Maps the other rays to their grid, [3, 3].
        at: Pixel (column, row) gets the depth along the ray through (column + at, row + at) of that
            grid. 0.5 is a pixel's centre; COLMAP's dense stereo uses 0.
    """
    own = _toward_plane(dense, dense.camera.K, 0.5)
    other = _toward_plane(dense, K, at)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = own / other  # n . (d r) = n . (d' r'), so d' = d (n . r) / (n . r')
        near = (ratio < _MAX_CHANGE) & (ratio > 1 / _MAX_CHANGE)
    ratio = np.where(near, ratio, np.where(np.isfinite(own), np.nan, 1.0))  # no normal: unchanged
    return np.asarray(dense.depth * ratio, np.float32)


def _toward_plane(
    dense: DenseMap, K: Float64[np.ndarray, "3 3"], at: float
) -> Float64[np.ndarray, "H W"]:
    """The product n . r of each pixel's normal and the ray through (column + at, row + at)."""
    height, width = dense.depth.shape
    rows, columns = np.mgrid[0:height, 0:width] + at
    rays = np.stack([columns, rows, np.ones_like(rows)], axis=-1) @ np.linalg.inv(K).T
    return np.asarray(np.einsum("hwc,hwc->hw", dense.normal.astype(np.float64), rays))


def _check_any(report: DenseReport) -> None:
    if not report.num_maps:
        raise ParameterError("at least one depth map", found="none", fix="Make some first.")


def _check_map(dense: DenseMap, images: Mapping[str, Image]) -> None:
    """Check that a map belongs to an image of the scene, and that its arrays match."""
    unknown = [name for name in (dense.name, *dense.sources) if name not in images]
    size = (dense.camera.height, dense.camera.width)
    arrays = (dense.depth, dense.normal[..., 0], dense.confidence, dense.agreeing)
    wrong = [each.shape for each in arrays if each.shape != size]
    if unknown:
        expected, found = "images of the scene", ", ".join(unknown[:3])
    elif len(dense.sources) > _MAX_SOURCES:
        expected, found = f"at most {_MAX_SOURCES} sources", f"{len(dense.sources)}"
    elif wrong:
        expected, found = f"arrays of its camera's size, {size}", f"{wrong[0]}"
    else:
        pose = images[dense.name].camera.cam_from_world
        tolerance = _SAME_POSE * max(1.0, float(np.abs(pose).max()))
        if np.allclose(dense.camera.cam_from_world, pose, atol=tolerance):
            return
        expected, found = "the pose of its image", "another"
    raise ParameterError(
        f"the map of {dense.name} to have {expected}",
        found=found,
        fix="Make the maps from this scene.",
    )


def _write_stereo(folder: Path, model: SparseModel, dense: DenseMap) -> None:
    """Write one map into the folder ``stereo``."""
    _check_map(dense, model.by_name)
    height, width = dense.depth.shape
    K = scaled_K(model.by_name[dense.name].camera, width, height)  # as COLMAP scales it
    depth = depth_along(dense, K, 0.0)
    unknown = ~np.isfinite(depth)
    normal = np.where(unknown[..., None], np.float32(0), dense.normal)
    agreeing = np.where(unknown, np.uint8(0), dense.agreeing)
    idxs = [model.image_idxs[name] for name in dense.sources]
    for kind in _KINDS:
        file = f"{dense.name}.{kind}.bin"
        write_map(folder / "depth_maps" / file, depth)
        write_map(folder / "normal_maps" / file, normal)
        write_consistency_graph(folder / "consistency_graphs" / file, agreeing, idxs)
    centred = folder / "depth_maps" / f"{dense.name}.npy"
    np.save(centred, depth_along(dense, K, 0.5), allow_pickle=False)


def _matches(sources: tuple[str, ...]) -> str:
    """The line of sources; COLMAP's own choice if there are none or a comma would split names."""
    if not sources or any("," in name for name in sources):
        return "__auto__, 20"
    return ", ".join(sources)


def write_map(path: Path, values: Float32[np.ndarray, "H W *C"]) -> None:
    """Write a depth map [H, W] or a normal map [H, W, 3]; NaN becomes 0, COLMAP's "unknown".

    Args:
        path: A file that does not exist yet.
        values: The map, top row first.

    Raises:
        OSError: It exists, or cannot be written.
    """
    height, width = values.shape[:2]
    planes = np.moveaxis(values.reshape(height, width, -1), -1, 0)
    known = np.nan_to_num(planes, nan=0.0).astype("<f4")
    _write(path, (width, height, len(planes)), known.tobytes())


def write_consistency_graph(
    path: Path, agreeing: UInt8[np.ndarray, "H W"], image_idxs: Sequence[int]
) -> None:
    """Write which images confirm each pixel, row by row.

    Args:
        path: A file that does not exist yet.
        agreeing: Bit k is set where ``image_idxs[k]`` confirms the pixel.
        image_idxs: Positions of the sources in the model's list of images, from 0.

    Raises:
        OSError: It exists, or cannot be written.
    """
    bits = (agreeing[..., None] >> np.arange(len(image_idxs), dtype=np.uint8)) & 1
    rows, columns = np.nonzero(bits.any(axis=-1))
    bits = bits[rows, columns].astype(bool)
    counts = bits.sum(axis=1)
    starts = np.cumsum(counts + 3) - (counts + 3)
    records = np.empty(int((counts + 3).sum()), "<i4")
    for place, values in enumerate((columns, rows, counts)):
        records[starts + place] = values
    pixel, source = np.nonzero(bits)
    nth = np.arange(len(pixel)) - np.repeat(np.cumsum(counts) - counts, counts)
    records[starts[pixel] + 3 + nth] = np.array(image_idxs, np.int32)[source]
    height, width = agreeing.shape
    _write(path, (width, height, 1), records.tobytes())


def _write(path: Path, size: tuple[int, int, int], body: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("xb") as file:
        file.write("".join(f"{each}&" for each in size).encode("ascii"))
        file.write(body)
