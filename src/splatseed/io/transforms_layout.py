"""Nerfstudio's layout of an output, ``transforms.json`` and its PLY, alone or beside COLMAP's."""

from __future__ import annotations

import os
import shutil
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path, PurePath
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError
from splatseed.findings import Finding
from splatseed.io import nerfstudio
from splatseed.io.camera_records import OPENCV_FROM_OPENGL
from splatseed.io.colmap_layout import Written, without_zero_distortion, write_colmap_layout
from splatseed.io.files import absolute, read_json
from splatseed.io.frame_files import Found, FrameFiles
from splatseed.io.image_folders import (
    copy_files,
    first_folders,
    image_folders,
    photographs_hidden,
    sibling_folders,
)
from splatseed.io.mask_files import FOLDER as MASKS, find_masks
from splatseed.io.ply import write_ply
from splatseed.io.seeds import write_seeds
from splatseed.io.split import ROOT_LISTS
from splatseed.io.staging import write_json
from splatseed.scene import Scene, SceneSource

Layout = Literal["colmap", "transforms", "both"]
_NERFSTUDIO_FROM_COLMAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""The ``applied_transform`` that nerfstudio gives a COLMAP model: (x, y, z) -> (x, z, -y)."""
_PATH_KEYS = ("file_path", "mask_path", "depth_file_path", "depth_path")
_FIELDS = ("w", "h", "fl_x", "fl_y", "cx", "cy")
_LIST_KEYS = ("train_filenames", "val_filenames", "test_filenames")
_TERMS = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
"""Nerfstudio's distortion terms, in the order of COLMAP's parameters."""
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MODELS = dict.fromkeys(_PERSPECTIVE, "OPENCV") | dict.fromkeys(_FISHEYE, "OPENCV_FISHEYE")


class _Plan(NamedTuple):
    """What a ``transforms.json`` will hold, before masks are named, and the folders it names."""

    content: dict[str, Any]
    folders: dict[str, Path]
    transform: Float64[np.ndarray, "3 4"] | None = None  # of a new file's world


def write_transforms_layout(scene: Scene, folder: Path) -> Written:
    """Write ``transforms.json`` and its PLY into an output."""
    return _write(scene, folder, _plan(scene), "transforms")


def write_both_layouts(scene: Scene, folder: Path) -> tuple[Written, Layout]:
    """Write a scene from a ``transforms.json`` in both layouts, in one world.

    Readers of COLMAP models find ``sparse/0`` and ``images``, the others ``transforms.json``. If
    both cannot be in one folder, ``transforms.json`` is written alone, with a finding.
    """
    plan, folders = _plan(scene), image_folders(scene)
    if obstacle := _obstacle(scene, plan.folders, folders):
        _, linked, offset = _write(scene, folder, plan, "transforms")
        text = f"COLMAP's layout was left out: {obstacle}."
        return ([Finding("layout-left-out", text)], linked, offset), "transforms"
    _, linked, offset = _write(scene, folder, plan, "both")
    findings, folders, _ = write_colmap_layout(scene, folder)
    return (findings, {**linked, **folders}, offset), "both"


def _obstacle(scene: Scene, named: Mapping[str, Path], folders: Mapping[str, Path]) -> str:
    """Say why the folders of both layouts cannot be in one folder; empty if they can."""
    for name, path in folders.items():
        top = PurePath(name).parts[0]
        taken = named.get(name) or named.get(top)
        if taken is not None and (top != name or taken.resolve() != path.resolve()):
            return f"its folder {top} would hold other files than the {top} of transforms.json"
    return photographs_hidden({**named, **folders}, scene)


def _plan(scene: Scene) -> _Plan:
    source = scene.source
    if source.transforms_path is None:
        A = None if source.format == "transforms" else _NERFSTUDIO_FROM_COLMAP
        return _Plan(_new_json(scene, A), image_folders(scene), A)
    names, root = {image.name for image in scene.images}, source.transforms_path.parent
    content = _kept_json(nerfstudio.read_transforms(source.transforms_path), names)
    if scene.masks is None:
        _drop_mask_paths(content)
    if scene.origin.any():
        content = _moved_json(content, scene.origin)
    frames = (*content["frames"], *content.get("test_frames", ()))
    found = (frame.get(key) for frame in frames for key in _PATH_KEYS)
    paths = [each for each in found if isinstance(each, str) and not Path(each).is_absolute()]
    if source.image_dir is not None and source.image_dir.resolve() == root.resolve():
        paths += names  # a frame's own path may lack the extension
    # The first folders of relative paths, so that these resolve.
    firsts = {first: root / first for first in first_folders(paths)}
    return _Plan(content, {**sibling_folders(scene), **firsts})


def _write(scene: Scene, folder: Path, plan: _Plan, layout: Layout) -> Written:
    source, points, offset, (content, folders, A) = scene.source, scene.points, scene.offset, plan
    if source.transforms_path is None:
        _name_masks(scene, content["frames"], [image.name for image in scene.images], layout)
    elif (scene.masks is not None and scene.masks.choice is not None) or rewrites_masks(
        scene, layout
    ):
        names = {image.name for image in scene.images}
        transforms = nerfstudio.read_transforms(source.transforms_path)
        pairs = list(zip(transforms.images, transforms.frames, strict=True))
        for key, tests in (("frames", False), ("test_frames", True)):
            kept = [i.name for i, f in pairs if i.name in names and f.is_test == tests]
            _name_masks(scene, content.get(key, ()), kept, layout)
    if A is not None:
        xyz = nerfstudio.apply_transform(A, points.xyz).astype(np.float32)
        normals = None if points.normals is None else points.normals @ A[:, :3].T
        points, offset = points.replace(xyz=xyz, normals=normals), A[:, :3] @ offset
    write_json(folder / "transforms.json", {**content, "ply_file_path": "sparse_pc.ply"})
    write_ply(folder / "sparse_pc.ply", points)
    shutil.copyfile(folder / "sparse_pc.ply", folder / "pointcloud.ply")  # LichtFeld's name for it
    write_seeds(folder, points)
    copy_files(source.root, ROOT_LISTS, folder)
    return [], folders, offset


def _new_json(scene: Scene, A: Float64[np.ndarray, "3 4"] | None) -> dict[str, Any]:
    used = {image.intrinsics.camera_id: image.intrinsics for image in scene.images}
    cameras = {camera_id: _camera_fields(camera) for camera_id, camera in used.items()}
    models = sorted({fields["camera_model"] for fields in cameras.values()})
    if len(models) > 1:  # nerfstudio takes one for all
        raise OutputError(
            "cameras of one kind, for transforms.json",
            found=" and ".join(models),
            fix="Undistort the scene first (splatseed undistort), or write the COLMAP layout.",
        )
    shared = next(iter(cameras.values()), {})
    if len(used) != 1:
        shared = {"camera_model": shared.get("camera_model", "OPENCV")}
    frames = []
    for image in scene.images:
        pose = image.camera.world_from_cam @ OPENCV_FROM_OPENGL
        if A is not None:
            pose[:3] = A @ pose
        own = {} if len(used) == 1 else cameras[image.intrinsics.camera_id]
        frame = {"file_path": f"images/{image.name}", "transform_matrix": pose.tolist()}
        frames.append({**frame, "colmap_im_id": image.image_id, **own})
    content = {**shared, "frames": frames}
    if A is not None:
        content["applied_transform"] = A.tolist()
    if scene.listed is not None:
        train, test = ([f"images/{image.name}" for image in part] for part in scene.split())
        content |= {"train_filenames": train, "test_filenames": test, "val_filenames": test}
    return content


def _camera_fields(camera: Intrinsics) -> dict[str, Any]:
    camera = without_zero_distortion(camera)
    model = _MODELS.get(camera.model)
    if model is None:
        raise OutputError(
            "cameras that transforms.json can express",
            found=f"camera {camera.camera_id} of model {camera.model}",
            fix="Undistort the scene first (splatseed undistort), or write the COLMAP layout.",
        )
    terms = camera.params[CAMERA_MODELS[camera.model].num_focal + 2 :]
    fields = {"camera_model": model, "w": camera.width, "h": camera.height}
    fields |= zip(_FIELDS[2:], camera.pinhole.params, strict=True)
    return fields | dict(zip(_TERMS[model], (*terms, 0.0, 0.0, 0.0, 0.0), strict=False))


def _kept_json(transforms: nerfstudio.Transforms, names: Collection[str]) -> dict[str, Any]:
    """Return a file's content for another folder, with the named images only."""
    root, content = transforms.path.parent, transforms.json
    files = FrameFiles(transforms.path)
    finders = (files.photographs, files.masks, files.depth_maps, files.depth_maps)
    found = {
        key: find(_named(transforms, key)) for key, find in zip(_PATH_KEYS, finders, strict=True)
    }

    def portable(path: Any, there: Mapping[str, Found]) -> Any:
        """Return a path to the same file from another folder of this computer."""
        if not isinstance(path, str):
            return path
        file, plain = there.get(path), absolute(root / path)
        if file and file.path != plain:  # without its suffix, say, which nerfstudio needs
            path = Path(os.path.relpath(file.path, root)).as_posix()
        if os.path.normpath(path).startswith(".."):
            return str(absolute(root / path))
        return path

    frames: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    used, shared = set(), _shared_by_all(content, transforms.intrinsics)
    for frame, image in zip(transforms.frames, transforms.images, strict=True):
        if image.name in names:
            fields = frame.fields
            moved = {key: portable(fields[key], found[key]) for key in _PATH_KEYS if key in fields}
            missing = _missing_fields({**shared, **fields}, image.intrinsics)
            frames[frame.is_test].append({**fields, **moved, **missing})
            used.add(os.path.normpath(str(fields["file_path"])))
    all_of = (*content["frames"], *(f.fields for f in transforms.frames if f.is_test))
    gone = {os.path.normpath(str(frame.get("file_path"))) for frame in all_of} - used
    lists: dict[str, list[Any]] = {}
    for key in (key for key in _LIST_KEYS if isinstance(content.get(key), list)):
        listed = [name for name in content[key] if isinstance(name, str)]
        # Nerfstudio fails over names that no frame has.
        kept_names = [name for name in listed if os.path.normpath(name) not in gone]
        lists[key] = [portable(name, files.photographs([name])) for name in kept_names]
    kept = {key: value for key, value in shared.items() if key != "test_frames"}
    tests = {"test_frames": frames[True]} if frames[True] else {}
    _rename_models(kept, [*frames[False], *frames[True]])
    return {**kept, **lists, "frames": frames[False], **tests}


