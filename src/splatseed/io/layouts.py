"""The two sets of files that trainers look for: COLMAP's, and nerfstudio's ``transforms.json``.

Notation: image folders map a path inside an output to the folder or file it stands for. Promise:
every point file in a layout holds the scene's points in their order, ``seeds.npz`` too; COLMAP's
root holds no PLY, because Brush loads any it finds there; a ``transforms.json`` that was read keeps
all its fields, a new one has those that nerfstudio's own conversion of a COLMAP model writes, which
OpenSplat, Brush and LichtFeld Studio read too; photographs are linked, or copied where links are
not wanted or not possible. Writers write straight into ``folder`` and let ``OSError`` pass.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError
from splatseed.io.colmap import binary as colmap_binary
from splatseed.io.colmap.model import renumber
from splatseed.io.colmap.scene import read_model_cameras
from splatseed.io.files import open_file
from splatseed.io.nerfstudio import (
    OPENCV_FROM_OPENGL,
    Transforms,
    apply_transform,
    read_transforms,
)
from splatseed.io.ply import write_ply
from splatseed.io.seeds import write_seeds
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS, split_fields
from splatseed.io.staging import write_json
from splatseed.scene import Scene

_ROOT_EXTRAS = ("poses_bounds.npy", "ext_metadata.json")  # gsplat's examples read them if present
_MODEL_EXTRAS = ("depth_params.json",)  # graphdeco's trainer reads it if present
_RIG_FILES = ("rigs", "frames")
_SAME_POSE = 1e-9  # relative and absolute; a pose that went through other formats is that near
_NERFSTUDIO_FROM_COLMAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""The ``applied_transform`` that nerfstudio gives a COLMAP model: (x, y, z) -> (x, z, -y)."""
_PATH_KEYS = ("file_path", "mask_path", "depth_file_path")
_LIST_KEYS = ("train_filenames", "val_filenames", "test_filenames")
_TERMS = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
"""Nerfstudio's distortion terms, in the order of COLMAP's parameters."""
_NERFSTUDIO_MODELS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "OPENCV"),
    **dict.fromkeys(
        ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), "OPENCV_FISHEYE"
    ),
}
_SIBLINGS = tuple(
    f"{kind}{scale}" for kind in ("images", "masks", "depths") for scale in ("", "_2", "_4", "_8")
)
"""Folders in which trainers look for photographs, by the resolution they ask for."""


def write_colmap(scene: Scene, folder: Path) -> tuple[list[str], dict[str, Path]]:
    """Write ``sparse/0``; returns notes for the user and the image folders that belong to it."""
    model_dir = folder / "sparse" / "0"
    model_dir.mkdir(parents=True)
    model = renumber(scene)
    # The file's camera records, and those that only images have (in scenes made in memory).
    cameras = {camera.camera_id: camera for camera in scene.intrinsics}
    for image in scene.images:
        cameras.setdefault(image.intrinsics.camera_id, image.intrinsics)
    colmap_binary.write_cameras(model_dir / "cameras.bin", tuple(cameras.values()))
    colmap_binary.write_images(model_dir / "images.bin", model.images)
    colmap_binary.write_points3d(model_dir / "points3D.bin", scene.points, model.tracks)
    write_ply(model_dir / "points3D.ply", scene.points)
    write_seeds(folder, scene.points)
    notes: list[str] = []
    source = scene.source
    if source is not None and source.model_dir is not None:
        rigs, notes = _rigs(scene, source.model_dir)
        _copy_files(source.root, _ROOT_EXTRAS, folder)
        _copy_files(source.model_dir, (*_MODEL_EXTRAS, *rigs), model_dir)
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
    write_split(scene, folder)
    return notes, image_folders(scene)


def write_split(scene: Scene, folder: Path) -> None:
    """Write the lists of a scene's split beside a COLMAP model: its own, else nerfstudio's.

    Args:
        scene: The scene.
        folder: The folder that holds ``sparse/0``.

    Raises:
        OSError: A list cannot be written.
    """
    if scene.source is not None:
        _copy_files(scene.source.root, ROOT_LISTS, folder)
        if scene.source.model_dir is not None:
            _copy_files(scene.source.model_dir, MODEL_LISTS, folder / "sparse" / "0")
    if scene.listed is None or any((folder / name).exists() for name in ROOT_LISTS):
        return
    for part, images in zip(ROOT_LISTS, scene.split(), strict=False):  # train and test
        text = "".join(f"{image.name}\n" for image in images)
        (folder / part).write_text(text, "utf-8")


