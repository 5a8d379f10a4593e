"""Export: a COLMAP model to the scene folder that trainers read.

pycolmap's undistortion leaves ``sparse/*.bin`` beside files for dense stereo; the scene gets
``images/`` and ``sparse/0/*.bin`` alone.
"""

from __future__ import annotations

from pathlib import Path

from splatseed.errors import OutputError
from splatseed.sfm.features import Run
from splatseed.sfm.orientation import clear_orientation

__all__ = ["export_scene"]


def export_scene(run: Run, model_dir: Path, staging: Path) -> None:
    """Write the model of ``model_dir`` to ``staging`` with distortion removed.

    Images whose camera is PINHOLE already are copied byte for byte, except that an EXIF
    orientation is cleared: cameras describe the pixels as stored.
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
    _refresh_errors(run, staging / "sparse" / "0")


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


def _refresh_errors(run: Run, model_dir: Path) -> None:
    """Restate the points' reprojection errors in pixels of the undistorted images."""
    model = run.pycolmap.Reconstruction(model_dir)
    model.update_point_3d_errors()
    model.write(model_dir)
