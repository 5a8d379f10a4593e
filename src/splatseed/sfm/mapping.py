"""From verified matches to a scene: mapping, triangulation, and the export without distortion.

``map_images`` and ``triangulate_points`` return the folder of a COLMAP model in the run's scratch
folder; ``export_scene`` turns it into what trainers read. COLMAP reads pixels as they are stored
and keeps EXIF's orientation in what it writes; a trainer whose image reader obeys that tag (as
OpenCV's does) would see the photograph rotated relative to its camera, so it is cleared.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PilImage

from splatseed.errors import OutputError, ReconstructionError
from splatseed.scene import Image
from splatseed.sfm.features import Run
from splatseed.sfm.photos import Photo, name_some

_SIMPLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL")
"""Camera models than which none is worth trying instead."""
_ORIENTATION = 0x0112
_UPRIGHT = 1
_EXIF = b"Exif\0\0"
_HEAD_BYTES = 1 << 17  # the EXIF segment, at most 64 KiB, comes first or after a small one


def map_images(run: Run, photos: Sequence[Photo], camera_model: str) -> Path:
    """Solve for poses, lenses and points, and keep the model with the most images.

    Raises:
        ReconstructionError: No model was found, or it has fewer than half of the photographs.
    """
    models_dir = run.work / "models"
    models_dir.mkdir()
    registered: list[None] = []  # of the model being built; mapping may begin several

    def restart() -> None:
        registered[:] = [None, None]

    models = dict(
        run.stage(
            "mapping",
            lambda: run.pycolmap.incremental_mapping(
                run.database,
                run.image_dir,
                models_dir,
                _options(run),
                initial_image_pair_callback=restart,
                next_image_callback=lambda: registered.append(None),
            ),
            lambda: len(registered),
            len(photos),
        )
    )
    if not models:
        raise ReconstructionError(
            f"a model of the {len(photos)} images in {run.image_dir}",
            found="no two images that match well enough to begin one",
            fix=_advice(run, camera_model),
        )
    best = max(models, key=lambda i: (models[i].num_reg_images(), models[i].num_points3D()))
    found = {image.name for image in models[best].images.values() if image.has_pose}
    if 2 * len(found) < len(photos):
        missing = [photo.name for photo in photos if photo.name not in found]
        raise ReconstructionError(
            f"at least half of the {len(photos)} images in {run.image_dir} to register",
            found=f"{len(found)} in the largest of {len(models)} models; "
            f"without a pose: {name_some(missing)}",
            fix=_advice(run, camera_model),
        )
    return models_dir / str(best)


def _advice(run: Run, camera_model: str) -> str:
    """What can make more photographs fit together, of what has not been done already."""
    ways = ["Take more overlapping photographs", "take out those of other places"]
    if run.settings.matcher != "exhaustive":
        ways.append("try the exhaustive matcher")
    if camera_model not in _SIMPLE:
        ways.append("try a simpler camera_model such as SIMPLE_RADIAL")
    return f"{', '.join(ways[:-1])} or {ways[-1]}."


def triangulate_points(
    run: Run, cameras: Sequence[Any], images: Sequence[Any], poses: Sequence[Image]
) -> Path:
    """Triangulate points with the cameras and the images' ``poses`` held fixed.

    Raises:
        ReconstructionError: Not a single point was found.
    """
    model_dir = run.work / "model"
    model_dir.mkdir()
    options = _options(run)
    options.max_extra_param = math.inf  # a known lens is trusted: Kinects have a k3 above 1
    posed = posed_model(run.pycolmap, cameras, images, poses)
    model = run.stage(
        "triangulation",
        lambda: run.pycolmap.triangulate_points(
            posed, run.database, run.image_dir, model_dir, options=options
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


def _options(run: Run) -> Any:
    options = run.pycolmap.IncrementalPipelineOptions()
    options.num_threads = run.settings.threads
    options.random_seed = run.settings.seed
    return options


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


def export_scene(run: Run, model_dir: Path, staging: Path, *, distinct: bool = True) -> None:
    """Write a model's photographs and points to ``staging`` with distortion removed.

    Images whose camera is PINHOLE already are copied byte for byte, except that an EXIF orientation
    is cleared. The points' reprojection errors are in pixels of the undistorted images. With
    ``distinct``, points that COLMAP put exactly where another is are left out.

    Raises:
        OutputError: Not all images could be written.
    """
    pycolmap, dense = run.pycolmap, run.work / "dense"
    num_images = pycolmap.Reconstruction(model_dir).num_reg_images()

    def num_written() -> int:
        return sum(path.is_file() for path in (dense / "images").rglob("*"))

    run.stage(
        "undistortion",
        lambda: pycolmap.undistort_images(
            dense, model_dir, run.image_dir, num_threads=run.settings.threads
        ),
        num_written,
        num_images,
    )
    if num_written() != num_images:  # pycolmap only logs an image that it could not write
        raise OutputError(
            f"{num_images} undistorted images to be written",
            found=f"{num_written()}",
            fix="Free some space on the output's disk, or choose another.",
        )
    (staging / "sparse").mkdir()
    (dense / "sparse").rename(staging / "sparse" / "0")
    (dense / "images").rename(staging / "images")
    clear_orientation(staging / "images")
    model = pycolmap.Reconstruction(staging / "sparse" / "0")
    if distinct:
        drop_repeats(model)
    model.update_point_3d_errors()
    model.write(staging / "sparse" / "0")


def drop_repeats(model: Any) -> None:
    """Of a reconstruction's points at one float32 position, keep that with the longest track."""
    kept: dict[bytes, int] = {}
    for each in sorted(model.point3D_ids()):
        point = model.point3D(each)
        place = (np.asarray(point.xyz, np.float32) + np.float32(0)).tobytes()  # -0.0 equals 0.0
        other = kept.setdefault(place, each)
        if other != each:
            longer = point.track.length() > model.point3D(other).track.length()
            kept[place] = each if longer else other
            model.delete_point3D(other if longer else each)