def _copy_files(source: Path, names: Sequence[str], target: Path) -> None:
    for name in names:
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)


def _rigs(scene: Scene, model_dir: Path) -> tuple[list[str], list[str]]:
    """The model's rigs and frames if they are valid for the output, else a note saying why not."""
    there = [f"{name}.bin" for name in _RIG_FILES if (model_dir / f"{name}.bin").is_file()]
    if there:
        # They repeat the poses of the images.
        now, before = (
            {(im.image_id, im.name): im.camera.cam_from_world for im in images}
            for images in (scene.images, read_model_cameras(model_dir)[1])
        )
        if now.keys() == before.keys() and all(
            np.allclose(now[key], before[key], rtol=_SAME_POSE, atol=_SAME_POSE) for key in now
        ):
            return there, []
        why = "the scene no longer has the same images and poses"
    elif any((model_dir / f"{name}.txt").is_file() for name in _RIG_FILES):
        why = "as text they would not be read beside the binary model"
    else:
        return [], []
    return [], [f"Rigs and frames were left out: {why}."]


def write_transforms(scene: Scene, folder: Path) -> tuple[list[str], dict[str, Path]]:
    """Write ``transforms.json`` and its PLY; returns notes and the image folders it names.

    Raises:
        OutputError: A camera model has no counterpart in nerfstudio.
    """
    source, points = scene.source, scene.points
    if source is not None and source.transforms_path is not None:
        names = {image.name for image in scene.images}
        content = _kept_json(read_transforms(source.transforms_path), names)
        found = (frame.get(key) for frame in content["frames"] for key in _PATH_KEYS)
        paths = [each for each in found if isinstance(each, str) and not Path(each).is_absolute()]
        if source.image_dir is not None and source.image_dir.resolve() == source.root.resolve():
            paths += names  # a frame's own path may lack the extension
        # The first folders of relative paths, so that these resolve.
        firsts = {first: source.root / first for first in _first_folders(paths)}
        folders = {**_siblings(source.root), **firsts}
    else:
        turned = source is None or source.format != "transforms"
        A = _NERFSTUDIO_FROM_COLMAP if turned else None
        content = {**_new_json(scene, A), **split_fields(scene)}
        folders = image_folders(scene)
        if A is not None:
            points = points.replace(xyz=apply_transform(A, points.xyz).astype(np.float32))
            if points.normals is not None:
                points = points.replace(normals=points.normals @ A[:, :3].T)
    write_json(folder / "transforms.json", {**content, "ply_file_path": "sparse_pc.ply"})
    write_ply(folder / "sparse_pc.ply", points)
    shutil.copyfile(folder / "sparse_pc.ply", folder / "pointcloud.ply")  # LichtFeld's name for it
    write_seeds(folder, points)
    if source is not None:
        _copy_files(source.root, ROOT_LISTS, folder)
    return [], folders


def _new_json(scene: Scene, A: Float64[np.ndarray, "3 4"] | None) -> dict[str, Any]:
    """A new ``transforms.json``, poses turned by A; images are ``images/NAME``."""
    used = {image.intrinsics.camera_id: image.intrinsics for image in scene.images}
    cameras = {camera_id: _camera_fields(camera) for camera_id, camera in used.items()}
    first = next(iter(cameras.values()), {})
    shared = first if len(used) == 1 else {"camera_model": first.get("camera_model", "OPENCV")}
    frames = []
    for image in scene.images:
        pose = image.camera.world_from_cam @ OPENCV_FROM_OPENGL
        if A is not None:
            pose[:3] = A @ pose
        frames.append(
            {
                "file_path": f"images/{image.name}",
                "transform_matrix": pose.tolist(),
                "colmap_im_id": image.image_id,
                **({} if len(used) == 1 else cameras[image.intrinsics.camera_id]),
            }
        )
    applied = {} if A is None else {"applied_transform": A.tolist()}
    return {**shared, "frames": frames, **applied}