def _rename_models(shared: dict[str, Any], frames: Sequence[dict[str, Any]]) -> None:
    """Name lens models as nerfstudio writes them, since Brush knows no others.

    A perspective lens is OPENCV, one without distortion has terms of 0: its own, and not those of
    other frames. Frames keep theirs, which nerfstudio ignores beside shared ones.
    """
    stated = {*nerfstudio.DISTORTION, "distortion_params"}
    for each in (shared, *(frame for frame in frames if frame.keys() & nerfstudio.LENS_MODELS)):
        model = nerfstudio.lens_model(each)
        own = each is shared and any(frame.keys() & stated for frame in frames)
        if model in nerfstudio.UNDISTORTED and not own:
            terms = {*_TERMS["OPENCV"], *(shared.keys() & {*nerfstudio.DISTORTION})}
            each.update({term: each.get(term) or 0.0 for term in sorted(terms)})
        each["camera_model"] = model if model in _TERMS else "OPENCV"


def _named(transforms: nerfstudio.Transforms, key: str) -> list[str]:
    names = (frame.fields.get(key) for frame in transforms.frames)
    return [name for name in names if isinstance(name, str)]


def _missing_fields(fields: Mapping[str, Any], camera: Intrinsics) -> dict[str, float]:
    """Return the size, focal lengths and principal point that a frame and its file lack.

    nerfstudio and OpenSplat need them, and ``camera_model``, where others take ``camera_angle_x``
    and the middle of the photograph.
    """
    known = _fields_of(camera).items()
    return {name: value for name, value in known if fields.get(name) is None}


