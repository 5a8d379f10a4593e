"""The COLMAP layout of an output: ``sparse/0``, with the split's lists beside it.

The root holds no PLY, because Brush loads any that it finds there.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.findings import Finding
from splatseed.io import colmap
from splatseed.io.cleaning import renumber
from splatseed.io.colmap_model import read_model_cameras
from splatseed.io.depth_maps import LENSES
from splatseed.io.image_folders import copy_files, image_folders
from splatseed.io.ply import write_ply
from splatseed.io.seeds import write_seeds
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS
from splatseed.scene import Scene

Written = tuple[list[Finding], dict[str, Path], Float64[np.ndarray, " 3"]]
"""What a layout's writer returns: findings, image folders, and the offset of its space to the
world."""
_ROOT_EXTRAS = ("poses_bounds.npy", "ext_metadata.json", LENSES)
"""Gsplat's examples read the first two if present."""
_MODEL_EXTRAS = ("depth_params.json",)  # graphdeco's trainer reads it if present
_SAME_POSE = 1e-9  # relative and absolute; a pose that went through other formats is that near


def write_colmap_layout(scene: Scene, folder: Path) -> Written:
    """Write ``sparse/0`` and the lists of the split into an output."""
    model_dir = folder / "sparse" / "0"
    model_dir.mkdir(parents=True)
    tracks, images, num_broken = renumber(scene)
    # The file's camera records, and those that only images have (in scenes made in memory).
    cameras = {camera.camera_id: camera for camera in scene.intrinsics}
    for image in scene.images:
        cameras.setdefault(image.intrinsics.camera_id, image.intrinsics)
    colmap.write_cameras(
        model_dir / "cameras.bin", tuple(map(without_zero_distortion, cameras.values()))
    )
    colmap.write_images(model_dir / "images.bin", images)
    colmap.write_points3d(model_dir / "points3D.bin", scene.points, tracks)
    write_ply(model_dir / "points3D.ply", scene.points)
    write_seeds(folder, scene.points)
    findings = list[Finding]()
    source = scene.source
    if source.model_dir is not None:
        rigs, findings = _rigs(scene, cameras, source.model_dir)
        copy_files(source.root, _ROOT_EXTRAS, folder)
        copy_files(source.model_dir, (*_MODEL_EXTRAS, *rigs), model_dir)
    if num_broken:
        text = (
            f"{num_broken:,} references between features and points were removed: the other side"
            " does not have them."
        )
        findings.append(Finding("broken-references", text))
    if not scene.images:
        text = (
            "The scene has no images, so it cannot be trained as it is: copy points3D.bin and"
            " points3D.ply from sparse/0 into sparse/0 of a copy of the full scene, and seeds.npz,"
            " if there is one, into that copy."
        )
        findings.append(Finding("points-alone", text))
    write_split(scene, folder)
    return findings, image_folders(scene), scene.offset


def write_split(scene: Scene, folder: Path) -> None:
    """Copy the lists of a scene's split beside a COLMAP model, or write them as nerfstudio does."""
    copy_files(scene.source.root, ROOT_LISTS, folder)
    copy_files(scene.source.model_dir, MODEL_LISTS, folder / "sparse" / "0")
    if scene.listed is None or any((folder / name).exists() for name in ROOT_LISTS):
        return
    train, test = ([image.name for image in part] for part in scene.split())
    write_lists(folder, train, test)


def write_lists(folder: Path, train: Sequence[str], test: Sequence[str]) -> None:
    """Write lists of training and test images as nerfstudio does."""
    for part, names in zip(ROOT_LISTS, (train, test, test), strict=False):  # val: test, too
        (folder / part).write_text("".join(f"{name}\n" for name in names), "utf-8")


def _rigs(
    scene: Scene, cameras: Container[int], model_dir: Path
) -> tuple[list[str], list[Finding]]:
    """Return the files of rigs and frames that fit the output, or a finding why none does.

    ``cameras`` are the ids of the output's records.
    """
    there = [name for name in ("rigs.bin", "frames.bin") if (model_dir / name).is_file()]
    why = "as text they would not be read beside the binary model"
    if there:  # they name cameras and images, and repeat the poses
        lenses, posed, unusable = read_model_cameras(model_dir)
        now, before = (
            {
                (im.image_id, im.name, im.intrinsics.camera_id): im.camera.cam_from_world
                for im in images
            }
            for images in (scene.images, posed)
        )
        complete = not unusable and all(lens.camera_id in cameras for lens in lenses)
        if (
            complete
            and now.keys() == before.keys()
            and all(
                np.allclose(now[key], before[key], rtol=_SAME_POSE, atol=_SAME_POSE) for key in now
            )
        ):
            return there, []
        why = "the scene no longer has the same cameras, images and poses"
    elif not any((model_dir / name).is_file() for name in ("rigs.txt", "frames.txt")):
        return [], []
    return [], [Finding("rigs-left-out", f"Rigs and frames were left out: {why}.")]


def without_zero_distortion(camera: Intrinsics) -> Intrinsics:
    """Return the camera as PINHOLE if all its coefficients are 0: some trainers need that model."""
    return camera if camera.has_distortion or camera.is_pinhole else camera.pinhole
