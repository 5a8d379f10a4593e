"""A scene from a COLMAP model: where its files are, and what they hold.

Notation: a *model* is a folder with cameras, images and points3D, each as ``.bin`` or ``.txt``;
``points3D.ply`` stands in for missing points. Promise: ``.bin`` is preferred to ``.txt``; a model
without images still gives its cloud and cameras.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.camera import Intrinsics
from splatseed.errors import SceneNotFoundError
from splatseed.io.colmap import binary as colmap_binary, text as colmap_text
from splatseed.io.photograph import image_warnings, lens_warnings
from splatseed.io.ply import read_ply
from splatseed.pointcloud import PointCloud
from splatseed.scene import Image, Scene, SceneSource, Tracks

_MODEL_FILES = ("cameras", "images", "points3D")
_IMAGE_DIRS = ("images", "images_2", "images_4", "images_8", "image", "input")


def find_model(*folders: Path) -> Path | None:
    """The first of the given folders that holds a model."""
    return next((folder for folder in folders if _is_model(folder)), None)


def _is_model(folder: Path) -> bool:
    return any(_model_file(folder, name) is not None for name in _MODEL_FILES)


def _model_file(model_dir: Path, name: str) -> Path | None:
    suffixes = (".bin", ".txt", ".ply") if name == "points3D" else (".bin", ".txt")
    candidates = (model_dir / f"{name}{suffix}" for suffix in suffixes)
    return next((path for path in candidates if path.is_file()), None)


def scene_root(model_dir: Path) -> Path:
    """The scene's folder: the model's without ``sparse/0`` or ``sparse``, or ``colmap`` above."""
    parts = model_dir.absolute().parts
    levels = 1 if parts[-1] == "sparse" else 2 if parts[-2:-1] == ("sparse",) else 0
    if not levels:
        return model_dir
    levels += parts[-levels - 1] == "colmap"
    named = model_dir if len(model_dir.parts) >= levels else model_dir.absolute()
    return named.parents[levels - 1]


def read_colmap_scene(model_dir: Path) -> Scene:
    """The scene of a model: its images, its points, and warnings for the user."""
    root = scene_root(model_dir)
    intrinsics, images = read_model_cameras(model_dir)
    points, tracks, points_path = read_model_points(model_dir)
    image_dir = _find_image_dir(root, images)
    warnings = [
        *_model_warnings(root, model_dir),
        *image_warnings(images, image_dir, root),
        *lens_warnings(images),
    ]
    if not images and (tracks is not None or intrinsics or image_dir is not None):
        tracks = None  # they name images
        warnings.append(_no_poses(model_dir))
    return Scene(
        points,
        images,
        intrinsics,
        tracks,
        SceneSource("colmap", root, points_path, model_dir, image_dir),
        tuple(warnings),
    )


def read_model_cameras(
    model_dir: Path,
) -> tuple[tuple[Intrinsics, ...], tuple[Image, ...]]:
    """The camera and the image records of a model."""
    cameras_path, images_path = _model_file(model_dir, "cameras"), _model_file(model_dir, "images")
    if cameras_path is None:
        if images_path is not None:
            raise SceneNotFoundError(
                f"cameras.bin or cameras.txt beside {images_path}",
                found="neither",
                fix="Copy the whole model.",
            )
        return (), ()
    intrinsics = _format_of(cameras_path).read_cameras(cameras_path)
    if images_path is None:
        return intrinsics, ()
    return intrinsics, _format_of(images_path).read_images(images_path, intrinsics)


def read_model_points(model_dir: Path) -> tuple[PointCloud, Tracks | None, Path]:
    """The points of a model, their tracks if any, and the file they came from."""
    path = _model_file(model_dir, "points3D")
    if path is None:
        return empty_cloud(), None, model_dir / "points3D.bin"
    if path.suffix == ".ply":
        return read_ply(path), None, path
    points, tracks = _format_of(path).read_points3d(path)
    return points, tracks, path


def _format_of(path: Path) -> Any:
    return colmap_binary if path.suffix == ".bin" else colmap_text


def empty_cloud() -> PointCloud:
    """A cloud without points."""
    return PointCloud(np.empty((0, 3), np.float32), np.empty((0, 3), np.uint8))


def _find_image_dir(root: Path, images: Sequence[Image]) -> Path | None:
    """The first known folder that holds the first image, else the first that exists."""
    folders = [root / name for name in _IMAGE_DIRS if (root / name).is_dir()]
    first = images[0].name if images else ""
    holding = (folder for folder in (*folders, root) if first and (folder / first).is_file())
    return next(holding, folders[0] if folders else None)


def _no_poses(model_dir: Path) -> str:
    """Why a model has no images, and what to do."""
    path = _model_file(model_dir, "images")
    why = f"{path} lists no images" if path else f"{model_dir} has no images.bin or images.txt"
    return (
        f"{why}, so no photograph has a pose: copy the whole model, or make one with splatseed sfm "
        "IMAGES -o SCENE. Points can be interpolated, but nothing can be trained."
    )


def _model_warnings(root: Path, model_dir: Path) -> list[str]:
    warnings = []
    if model_dir.name == "0" and _is_model(model_dir.with_name("1")):
        warnings.append(f"{model_dir.parent} has several models; this is {model_dir.name}.")
    if (root / "transforms.json").is_file():
        warnings.append(f"{root / 'transforms.json'} is there too; name it to read it instead.")
    return warnings
