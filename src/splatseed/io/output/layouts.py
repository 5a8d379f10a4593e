"""The two sets of files that trainers look for: COLMAP's, and nerfstudio's ``transforms.json``.

Promise: every point file in a layout holds the scene's points in their order, ``seeds.npz`` too;
COLMAP's root holds no PLY, because Brush loads any it finds there. Writers write straight into
``folder`` and let ``OSError`` pass.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.io.colmap import binary as colmap_binary
from splatseed.io.colmap.ids import Renumbered, renumber
from splatseed.io.colmap.scene import read_model_cameras
from splatseed.io.nerfstudio.content import (
    applied_transform,
    frame_paths,
    kept_json,
    transforms_json,
)
from splatseed.io.nerfstudio.transforms import apply_transform, read_transforms
from splatseed.io.output.image_folders import frame_folders, image_folders
from splatseed.io.output.seeds_npz import write_seeds
from splatseed.io.ply import write_ply
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS, split_fields
from splatseed.io.staging import write_json
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene

_ROOT_EXTRAS = ("poses_bounds.npy", "ext_metadata.json")  # gsplat's examples read them if present
_MODEL_EXTRAS = ("depth_params.json",)  # graphdeco's trainer reads it if present
_RIG_FILES = ("rigs", "frames")
_SAME_POSE = 1e-9  # relative and absolute; a pose that went through other formats is that near


def write_colmap(scene: Scene, folder: Path) -> tuple[list[str], dict[str, Path]]:
    """Write ``sparse/0``; returns notes for the user and the image folders that belong to it."""
    model_dir = folder / "sparse" / "0"
    model_dir.mkdir(parents=True)
    model = renumber(scene)
    colmap_binary.write_cameras(model_dir / "cameras.bin", _all_cameras(scene))
    colmap_binary.write_images(model_dir / "images.bin", model.images)
    colmap_binary.write_points3d(model_dir / "points3D.bin", scene.points, model.tracks)
    write_ply(model_dir / "points3D.ply", scene.points)
    write_seeds(folder, scene.points)
    notes = [*_copy_extras(scene, folder, model_dir), *_model_notes(scene, model)]
    write_split(scene, folder)
    return notes, image_folders(scene)


def write_transforms(scene: Scene, folder: Path) -> tuple[list[str], dict[str, Path]]:
    """Write ``transforms.json`` and its PLY; returns notes and the image folders it names."""
    source, points = scene.source, scene.points
    if source is not None and source.transforms_path is not None:
        names = {image.name for image in scene.images}
        content = kept_json(read_transforms(source.transforms_path), names)
        paths = frame_paths(content["frames"])
        if source.image_dir is not None and source.image_dir.resolve() == source.root.resolve():
            paths += names  # a frame's own path may lack the extension
        folders = frame_folders(source.root, paths)
    else:
        content = {**transforms_json(scene), **split_fields(scene)}
        folders = image_folders(scene)
        points = _turned(points, applied_transform(scene))
    write_json(folder / "transforms.json", {**content, "ply_file_path": "sparse_pc.ply"})
    write_ply(folder / "sparse_pc.ply", points)
    shutil.copyfile(folder / "sparse_pc.ply", folder / "pointcloud.ply")  # LichtFeld's name for it
    write_seeds(folder, points)
    if scene.source is not None:
        _copy(scene.source.root, ROOT_LISTS, folder)
    return [], folders


def _turned(points: PointCloud, A: Float64[np.ndarray, "3 4"] | None) -> PointCloud:
    """The points and their normals in the world of a new ``transforms.json``."""
    if A is None:
        return points
    xyz = apply_transform(A, points.xyz).astype(np.float32)
    if points.normals is None:
        return points.replace(xyz=xyz)
    return points.replace(xyz=xyz, normals=points.normals @ A[:, :3].T)


def _all_cameras(scene: Scene) -> tuple[Intrinsics, ...]:
    """The file's camera records, and those that only images have (in scenes made in memory)."""
    cameras = {camera.camera_id: camera for camera in scene.intrinsics}
    for image in scene.images:
        cameras.setdefault(image.intrinsics.camera_id, image.intrinsics)
    return tuple(cameras.values())


def _copy_extras(scene: Scene, folder: Path, model_dir: Path) -> list[str]:
    """Copy the small files beside the model byte for byte; returns notes."""
    source = scene.source
    if source is None or source.model_dir is None:
        return []
    rigs, notes = _rigs(scene, source.model_dir)
    _copy(source.root, _ROOT_EXTRAS, folder)
    _copy(source.model_dir, (*_MODEL_EXTRAS, *rigs), model_dir)
    return notes


def _copy(source: Path, names: Sequence[str], target: Path) -> None:
    for name in names:
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)


def write_split(scene: Scene, folder: Path) -> None:
    """Write the lists of a scene's split beside a COLMAP model: its own, else nerfstudio's.

    Args:
        scene: The scene.
        folder: The folder that holds ``sparse/0``.

    Raises:
        OSError: A list cannot be written.
    """
    if scene.source is not None:
        _copy(scene.source.root, ROOT_LISTS, folder)
        if scene.source.model_dir is not None:
            _copy(scene.source.model_dir, MODEL_LISTS, folder / "sparse" / "0")
    if scene.listed is None or any((folder / name).exists() for name in ROOT_LISTS):
        return
    for part, images in zip(ROOT_LISTS, scene.split(), strict=False):  # train and test
        text = "".join(f"{image.name}\n" for image in images)
        (folder / part).write_text(text, "utf-8")


def _rigs(scene: Scene, model_dir: Path) -> tuple[list[str], list[str]]:
    """The model's rigs and frames if they are valid for the output, else a note saying why not."""
    there = [f"{name}.bin" for name in _RIG_FILES if (model_dir / f"{name}.bin").is_file()]
    if there and _has_same_images(scene, model_dir):
        return there, []
    if there:
        return [], [
            "Rigs and frames were left out: the scene no longer has the same images and poses."
        ]
    if any((model_dir / f"{name}.txt").is_file() for name in _RIG_FILES):
        return [], [
            "Rigs and frames were left out: as text they would not be read beside the binary model."
        ]
    return [], []


def _has_same_images(scene: Scene, model_dir: Path) -> bool:
    """Whether the scene still has the images of its model, at their poses, which frames repeat."""
    poses = {(im.image_id, im.name): im.camera.cam_from_world for im in scene.images}
    before = {
        (im.image_id, im.name): im.camera.cam_from_world for im in read_model_cameras(model_dir)[1]
    }
    return poses.keys() == before.keys() and all(
        np.allclose(poses[key], before[key], rtol=_SAME_POSE, atol=_SAME_POSE) for key in poses
    )


def _model_notes(scene: Scene, model: Renumbered) -> list[str]:
    notes = []
    if model.num_broken:
        notes.append(
            f"{model.num_broken:,} references between features and points were removed: the other"
            " side did not confirm them."
        )
    if not scene.images:
        notes.append(
            "The scene has no images, so it cannot be trained as it is: copy points3D.bin and"
            " points3D.ply from sparse/0 into sparse/0 of a copy of the full scene, and seeds.npz,"
            " if there is one, into that copy."
        )
    return notes
