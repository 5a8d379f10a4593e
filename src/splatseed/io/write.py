"""Writing a scene that every 3D Gaussian Splatting trainer loads unchanged.

A *layout* is the set of files a trainer looks for: COLMAP's, or nerfstudio's ``transforms.json``;
image folders map a path inside an output to the folder or file it stands for. Promise: the folder
appears whole or not at all; its points are finite and distinct, in the scene's order in all files;
originals keep their float64 positions and tracks; point ids are 1..N. COLMAP's root holds no PLY,
because Brush loads any it finds there. docs/formats.md says which trainer needs which file.
"""

from __future__ import annotations

import errno
import os
import platform
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path, PurePath
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.errors import OutputError, PointCloudError
from splatseed.io import colmap, nerfstudio
from splatseed.io.cleaning import clean_scene, renumber
from splatseed.io.colmap_model import read_model_cameras
from splatseed.io.files import StrPath, open_file
from splatseed.io.frame_files import FrameFiles
from splatseed.io.mask_files import FOLDER as MASKS, find_masks
from splatseed.io.masks import write_masks
from splatseed.io.origin import write_offset
from splatseed.io.ply import write_ply
from splatseed.io.seeds import write_seeds
from splatseed.io.split import MODEL_LISTS, ROOT_LISTS
from splatseed.io.staging import ABSENT, MANIFEST, output_folder, write_json
from splatseed.scene import Scene, SceneSource

Layout = Literal["colmap", "transforms"]
Written = tuple[list[str], dict[str, Path], Float64[np.ndarray, " 3"]]
"""Of a layout: notes for the user, the image folders that belong to it, and the offset of its
space to the world."""

