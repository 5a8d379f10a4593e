"""COLMAP models: which folder holds a scene's, and the scene that it makes.

A model is a folder with cameras, images and points3D, each as .bin, else .txt. COLMAP's mapper
writes a model for each group of photographs that it could connect, into folders ``0``, ``1`` and so
on, which are not ordered by size: the one with the most images is read.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Float64

from splatseed.camera import Intrinsics
from splatseed.errors import SceneNotFoundError, SplatseedError
from splatseed.findings import Finding, Severity
from splatseed.io.camera_records import Unusable, check_enough, unusable_findings, unusable_images
from splatseed.io.colmap import MIN_IMAGE_BYTES, read_cameras, read_images, read_points3d
from splatseed.io.files import StrPath, is_data, is_hidden, numbered_lines, open_file
from splatseed.io.image_names import named_as_files
from splatseed.io.origin import recentered
from splatseed.io.photograph import lens_findings
from splatseed.io.photograph_checks import photograph_findings
from splatseed.io.ply import read_ply_float64
from splatseed.io.point_files import differing_points, first_with_points
from splatseed.pointcloud import PointCloud
from splatseed.scene import OPENCV, Image, Scene, SceneSource
from splatseed.text import counted
from splatseed.tracks import Tracks

IMAGE_DIRS = ("images", "images_2", "images_4", "images_8", "image", "input")
_MODEL_FILES = ("cameras", "images", "points3D")
_POINT_SUFFIXES = (".bin", ".txt", ".ply")
_UNKNOWN = -1
_SPARSE = re.compile(r"sparse(_\d+)?")
"""Names of folders of models; InstantSplat counts the views in them."""
_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp"})


def scene_model(root: Path) -> Path | None:
    """Find the model of a scene folder, of ``sparse``, or of a folder of numbered models.

    Models elsewhere in a scene folder count if they have more images than those there.
    """
    own = own_models(root)
    return next(iter(_by_images([*own, *_nested_models(root)])), None) if own else None


def nested_model(root: Path) -> Path | None:
    """Find the model in one of the folders of a scene folder that programs name otherwise."""
    return next(iter(_by_images(_nested_models(root))), None)


def models_in(folder: Path) -> list[Path]:
    """Return the models in a folder of numbered ones, most images first, or the folder itself."""
    return ranked_models(folder) or [each for each in (folder,) if find_model(each)]


def own_models(root: Path) -> list[Path]:
    """Return the models in ``sparse`` and in the folder itself, numbered ones first."""
    models = numbered_models(root / "sparse")
    models += [each for each in (root / "sparse", root) if find_model(each)]
    return models + numbered_models(root)


def _nested_models(root: Path) -> list[Path]:
    """Return the models of nerfstudio, InstantSplat and COLMAP's undistortion."""
    counted_views = sorted(each for each in root.glob("sparse_*") if _SPARSE.fullmatch(each.name))
    dense = [each / "sparse" for each in sorted(root.glob("dense/[0-9]*"))]
    models = list[Path]()
    for folder in (root / "colmap/sparse", *counted_views, *dense, root / "dense/sparse"):
        models += [*numbered_models(folder), *([folder] if find_model(folder) else [])]
    return models


def _by_images(models: Sequence[Path]) -> list[Path]:
    """Sort models by their number of images, most first; one that is no model counts as empty."""
    if len(models) < 2:
        return list(models)
    sizes = {each: count_images(each) if model_file(each, "cameras") else 0 for each in models}
    return sorted(models, key=lambda each: -max(sizes[each], 0))


def ranked_models(folder: Path) -> list[Path]:
    """Return a folder's numbered models, most images first."""
    return _by_images(numbered_models(folder))


def numbered_models(folder: Path) -> list[Path]:
    """Return the subfolders ``0``, ``1``, ... that hold a model, by number."""
    if not folder.is_dir():
        return []
    numbered = [each for each in folder.iterdir() if each.name.isdecimal()]
    return [each for each in sorted(numbered, key=lambda p: int(p.name)) if find_model(each)]


def count_images(model_dir: Path) -> int:
    """Read a model's image count; -1 if the file is damaged."""
    path = model_file(model_dir, "images")
    if path is None:
        return 0
    with suppress(SplatseedError, OSError):
        if path.suffix == ".txt":
            return _count_lines(path)
        with open_file(path) as file:
            count = int.from_bytes(file.read(8), "little")
        size = path.stat().st_size
        if size >= 8 and count <= (size - 8) // MIN_IMAGE_BYTES:
            return count
    return _UNKNOWN


def _count_lines(path: Path) -> int:
    """Count the images of ``images.txt``: two lines each, of which the second may be blank."""
    count, lines = 0, numbered_lines(path, errors="replace")
    for _, line in lines:
        if is_data(line):
            count += 1
            next(lines, None)
    return count


