"""Mapping: from verified matches to a model, with poses unknown or known.

``map_images`` and ``triangulate_points`` return the folder of a COLMAP model in the run's scratch
folder.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import ReconstructionError
from splatseed.scene import Image
from splatseed.sfm.features import Run
from splatseed.sfm.photos import Photo, name_some

SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")
"""Camera models than which none is worth trying instead."""


def _advice(run: Run, photos: Sequence[Photo], camera_model: str) -> str:
    """What can make more photographs fit together, of what has not been done already."""
    ways = ["Take more overlapping photographs", "take out those of other places"]
    if run.settings.matcher != "exhaustive":
        ways.append("try the exhaustive matcher")
    if camera_model not in SIMPLE:
        ways.append("try a simpler camera_model such as SIMPLE_RADIAL")
    if run.settings.max_image_size < max(max(photo.width, photo.height) for photo in photos):
        ways.append("find features at a larger max_image_size")
    return f"{', '.join(ways[:-1])} or {ways[-1]}."


def map_images(run: Run, photos: Sequence[Photo], camera_model: str) -> Path:
    """Solve for poses, lenses and points, and keep the model with the most images.

    Args:
        run: The run.
        photos: The photographs.
        camera_model: The model of their lenses.

    Raises:
        ReconstructionError: No model was found, or it has fewer than half of the photographs.
    """
    names, advice = [photo.name for photo in photos], _advice(run, photos, camera_model)
    models_dir = run.work / "models"
    models_dir.mkdir()
    models = _incremental_mapping(run, models_dir, len(names))
    if not models:
        raise ReconstructionError(
            f"a model of the {len(names)} images in {run.image_dir}",
            found="no two images that match well enough to begin one",
            fix=advice,
        )
    best = max(models, key=lambda i: (models[i].num_reg_images(), models[i].num_points3D()))
    _check_registered(run, models[best], len(models), names, advice)
    return models_dir / str(best)


def _incremental_mapping(run: Run, models_dir: Path, num_images: int) -> dict[int, Any]:
    pycolmap = run.pycolmap
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = run.settings.threads
    options.random_seed = run.settings.seed
    registered: list[None] = []  # of the model being built; mapping may begin several

    def restart() -> None:
        registered[:] = [None, None]

    return dict(
        run.stages.run(
            "mapping",
            lambda: pycolmap.incremental_mapping(
                run.database,
                run.image_dir,
                models_dir,
                options,
                initial_image_pair_callback=restart,
                next_image_callback=lambda: registered.append(None),
            ),
            lambda: len(registered),
            num_images,
        )
    )


def _check_registered(
    run: Run, model: Any, num_models: int, names: Sequence[str], advice: str
) -> None:
    registered = {image.name for image in model.images.values() if image.has_pose}
    if 2 * len(registered) >= len(names):
        return
    missing = [name for name in names if name not in registered]
    raise ReconstructionError(
        f"at least half of the {len(names)} images in {run.image_dir} to register",
        found=f"{len(registered)} in the largest of {num_models} models; "
        f"without a pose: {name_some(missing)}",
        fix=advice,
    )


def triangulate_points(
    run: Run, cameras: Sequence[Any], images: Sequence[Any], poses: Sequence[Image]
) -> Path:
    """Triangulate points with the poses and cameras held fixed.

    Args:
        run: The run.
        cameras: The cameras of the database.
        images: The images of the database.
        poses: Their poses, in the same order.

    Raises:
        ReconstructionError: Not a single point was found.
    """
    pycolmap = run.pycolmap
    options = pycolmap.IncrementalPipelineOptions()
    options.num_threads = run.settings.threads
    options.random_seed = run.settings.seed
    options.max_extra_param = math.inf  # a known lens is trusted: Kinects have a k3 above 1
    model_dir = run.work / "model"
    model_dir.mkdir()
    posed = posed_model(pycolmap, cameras, images, poses)
    model = run.stages.run(
        "triangulation",
        lambda: pycolmap.triangulate_points(
            posed,
            run.database,
            run.image_dir,
            model_dir,
            options=options,
        ),
        posed.num_points3D,
        0,
    )
    if model.num_points3D() == 0:
        raise ReconstructionError(
            f"points from the {len(images)} posed images in {run.image_dir}",
            found="none on which two matching rays meet",
            fix="Check that the poses belong to these images, in the same order and convention; "
            "a capture without sideways motion has no depth to triangulate.",
        )
    return model_dir


def posed_model(
    pycolmap: Any, cameras: Sequence[Any], images: Sequence[Any], poses: Sequence[Image]
) -> Any:
    """A ``pycolmap.Reconstruction`` of ``images`` at ``poses``, given in the same order."""
    model = pycolmap.Reconstruction()
    for camera in cameras:
        model.add_camera_with_trivial_rig(camera)
    for image, pose in zip(images, poses, strict=True):
        model.add_image_with_trivial_frame(image, rigid(pycolmap, pose))
    return model


def rigid(pycolmap: Any, image: Image) -> Any:
    """The pose of ``image``, cam_from_world, as a ``pycolmap.Rigid3d``."""
    rotation = pycolmap.Rotation3d(np.roll(image.quat, -1))  # wxyz to xyzw
    return pycolmap.Rigid3d(rotation, image.translation)