def _camera_fields(camera: Intrinsics) -> dict[str, Any]:
    """The fields of one camera record, under nerfstudio's names."""
    model = _NERFSTUDIO_MODELS.get(camera.model)
    if model is None:
        raise OutputError(
            "cameras that transforms.json can express",
            found=f"camera {camera.camera_id} of model {camera.model}",
            fix="Undistort the scene first (splatseed undistort), or write the COLMAP layout.",
        )
    terms = camera.params[CAMERA_MODELS[camera.model].num_focal + 2 :]
    matrix = camera.K
    return {
        "camera_model": model,
        "w": camera.width,
        "h": camera.height,
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        **dict(zip(_TERMS[model], (*terms, 0.0, 0.0, 0.0, 0.0), strict=False)),
    }


def _kept_json(transforms: Transforms, names: Collection[str]) -> dict[str, Any]:
    """The file's content, with only the named images, for use in another folder.

    Paths that lead out of the file's folder become absolute; everything else stays.
    """
    root, content = transforms.path.parent, transforms.json

    def portable(path: Any) -> Any:
        if isinstance(path, str) and os.path.normpath(path).startswith(".."):
            return os.path.abspath(root / path)  # noqa: PTH100  (resolve would follow links)
        return path

    frames, gone = [], set()
    for frame, image in zip(content["frames"], transforms.images, strict=True):
        if image.name in names:
            moved = {key: portable(frame[key]) for key in _PATH_KEYS if key in frame}
            frames.append({**frame, **moved})
        else:
            gone.add(os.path.normpath(str(frame["file_path"])))
    # Nerfstudio fails over names that no frame has.
    lists = {
        key: [
            portable(name)
            for name in content[key]
            if isinstance(name, str) and os.path.normpath(name) not in gone
        ]
        for key in _LIST_KEYS
        if isinstance(content.get(key), list)
    }
    return {**content, **lists, "frames": frames}


def image_folders(scene: Scene) -> dict[str, Path]:
    """The source of ``images/`` and its siblings in a scene folder.

    Images that lie in the scene's own root, between other files, are linked by their first folder
    (or one by one).
    """
    source = scene.source
    if source is None or not scene.images:
        return {}
    folders = _siblings(source.root)
    if source.image_dir is None:
        return folders
    if source.image_dir.resolve() != source.root.resolve():
        return {**folders, "images": source.image_dir}
    firsts = _first_folders(image.name for image in scene.images)
    return {
        **{name: path for name, path in folders.items() if name != "images"},
        **{f"images/{first}": source.image_dir / first for first in firsts},
    }


def bring(folders: Mapping[str, Path], output: Path, *, copy: bool) -> list[str]:
    """Link or copy image folders into ``output``; missing ones are left out.

    Returns:
        The paths inside ``output`` that were made.

    Raises:
        OSError: Neither worked.
    """
    present = {name: source for name, source in folders.items() if source.exists()}
    around = output.resolve().parent
    for name, source in present.items():
        target = output / name
        target.parent.mkdir(parents=True, exist_ok=True)
        goal = source.resolve()
        # Relative if output and source are siblings, to move together.
        if around in goal.parents and around != Path(around.anchor):
            goal = Path(os.path.relpath(goal, target.parent.resolve()))
        if not copy:
            with suppress(OSError, NotImplementedError):  # a file system or system without links
                target.symlink_to(goal, target_is_directory=source.is_dir())
        if not target.is_symlink():
            _copy(source.resolve(), target)
    return sorted(present)


def _first_folders(paths: Iterable[str]) -> list[str]:
    """The first part of each path; those that lead elsewhere (absolute, ``..``) have none."""
    pure = (PurePath(path) for path in paths)
    firsts = {path.parts[0] for path in pure if path.parts and not path.anchor}
    return sorted(firsts - {".."})


def _siblings(root: Path) -> dict[str, Path]:
    return {name: root / name for name in _SIBLINGS if (root / name).is_dir()}


def _copy(source: Path, target: Path) -> None:
    """Copy contents without modes: a copy of a read-only folder could not be removed again."""
    if not source.is_dir():
        with open_file(source) as file, target.open("xb") as copy:
            shutil.copyfileobj(file, copy)
        return
    above = {source.resolve(), *source.resolve().parents}
    target.mkdir()
    for each in source.iterdir():
        if each.is_dir() and each.resolve() in above:
            raise OSError(errno.ELOOP, "a link that leads back into itself", str(each))
        _copy(each, target / each.name)