def read_model(model_dir: Path, folder: Path | None = None) -> Scene:
    """Read a model as a scene, and report the other models of the scene's folder, or of another."""
    scene, root = read_colmap_scene(model_dir), scene_root(model_dir)
    places = dict.fromkeys([root, *([] if folder is None else [folder])])
    found = [each for place in places for each in (*own_models(place), *_nested_models(place))]
    counts = {each: count_images(each) for each in dict.fromkeys(map(_absolute, found))}
    read = _absolute(model_dir)
    count = counts.setdefault(read, count_images(read))
    for each in numbered_models(root / "distorted/sparse"):  # of the photographs as taken
        if count_images(each) > count:
            counts[_absolute(each)] = count_images(each)
    if len(counts) < 2:
        return scene
    above = Path(os.path.commonpath([each.parent for each in counts]))
    names = {each: each.relative_to(above).as_posix() for each in counts}
    shown = [
        f"{names[each]} with {counted(num, 'image') if num != _UNKNOWN else 'damaged images'}"
        for each, num in counts.items()
    ]
    other = max((each for each in counts if each != read), key=lambda each: counts[each])
    text = f"{above} has {len(counts)} models, {', '.join(shown)}: {names[read]} is read."
    fix = f"To read another, pass its path, such as {other}."
    severity: Severity = "warning" if counts[other] > count else "info"
    finding = Finding("several-models", text, severity, fix=fix)
    return scene.replace(findings=(*scene.findings, finding))


def _absolute(path: Path) -> Path:
    return Path(os.path.abspath(path))  # noqa: PTH100  (resolve would follow links)


def find_model(*folders: Path) -> Path | None:
    """Return the first folder that holds a model."""
    return next((f for f in folders if any(model_file(f, name) for name in _MODEL_FILES)), None)


def model_file(model_dir: Path, name: str) -> Path | None:
    """Return the file that is read for "cameras", "images" or "points3D"."""
    if name == "points3D":
        return first_with_points(_point_files(model_dir))
    candidates = (model_dir / f"{name}{suffix}" for suffix in (".bin", ".txt"))
    return next((path for path in candidates if path.is_file()), None)


def _point_files(model_dir: Path) -> list[Path]:
    paths = (model_dir / f"points3D{suffix}" for suffix in _POINT_SUFFIXES)
    return [path for path in paths if path.is_file()]


def _other_points(model_dir: Path, root: Path, read: Path, points: PointCloud) -> list[Finding]:
    """Report other point files, from which other trainers may start."""
    files, findings = _point_files(model_dir), list[Finding]()
    for i, path in enumerate(files):
        before = " and ".join(each.name for each in files[:i])
        use = f"move {before} out of {model_dir}"
        findings += differing_points(read, points.xyz, path, use)
    place = f"copy it to {model_dir / 'points3D.ply'}"
    if first := [each.name for each in files if each.suffix != ".ply"]:
        place += f" and move {' and '.join(first)} out of that folder"
    return findings + differing_points(read, points.xyz, root / "init.ply", place)


def scene_root(model_dir: Path) -> Path:
    """Return the scene folder of a model: without ``sparse/0`` or ``sparse``, and ``colmap``.

    A folder of these names that holds photographs is a scene itself.
    """
    folders = [model_dir.absolute(), *model_dir.absolute().parents]
    is_model = find_model(model_dir) is not None
    levels = 0
    if _SPARSE.fullmatch(folders[0].name) and (is_model or numbered_models(model_dir)):
        levels = 1
    elif is_model and _SPARSE.fullmatch(folders[0].parent.name):
        levels = 2
    inside = (
        i
        for holds in (_has_image_folder, _has_photographs)
        for i in range(levels + 1)
        if levels and holds(folders[i])
    )
    levels = next(inside, levels)
    if not levels:
        return model_dir
    levels += folders[levels].name == "colmap" and not _has_image_folder(folders[levels])
    named = model_dir if len(model_dir.parts) >= levels else model_dir.absolute()
    return named.parents[levels - 1]


def _has_image_folder(folder: Path) -> bool:
    return any((folder / name).is_dir() for name in IMAGE_DIRS)


def _has_photographs(folder: Path) -> bool:
    with suppress(OSError):  # a folder above that may not be listed
        return any(each.suffix.lower() in _SUFFIXES for each in folder.iterdir())
    return False