_KIND = "write_scene"
"""The kind of an output whose provenance names no verb."""
_PACKAGES = ("splatseed", "numpy", "scipy", "numba")
_ROOT_EXTRAS = ("poses_bounds.npy", "ext_metadata.json")  # gsplat's examples read them if present
_MODEL_EXTRAS = ("depth_params.json",)  # graphdeco's trainer reads it if present
_SAME_POSE = 1e-9  # relative and absolute; a pose that went through other formats is that near
_NERFSTUDIO_FROM_COLMAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]])
"""The ``applied_transform`` that nerfstudio gives a COLMAP model: (x, y, z) -> (x, z, -y)."""
_PATH_KEYS = ("file_path", "mask_path", "depth_file_path", "depth_path")
_LIST_KEYS = ("train_filenames", "val_filenames", "test_filenames")
_TERMS = {"OPENCV": ("k1", "k2", "p1", "p2"), "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
"""Nerfstudio's distortion terms, in the order of COLMAP's parameters."""
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
_FISHEYE = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
_MODELS = dict.fromkeys(_PERSPECTIVE, "OPENCV") | dict.fromkeys(_FISHEYE, "OPENCV_FISHEYE")
_SIBLINGS = tuple(
    f"{kind}{scale}" for kind in ("images", "masks", "depths") for scale in ("", "_2", "_4", "_8")
)
"""Folders in which trainers look for photographs, by the resolution they ask for."""


@dataclass(frozen=True)
class WriteReport:
    """What was written, and ``notes``: what the user should know, one sentence each.

    Points are dropped, on reading or here, because a coordinate is not finite or an earlier one has
    the same position. ``files`` are paths inside the folder; an image folder is named, not listed.
    """

    path: Path
    layout: Layout
    num_points: int
    num_original: int
    dropped_nonfinite: int
    dropped_duplicates: int
    files: tuple[str, ...]
    notes: tuple[str, ...]


def write_scene(
    scene: Scene,
    path: StrPath,
    *,
    format: Literal["auto", "colmap", "transforms"] = "auto",  # noqa: A002  (the user's word)
    overwrite: bool = False,
    copy_images: bool = False,
    provenance: Mapping[str, object] | None = None,
    require_points: bool = True,
) -> WriteReport:
    """Write a scene folder for training.

    Args:
        scene: What to write; originals first in its cloud.
        path: The folder to make.
        format: The layout; ``auto`` takes the one that was read, and COLMAP's for a bare PLY, an
            RGB-D capture or a scene made in memory.
        overwrite: Whether an earlier output of splatseed may be replaced.
        copy_images: Copy the image folders instead of linking them.
        provenance: How the points were made, for ``splatseed.json``.
        require_points: Whether a scene without any point is refused.

    Returns:
        What was written.

    Raises:
        OutputError: The folder is taken, protected or cannot be written, or the layout cannot hold
            the scene.
        PointCloudError: No point is finite, or there is none although ``require_points``.
    """
    path, layout, made = Path(path), _choose_layout(scene, format), dict(provenance or {})
    source, clean = scene.source, clean_scene(scene)  # one from load_scene is clean already
    required = require_points or bool(len(scene.points))
    if required and not len(clean.points):
        raise PointCloudError(
            "at least one point with finite coordinates",
            found=f"{len(scene.points)} points, none of them finite",
            fix="Check the cloud.",
        )
    inputs = source.inputs if source else ()
    kind = str(made.get("command", _KIND))
    with output_folder(path, kind=kind, overwrite=overwrite, protect=inputs) as folder:
        write_layout = _write_colmap if layout == "colmap" else _write_transforms
        notes, image_sources, offset = write_layout(clean, folder)
        write_offset(folder, offset)
        masks, photographs = clean.masks, source.image_dir if source else None
        if masks and photographs and _rewrites_masks(clean, layout):
            image_sources.pop(MASKS, None)
            alone = replace(masks, alpha=False)  # photographs keep their transparency
            names = [im.name for im in clean.images if (photographs / im.name).is_file()]
            write_masks(alone, photographs, names, folder / MASKS)
        linked = bring(image_sources, folder, copy=copy_images)
        tops = {PurePath(each).parts[0] for each in linked}
        own = [each for each in folder.rglob("*") if each.relative_to(folder).parts[0] not in tops]
        files = [each.relative_to(folder).as_posix() for each in own if not each.is_dir()]
        counts = {
            "num_points": len(clean.points),
            "num_original": clean.points.num_original,
            "dropped_nonfinite": clean.left_out.non_finite,
            "dropped_duplicates": clean.left_out.duplicates,
        }
        versions = {"python": platform.python_version()}
        for package in _PACKAGES:
            with suppress(PackageNotFoundError):  # splatseed itself may not be installed
                versions[package] = version(package)
        read = None
        if source is not None:
            bare = source.points_path if source.format == "ply" else source.root
            read = str(source.transforms_path or bare)
        num_new = counts["num_points"] - counts["num_original"]
        if scene.absent:  # so that the others train or test as before
            made[ABSENT] = list(scene.absent)
        facts = {"source": read, **made, "format": layout, **counts, "num_new": num_new}
        write_json(folder / MANIFEST, {**facts, "notes": notes, "versions": versions})
    return WriteReport(
        path, layout, **counts, files=tuple(sorted([*files, *linked, MANIFEST])), notes=tuple(notes)
    )


def _rewrites_masks(scene: Scene, layout: Layout) -> bool:
    """Whether masks must be written because linking the scene's own folder would not do."""
    masks, source = scene.masks, scene.source
    if masks is None or source is None or not masks.files:
        return False
    named = layout == "transforms" and masks.choice is None and _names_masks(source)
    folder = (source.root / MASKS).absolute()
    inside = all(folder in path.absolute().parents for path in masks.files.values())
    if inside and layout == "colmap":  # where masks are known by their names alone
        inside = find_masks([image.name for image in scene.images], folder)[0].keys() == (
            masks.files.keys()
        )
    return masks.inverted or not (inside or named)


def _names_masks(source: SceneSource) -> bool:
    """Whether the scene's own ``transforms.json`` names masks."""
    if source.transforms_path is None:
        return False
    frames = nerfstudio.read_transforms(source.transforms_path).frames
    return any(isinstance(frame.fields.get("mask_path"), str) for frame in frames)


def _name_masks(scene: Scene, frames: Sequence[dict[str, Any]], names: Sequence[str]) -> None:
    """Give each frame its ``mask_path``, if all have one: nerfstudio takes masks of all or none."""
    if scene.masks is None or scene.source is None:
        return
    files, root = scene.masks.files, scene.source.root
    rewrites = _rewrites_masks(scene, "transforms")
    for frame, name in zip(frames, names, strict=True):
        frame.pop("mask_path", None)
        if rewrites:
            frame["mask_path"] = f"{MASKS}/{name}.png"
        elif all(each in files for each in names):
            frame["mask_path"] = Path(os.path.relpath(files[name], root)).as_posix()


def _choose_layout(scene: Scene, wanted: str) -> Layout:
    if wanted == "auto":
        return "transforms" if scene.source and scene.source.format == "transforms" else "colmap"
    if wanted == "colmap":
        return "colmap"
    if wanted == "transforms" and scene.images:
        return "transforms"
    known = "a format of auto, colmap or transforms, which needs images"
    raise OutputError(known, found=repr(wanted), fix="Write the COLMAP layout (`format='colmap'`).")


def _write_colmap(scene: Scene, folder: Path) -> Written:
    """Write ``sparse/0``."""
    model_dir = folder / "sparse" / "0"
    model_dir.mkdir(parents=True)
    tracks, images, num_broken = renumber(scene)
    # The file's camera records, and those that only images have (in scenes made in memory).
    cameras = {camera.camera_id: camera for camera in scene.intrinsics}
    for image in scene.images:
        cameras.setdefault(image.intrinsics.camera_id, image.intrinsics)
    colmap.write_cameras(model_dir / "cameras.bin", tuple(map(_straight, cameras.values())))
    colmap.write_images(model_dir / "images.bin", images)
    colmap.write_points3d(model_dir / "points3D.bin", scene.points, tracks)
    write_ply(model_dir / "points3D.ply", scene.points)
    write_seeds(folder, scene.points)
    notes: list[str] = []
    source = scene.source
    if source is not None and source.model_dir is not None:
        rigs, notes = _rigs(scene, source.model_dir)
        _copy_files(source.root, _ROOT_EXTRAS, folder)
        _copy_files(source.model_dir, (*_MODEL_EXTRAS, *rigs), model_dir)
    if num_broken:
        notes.append(
            f"{num_broken:,} references between features and points were removed: the other side"
            " did not confirm them."
        )
    if not scene.images:
        notes.append(
            "The scene has no images, so it cannot be trained as it is: copy points3D.bin and"
            " points3D.ply from sparse/0 into sparse/0 of a copy of the full scene, and seeds.npz,"
            " if there is one, into that copy."
        )
    write_split(scene, folder)
    return notes, image_folders(scene), scene.offset


def write_split(scene: Scene, folder: Path) -> None:
    """Write the lists of a scene's split beside a COLMAP model: its own, else nerfstudio's."""
    if scene.source is not None:
        _copy_files(scene.source.root, ROOT_LISTS, folder)
        if scene.source.model_dir is not None:
            _copy_files(scene.source.model_dir, MODEL_LISTS, folder / "sparse" / "0")
    if scene.listed is None or any((folder / name).exists() for name in ROOT_LISTS):
        return
    train, test = scene.split()
    for part, images in zip(ROOT_LISTS, (train, test, test), strict=False):  # val: test, too
        text = "".join(f"{image.name}\n" for image in images)
        (folder / part).write_text(text, "utf-8")


def _copy_files(source: Path, names: Sequence[str], target: Path) -> None:
    for name in names:
        if (source / name).is_file():
            shutil.copyfile(source / name, target / name)


def _rigs(scene: Scene, model_dir: Path) -> tuple[list[str], list[str]]:
    """The model's rigs and frames if they are valid for the output, else a note saying why not."""
    there = [name for name in ("rigs.bin", "frames.bin") if (model_dir / name).is_file()]
    why = "as text they would not be read beside the binary model"
    if there:  # they repeat the poses of the images
        now, before = (
            {
                (im.image_id, im.name, im.intrinsics.camera_id): im.camera.cam_from_world
                for im in images
            }
            for images in (scene.images, read_model_cameras(model_dir)[1])
        )
        if now.keys() == before.keys() and all(
            np.allclose(now[key], before[key], rtol=_SAME_POSE, atol=_SAME_POSE) for key in now
        ):
            return there, []
        why = "the scene no longer has the same images and poses"
    elif not any((model_dir / name).is_file() for name in ("rigs.txt", "frames.txt")):
        return [], []
    return [], [f"Rigs and frames were left out: {why}."]


def _write_transforms(scene: Scene, folder: Path) -> Written:
    """Write ``transforms.json`` and its PLY."""
    source, points, offset = scene.source, scene.points, scene.offset
    if source is not None and source.transforms_path is not None:
        names = {image.name for image in scene.images}
        transforms = nerfstudio.read_transforms(source.transforms_path)
        content = _kept_json(transforms, names)
        if scene.origin.any():
            content = _moved_json(content, scene.origin)
        chosen = scene.masks is not None and scene.masks.choice is not None
        if chosen or _rewrites_masks(scene, "transforms"):
            pairs = list(zip(transforms.images, transforms.frames, strict=True))
            for key, tests in (("frames", False), ("test_frames", True)):
                kept = [i.name for i, f in pairs if i.name in names and f.is_test == tests]
                _name_masks(scene, content.get(key, ()), kept)
        frames = (*content["frames"], *content.get("test_frames", ()))
        found = (frame.get(key) for frame in frames for key in _PATH_KEYS)
        paths = [each for each in found if isinstance(each, str) and not Path(each).is_absolute()]
        if source.image_dir is not None and source.image_dir.resolve() == source.root.resolve():
            paths += names  # a frame's own path may lack the extension
        # The first folders of relative paths, so that these resolve.
        firsts = {first: source.root / first for first in _first_folders(paths)}
        folders = {**_siblings(source.root), **firsts}
    else:
        A = None if source and source.format == "transforms" else _NERFSTUDIO_FROM_COLMAP
        content, folders = _new_json(scene, A), image_folders(scene)
        _name_masks(scene, content["frames"], [image.name for image in scene.images])
        if A is not None:
            xyz = nerfstudio.apply_transform(A, points.xyz).astype(np.float32)
            normals = None if points.normals is None else points.normals @ A[:, :3].T
            points, offset = points.replace(xyz=xyz, normals=normals), A[:, :3] @ offset
    write_json(folder / "transforms.json", {**content, "ply_file_path": "sparse_pc.ply"})
    write_ply(folder / "sparse_pc.ply", points)
    shutil.copyfile(folder / "sparse_pc.ply", folder / "pointcloud.ply")  # LichtFeld's name for it
    write_seeds(folder, points)
    if source is not None:
        _copy_files(source.root, ROOT_LISTS, folder)
    return [], folders, offset


def _new_json(scene: Scene, A: Float64[np.ndarray, "3 4"] | None) -> dict[str, Any]:
    """A new ``transforms.json``, poses turned by A; images are ``images/NAME``."""
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
        pose = image.camera.world_from_cam @ nerfstudio.OPENCV_FROM_OPENGL
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


def _straight(camera: Intrinsics) -> Intrinsics:
    """The camera as PINHOLE if it has no distortion, as some trainers refuse other models."""
    return camera if camera.has_distortion or camera.is_pinhole else camera.pinhole


def _camera_fields(camera: Intrinsics) -> dict[str, Any]:
    """The fields of one camera record, under nerfstudio's names."""
    camera = _straight(camera)
    model = _MODELS.get(camera.model)
    if model is None:
        raise OutputError(
            "cameras that transforms.json can express",
            found=f"camera {camera.camera_id} of model {camera.model}",
            fix="Undistort the scene first (splatseed undistort), or write the COLMAP layout.",
        )
    terms = camera.params[CAMERA_MODELS[camera.model].num_focal + 2 :]
    matrix = camera.K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    fields = {"camera_model": model, "w": camera.width, "h": camera.height}
    fields |= zip(("fl_x", "fl_y", "cx", "cy"), matrix, strict=True)
    return fields | dict(zip(_TERMS[model], (*terms, 0.0, 0.0, 0.0, 0.0), strict=False))


def _kept_json(transforms: nerfstudio.Transforms, names: Collection[str]) -> dict[str, Any]:
    """The file's content, with only the named images, for use in another folder."""
    root, content = transforms.path.parent, transforms.json
    files = FrameFiles(transforms.path)
    finders = dict(
        zip(_PATH_KEYS, (files.photograph, files.mask, *[files.depth_map] * 2), strict=True)
    )

    def portable(path: Any, key: str = "file_path") -> Any:
        """A path that leads to the same file from another folder, on this computer."""
        if not isinstance(path, str):
            return path
        found, plain = finders[key](path), Path(os.path.abspath(root / path))  # noqa: PTH100
        if found and found.path not in (plain, plain.with_name(plain.name + found.path.suffix)):
            path = Path(os.path.relpath(found.path, root)).as_posix()
        if os.path.normpath(path).startswith(".."):
            return os.path.abspath(root / path)  # noqa: PTH100  (resolve would follow links)
        return path

    frames: dict[bool, list[dict[str, Any]]] = {False: [], True: []}
    used = set()
    for frame, image in zip(transforms.frames, transforms.images, strict=True):
        if image.name in names:
            fields = frame.fields
            moved = {key: portable(fields[key], key) for key in _PATH_KEYS if key in fields}
            frames[frame.is_test].append({**fields, **moved})
            used.add(os.path.normpath(str(fields["file_path"])))
    all_of = (*content["frames"], *(f.fields for f in transforms.frames if f.is_test))
    gone = {os.path.normpath(str(frame.get("file_path"))) for frame in all_of} - used
    lists: dict[str, list[Any]] = {}
    for key in (key for key in _LIST_KEYS if isinstance(content.get(key), list)):
        listed = [name for name in content[key] if isinstance(name, str)]
        # Nerfstudio fails over names that no frame has.
        lists[key] = [portable(name) for name in listed if os.path.normpath(name) not in gone]
    kept = {key: value for key, value in content.items() if key != "test_frames"}
    tests = {"test_frames": frames[True]} if frames[True] else {}
    return {**kept, **lists, "frames": frames[False], **tests}


def _moved_json(content: dict[str, Any], offset: Float64[np.ndarray, " 3"]) -> dict[str, Any]:
    """The content with an offset subtracted from the space of its poses."""

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


def image_folders(scene: Scene) -> dict[str, Path]:
    """The source of ``images/`` and its siblings in a scene folder."""
    source = scene.source
    if source is None or not scene.images:
        return {}
    folders = _siblings(source.root)
    if source.image_dir is None:
        return folders
    if source.image_dir.resolve() != source.root.resolve():
        return {**folders, "images": source.image_dir}
    folders.pop("images", None)
    names = [n for n in (image.name for image in scene.images) if _first_folders([n])]
    # One by one: gsplat's examples do not enter a linked folder within images.
    return {**folders, **{f"images/{name}": source.image_dir / name for name in names}}


def _first_folders(paths: Iterable[str]) -> list[str]:
    """The first part of each path; those that lead elsewhere (absolute, ``..``) have none."""
    pure = (PurePath(path) for path in paths)
    firsts = {path.parts[0] for path in pure if path.parts and not path.anchor}
    return sorted(firsts - {".."})


def _siblings(root: Path) -> dict[str, Path]:
    return {name: root / name for name in _SIBLINGS if (root / name).is_dir()}


def bring(folders: Mapping[str, Path], output: Path, *, copy: bool) -> list[str]:
    """Link or copy image folders into ``output``; missing ones are left out."""
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
