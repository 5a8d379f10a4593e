"""Export: a COLMAP model to the scene folder that trainers read.

pycolmap's undistortion leaves ``sparse/*.bin`` beside files for dense stereo; the scene gets
``images/`` and ``sparse/0/*.bin`` alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from splatseed.errors import OutputError
from splatseed.sfm.features import Run
from splatseed.sfm.orientation import clear_orientation


def export_scene(run: Run, model_dir: Path, staging: Path, *, distinct: bool = True) -> None:
    """Write the model of ``model_dir`` to ``staging`` with distortion removed.

    With ``distinct``, points that COLMAP put exactly where another is are left out. Images whose
    camera is PINHOLE already are copied byte for byte, except that an EXIF orientation is cleared:
    cameras describe the pixels as stored.
    """
    pycolmap = run.pycolmap
    dense = run.work / "dense"
    num_images = pycolmap.Reconstruction(model_dir).num_reg_images()
    run.stages.run(
        "undistortion",
        lambda: pycolmap.undistort_images(
            dense,
            model_dir,
            run.image_dir,
            num_threads=run.settings.threads,
        ),
        lambda: _count_files(dense / "images"),
        num_images,
    )
    _check_written(dense / "images", num_images)
    (staging / "sparse").mkdir()
    (dense / "sparse").rename(staging / "sparse" / "0")
    (dense / "images").rename(staging / "images")
    clear_orientation(staging / "images")
    _finish_points(run, staging / "sparse" / "0", distinct=distinct)


def _count_files(folder: Path) -> int:
    return sum(path.is_file() for path in folder.rglob("*"))


def _check_written(folder: Path, num_images: int) -> None:
    written = _count_files(folder)
    if written != num_images:  # pycolmap only logs an image that it could not write
        raise OutputError(
            f"{num_images} undistorted images to be written",
            found=f"{written}",
            fix="Free some space on the output's disk, or choose another.",
        )


def _finish_points(run: Run, model_dir: Path, *, distinct: bool) -> None:
    """Restate the points' reprojection errors in pixels of the undistorted images."""
    model = run.pycolmap.Reconstruction(model_dir)
    if distinct:
        drop_repeats(model)
    model.update_point_3d_errors()
    model.write(model_dir)


def drop_repeats(model: Any) -> None:
    """Of the points at one float32 position, keep the one with the longest track.

    Args:
        model: A ``pycolmap.Reconstruction``, which is changed.
    """
    kept: dict[bytes, int] = {}
    for each in sorted(model.point3D_ids()):
        point = model.point3D(each)
        place = (np.asarray(point.xyz, np.float32) + np.float32(0)).tobytes()  # -0.0 equals 0.0
        other = kept.get(place)
        if other is None:
            kept[place] = each
        elif point.track.length() > model.point3D(other).track.length():
            kept[place] = each
            model.delete_point3D(other)
        else:
            model.delete_point3D(each)