def _fields_of(camera: Intrinsics) -> dict[str, float]:
    values = camera.width, camera.height, *camera.pinhole.params
    return dict(zip(_FIELDS, values, strict=True))


def _shared_by_all(content: Mapping[str, Any], cameras: Sequence[Intrinsics]) -> dict[str, Any]:
    """Return a file's content without fields that some of its frames replace.

    nerfstudio takes them for all frames, whatever these state.
    """
    known = [_fields_of(camera) for camera in cameras]
    replaced = {
        name
        for name in _FIELDS
        if any(content.get(name) not in (None, each[name]) for each in known)
    }
    return {key: value for key, value in content.items() if key not in replaced}


def _moved_json(content: dict[str, Any], offset: Float64[np.ndarray, " 3"]) -> dict[str, Any]:
    """Subtract an offset from the poses of a file's content."""

    def moved(rows: Sequence[Sequence[float]]) -> list[list[float]]:
        matrix = np.array(rows, np.float64)
        matrix[:3, 3] -= offset
        return [[float(value) for value in row] for row in matrix]

    key = "transform_matrix"
    more: dict[str, Any] = {
        name: [{**frame, key: moved(frame[key])} for frame in content[name]]
        for name in ("frames", "test_frames")
        if name in content
    }
    if content.get("applied_transform") is not None:
        more["applied_transform"] = moved(content["applied_transform"])
    return {**content, **more}


