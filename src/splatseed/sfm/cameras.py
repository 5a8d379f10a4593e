"""Cameras and images for the database, guessed from photographs or taken from a scene.

Notation: ``cameras`` and ``images`` are pycolmap's objects, whose ids count from 1. Poses
are ``cam_from_world`` in OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from splatseed.camera import Intrinsics
from splatseed.scene import Image
from splatseed.sfm.features import Run
from splatseed.sfm.photos import Photo


def guess_cameras(
    run: Run, photos: Sequence[Photo], camera_model: str, *, shared: bool
) -> tuple[list[Any], list[Any]]:
    """Cameras with EXIF's or a default focal length, and their images.

    Args:
        run: The run.
        photos: The photographs.
        camera_model: COLMAP's model of the lens.
        shared: One camera for all photographs of a size, or one for each photograph.
    """
    pycolmap = run.pycolmap
    options = pycolmap.ImageReaderOptions()
    options.camera_model = camera_model
    cameras: dict[Any, Any] = {}
    images = []
    for image_id, photo in enumerate(photos, 1):
        key = (photo.width, photo.height) if shared else photo.name
        if key not in cameras:
            camera = pycolmap.infer_camera_from_image(run.image_dir / photo.name, options)
            camera.camera_id = len(cameras) + 1
            cameras[key] = camera
        images.append(_image(pycolmap, photo.name, image_id, cameras[key].camera_id))
    return list(cameras.values()), images


def known_cameras(run: Run, pairs: Sequence[tuple[Photo, Image]]) -> tuple[list[Any], list[Any]]:
    """The cameras of posed photographs, exactly as given, and their images."""
    pycolmap = run.pycolmap
    cameras: dict[int, Any] = {}
    images = []
    for image_id, (photo, posed) in enumerate(pairs, 1):
        key = posed.intrinsics.camera_id
        if key not in cameras:
            cameras[key] = _camera(pycolmap, posed.intrinsics, len(cameras) + 1)
        images.append(_image(pycolmap, photo.name, image_id, cameras[key].camera_id))
    return list(cameras.values()), images


def _camera(pycolmap: Any, intrinsics: Intrinsics, camera_id: int) -> Any:
    camera = pycolmap.Camera(
        camera_id=camera_id,
        model=intrinsics.model,
        width=intrinsics.width,
        height=intrinsics.height,
        params=list(intrinsics.params),
    )
    camera.has_prior_focal_length = True  # matches are verified with the true focal length
    return camera


def _image(pycolmap: Any, name: str, image_id: int, camera_id: int) -> Any:
    image = pycolmap.Image()
    image.name, image.image_id, image.camera_id = name, image_id, camera_id
    return image