def read_colmap_scene(model_dir: StrPath) -> Scene:
    """Read a model as a scene, with findings for the user."""
    model_dir = Path(model_dir)
    root = scene_root(model_dir)
    intrinsics, images, left_out = read_model_cameras(model_dir)
    unusable = unusable_images(left_out)
    list_path = model_file(model_dir, "images") or model_dir
    images, findings = named_as_files(images, _image_folders(root), list_path)
    points, exact, tracks, points_path = read_model_points(model_dir)
    image_dir = _image_dir(root, images)
    findings += [*photograph_findings(images, image_dir, root), *lens_findings(images)]
    findings += unusable_findings(unusable, len(images))
    findings += _unposed_findings(root, image_dir, images)
    findings += _other_points(model_dir, root, points_path, points)
    if (root / "transforms.json").is_file():
        text = f"{root / 'transforms.json'} exists too; pass its path to read it instead."
        findings.append(Finding("several-scenes", text, "info"))
    if not images and (tracks is not None or intrinsics or image_dir is not None):
        tracks, path = None, model_file(model_dir, "images")  # tracks name images
        why = f"{path} lists no images" if path else f"{model_dir} has no images.bin or images.txt"
        text = (
            f"{why}, so no photograph has a pose: copy the complete model, or make one with"
            " splatseed sfm IMAGES -o SCENE. Points can be interpolated, but not trained."
        )
        findings.append(Finding("missing-poses", text))
    convention = f"the model's images hold cam_from_world, {OPENCV}"
    source = SceneSource("colmap", root, points_path, model_dir, image_dir, convention=convention)
    scene = Scene(
        points, images, intrinsics, tracks, source, tuple(findings), absent=tuple(unusable)
    )
    return recentered(scene, exact)


def _image_dir(root: Path, images: Sequence[Image]) -> Path | None:
    """Return the first known folder with half of the images, else that with most, or the first.

    Those beside a folder of graphdeco's distorted model, or of a numbered one, are searched too.

    Not the first with all: where one lacks a photograph, the next may hold reduced copies or, as
    graphdeco's ``input``, photographs with distortion that the model's cameras do not have.
    """
    counts_by_folder = dict[Path, int]()
    folders = _image_folders(root)
    for folder in folders:
        counts_by_folder[folder] = sum((folder / image.name).is_file() for image in images)
        if 2 * counts_by_folder[folder] >= len(images) > 0:
            return folder
    best = max(counts_by_folder, key=lambda folder: counts_by_folder[folder])
    return best if counts_by_folder[best] else next((f for f in folders if root in f.parents), None)


def _image_folders(root: Path) -> list[Path]:
    """Return the folders that may hold a scene's photographs, most likely first."""
    above: list[Path] = []
    if root.name == "distorted" or root.name.isdecimal():
        above = [root.absolute().parent / name for name in ("input", *IMAGE_DIRS)]
    inside = [root / name for name in IMAGE_DIRS]
    return [each for each in (*inside, root, *above) if each.is_dir()]


def _unposed_findings(root: Path, image_dir: Path | None, images: Sequence[Image]) -> list[Finding]:
    """Report photographs that are in the images' folders, but not in the model."""
    if image_dir is None or image_dir == root or not images:
        return []
    names = {image.name for image in images}
    folders = {PurePosixPath(name).parent for name in names}
    there = {
        str(folder / each.name)
        for folder in folders
        if (image_dir / folder).is_dir()
        for each in (image_dir / folder).iterdir()
        if each.suffix.lower() in _SUFFIXES and not is_hidden(each.name)
    }
    posed = there & names
    if not posed or posed == there:
        return []
    text = f"{len(posed):,} of {len(there):,} photographs in {image_dir} have a pose"
    text += "; the others are left out."
    severity: Severity = "info" if 2 * len(posed) >= len(there) else "warning"
    subjects = tuple(sorted(there - posed))
    return [Finding("missing-poses", text, severity, subjects)]


def read_model_cameras(
    model_dir: Path,
) -> tuple[tuple[Intrinsics, ...], tuple[Image, ...], Unusable]:
    """Read the usable camera and image records of a model, and the errors of the others.

    Raises ``NotFiniteError`` if fewer than half of the images are usable.
    """
    cameras_path, images_path = model_file(model_dir, "cameras"), model_file(model_dir, "images")
    if cameras_path is None and images_path is not None:
        expected = f"cameras.bin or cameras.txt beside {images_path}"
        raise SceneNotFoundError(expected, found="neither", fix="Copy the complete model.")
    unusable: Unusable = {}
    intrinsics = read_cameras(cameras_path, unusable) if cameras_path else ()
    images = read_images(images_path, intrinsics, unusable) if images_path else ()
    check_enough(unusable_images(unusable), len(images))
    return intrinsics, images, unusable


def read_model_points(
    model_dir: Path,
) -> tuple[PointCloud, Float64[np.ndarray, "N 3"], Tracks | None, Path]:
    """Read a model's points, from ``points3D.ply`` if it has no other file.

    Returns:
        The cloud, its positions in float64, the tracks if any, and the file.
    """
    path = model_file(model_dir, "points3D")
    if path is None:
        return PointCloud.empty(), np.empty((0, 3)), None, model_dir / "points3D.bin"
    if path.suffix == ".ply":
        return *read_ply_float64(path), None, path
    points, tracks = read_points3d(path)
    return points, tracks.xyz, tracks, path