def clear_orientation(folder: Path) -> None:
    """Mark every JPEG below ``folder`` as upright in its stored orientation.

    The two bytes of the tag change and nothing else.
    """
    for path in folder.rglob("*"):
        if path.suffix.lower() not in {".jpg", ".jpeg"}:
            continue
        with PilImage.open(path) as image:
            turned = image.getexif().get(_ORIENTATION, _UPRIGHT) != _UPRIGHT
        content = bytearray(path.read_bytes() if turned else b"")
        at = _find_orientation(bytes(content[:_HEAD_BYTES]))
        if at is not None:
            offset, order = at
            struct.pack_into(f"{order}H", content, offset, _UPRIGHT)
            path.unlink()  # a copy of a read-only photograph is read-only
            path.write_bytes(content)


def _find_orientation(head: bytes) -> tuple[int, str] | None:
    """The position of the tag's value, and its byte order ('<' or '>').

    EXIF is a TIFF file in an APP1 segment (CIPA DC-008, 4.5): byte order, offset of the first
    directory, its number of entries, then 12 bytes an entry: tag, type, count, value.
    """
    tiff = head.find(_EXIF) + len(_EXIF)
    order = {b"II": "<", b"MM": ">"}.get(head[tiff : tiff + 2])
    if order is None:
        return None
    try:
        directory = tiff + struct.unpack_from(f"{order}I", head, tiff + 4)[0]
        (entries,) = struct.unpack_from(f"{order}H", head, directory)
        for entry in range(directory + 2, directory + 2 + 12 * entries, 12):
            if struct.unpack_from(f"{order}H", head, entry)[0] == _ORIENTATION:
                return entry + 8, order
    except struct.error:  # an offset beyond the segment
        return None
    return None
