"""Export of a pycolmap model: undistorted photographs, pinhole cameras and points."""

from __future__ import annotations

import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image as PilImage

from splatseed.camera import Intrinsics
from splatseed.errors import OutputError
from splatseed.io.photograph_checks import ORIENTATIONS
from splatseed.io.picture import ORIENTATION, UPRIGHT
from splatseed.io.staging import MANIFEST, write_json
from splatseed.pointcloud import first_of_equals
from splatseed.sfm.colmap import ColmapRun
from splatseed.sfm.photos import copy_misread

_SHORT = 3  # the type of the orientation's tag
_HEAD_BYTES = 1 << 17  # EXIF (at most 64 KiB) is the first or second segment
_FOLDED = 0.1  # share of a photograph's diagonal by which such a point misses its features, or more
_NEGLIGIBLE = 2e-7  # a coefficient that counts as distortion but moves no pixel


def export_scene(run: ColmapRun, model_dir: Path, staging: Path, *, distinct: bool = True) -> None:
    """Write a model's undistorted photographs and points to ``staging``.

    Photographs of PINHOLE cameras are copied; of the others, transparent pixels are black. EXIF
    orientations are moved to the manifest. Reprojection errors are in pixels of the undistorted
    photographs. ``distinct`` drops points at the position of another, and those that undistorted
    features contradict.
    """
    pycolmap, dense, straight = run.pycolmap, run.work / "dense", run.work / "straight"
    given = pycolmap.Reconstruction(model_dir)
    num_images = given.num_reg_images()
    for camera in given.cameras.values():
        mark_distortion(camera)
    straight.mkdir()
    given.write(straight)

    posed = [image for image in given.images.values() if image.has_pose]
    plain = {image.name for image in posed if given.cameras[image.camera_id].is_undistorted()}
    photographs = copy_misread(
        *(run.image_dir, [image.name for image in posed], run.work / "opaque"),
        over_black=True,
        linked=plain,
    )

    def num_written() -> int:
        return sum(path.is_file() for path in (dense / "images").rglob("*"))

    run.stage(
        "undistortion",
        lambda: pycolmap.undistort_images(
            dense, straight, photographs, num_threads=run.settings.threads
        ),
        num_written,
        num_images,
    )
    if num_written() != num_images:  # pycolmap only logs images that it fails to read or write
        names = [image.name for image in pycolmap.Reconstruction(model_dir).images.values()]
        missing = sorted(name for name in names if not (dense / "images" / name).is_file())
        raise OutputError(
            f"{num_images} undistorted images to be written",
            found=f"{num_written()}, without {', '.join(missing[:3])}",
            fix="Check that these photographs open, and that there is space on the output's disk.",
        )
    (staging / "sparse").mkdir()
    (dense / "sparse").rename(staging / "sparse" / "0")
    (dense / "images").rename(staging / "images")
    if cleared := clear_orientation(staging / "images"):
        write_json(staging / MANIFEST, {ORIENTATIONS: cleared})
    model = pycolmap.Reconstruction(staging / "sparse" / "0")
    if distinct:
        drop_folded(model)
        drop_repeats(model)
    model.update_point_3d_errors()
    model.write(staging / "sparse" / "0")


def mark_distortion(camera: Any) -> None:
    """Change a camera so that pycolmap undistorts its photographs if and only if needed.

    pycolmap checks coefficients only: it would copy the photographs of a fisheye whose coefficients
    are 0, and resample those of an EUCM camera that is a pinhole.
    """
    size, params = (camera.width, camera.height), tuple(camera.params)
    lens = Intrinsics(camera.camera_id, camera.model.name, *size, params)
    models = type(camera.model)
    if lens.is_fisheye and camera.is_undistorted():
        camera.model = models.OPENCV_FISHEYE
        camera.params = [*lens.pinhole.params, _NEGLIGIBLE, 0.0, 0.0, 0.0]
    elif not lens.has_distortion and not lens.is_pinhole:
        camera.model = models.PINHOLE
        camera.params = list(lens.pinhole.params)


def drop_folded(model: Any) -> None:
    """Delete observations that points miss by far in undistorted photographs.

    A lens model can fold directions far outside of a photograph back into it, so that points there
    fit features whose rays they do not meet. Points with fewer than two observations go.
    """
    model.update_point_3d_errors()
    sizes = [math.hypot(camera.width, camera.height) for camera in model.cameras.values()]
    limit = _FOLDED * min(sizes, default=0.0)
    # The error is the observations' mean, infinite where a point is behind the camera.
    odd = [i for i, p in model.points3D.items() if not p.error * p.track.length() <= limit]
    for point_id in odd:
        point = model.point3D(point_id)
        seen = [(each.image_id, each.point2D_idx) for each in point.track.elements]
        for image_id, index in [each for each in seen if _miss(model, point, *each) > limit]:
            if model.exists_point3D(point_id):  # deleted with its last but one observation
                model.delete_observation(image_id, index)


def _miss(model: Any, point: Any, image_id: int, index: int) -> float:
    """Return the distance of a feature from the projection of its point, px."""
    image = model.image(image_id)
    at = image.project_point(point.xyz)
    return math.inf if at is None else math.dist(at, image.point2D(index).xy)


def drop_repeats(model: Any) -> None:
    """Of points at one float32 position, keep the one with the longest track."""
    points = model.points3D
    longest_first = sorted(points, key=lambda i: (-points[i].track.length(), i))
    xyz = np.array([points[i].xyz for i in longest_first], np.float32).reshape(-1, 3)
    repeats = np.flatnonzero(~first_of_equals(xyz))
    for repeat in sorted(longest_first[k] for k in repeats):
        model.delete_point3D(repeat)


def clear_orientation(folder: Path) -> dict[str, int]:
    """Set the orientation of all JPEG and TIFF files in a folder to upright; return those it had.

    COLMAP uses stored pixels but copies the tag; a trainer whose image reader applies it (OpenCV
    does, and Pillow for TIFF) would rotate the photograph relative to its camera. Only the tag's
    two bytes change.
    """
    cleared: dict[str, int] = {}
    for path in folder.rglob("*"):
        if path.suffix.lower() not in {".jpg", ".jpeg", ".tif", ".tiff"}:
            continue
        with PilImage.open(path) as image:
            orientation = image.getexif().get(ORIENTATION, UPRIGHT)
        if orientation not in range(UPRIGHT + 1, 9):  # upright or invalid
            continue
        content = path.read_bytes()
        start = _first_directory(content)
        # A TIFF 6.0 entry: tag, type, count and value, in either byte order.
        for order in ("<HHIH", ">HHIH"):
            entry = struct.pack(order, ORIENTATION, _SHORT, 1, orientation)
            at = content.find(entry, start, start + _HEAD_BYTES)
            if at >= 0:
                upright = struct.pack(order, ORIENTATION, _SHORT, 1, UPRIGHT)
                path.unlink()  # copies of read-only photographs are read-only
                path.write_bytes(content[:at] + upright + content[at + len(upright) :])
                cleared[path.relative_to(folder).as_posix()] = orientation
                break
    return cleared


def _first_directory(content: bytes) -> int:
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(content[:4])
    return 0 if order is None else int(struct.unpack_from(f"{order}I", content, 4)[0])