def rewrites_masks(scene: Scene, layout: Layout) -> bool:
    """Whether masks must be written, as the scene's own folder cannot be linked."""
    masks, source = scene.masks, scene.source
    if masks is None or source.root is None or not masks.files:
        return False
    named = layout == "transforms" and masks.choice is None and _names_masks(source)
    folder = (source.root / MASKS).absolute()
    inside = all(folder in path.absolute().parents for path in masks.files.values())
    if inside and layout != "transforms":  # where masks are known by their names alone
        inside = find_masks([image.name for image in scene.images], folder)[0].keys() == (
            masks.files.keys()
        )
    return masks.inverted or not (inside or named)


def forget_masks(folder: Path) -> None:
    """Name no masks in an output's ``transforms.json``, as it has none."""
    path = folder / "transforms.json"
    content = read_json(path)
    _drop_mask_paths(content)
    write_json(path, content)


def _drop_mask_paths(content: Mapping[str, Any]) -> None:
    for frame in (*content["frames"], *content.get("test_frames", ())):
        frame.pop("mask_path", None)


def _names_masks(source: SceneSource) -> bool:
    if source.transforms_path is None:
        return False
    frames = nerfstudio.read_transforms(source.transforms_path).frames
    return any(isinstance(frame.fields.get("mask_path"), str) for frame in frames)


def _name_masks(
    scene: Scene, frames: Sequence[dict[str, Any]], names: Sequence[str], layout: Layout
) -> None:
    """Set ``mask_path`` if all frames have a mask: nerfstudio takes masks of all or none."""
    root = scene.source.root
    if scene.masks is None or root is None:
        return
    files = scene.masks.files
    rewrites = rewrites_masks(scene, layout)
    for frame, name in zip(frames, names, strict=True):
        frame.pop("mask_path", None)
        if rewrites:
            frame["mask_path"] = f"{MASKS}/{name}.png"
        elif all(each in files for each in names):
            frame["mask_path"] = Path(os.path.relpath(files[name], root)).as_posix()
