"""Recentring of scenes far from 0, and the file that records the offset of an output.

Gaussians, seeds and most formats store float32, whose resolution decreases with the distance from
0: 0.5 m in earth-centred coordinates. The *origin* of such a scene is subtracted, in float64, from
poses and points on reading. Outputs stay recentred; ``recenter.json`` beside them has the *offset*:
original = stored + offset. The origin depends on medians of the camera centres (of the points
without cameras), so outliers do not change it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from splatseed.errors import SceneFormatError
from splatseed.findings import Finding
from splatseed.io.files import read_json
from splatseed.io.staging import add_files, write_json
from splatseed.scene import Image, Scene

RECENTER = "recenter.json"
"""File with the offset of a folder, or, as ``MODEL.recenter.json``, of a model."""


@dataclass(frozen=True)
class OriginLimits:
    """Thresholds; extents are of the cameras, or of the points without cameras."""

    float32_step: float = 2.0**-23
    """Spacing of float32, relative to a coordinate."""
    coarse: float = 1e-5
    """Spacing in extents from which errors are visible where depth is a tenth of the extent."""
    coarse_step: float = 1e-3
    """The same, relative to the distance of successive cameras: in a long walk, depths are as
    small as that."""
    min_gain: float = 8.0
    """Smallest ratio of distances at which one frame is preferred over another."""
    single_point_extent: float = 1e3
    """Extent assumed for coincident positions, whose scale is unknown."""
    rounding: float = 1e-14
    """Extent, relative to a coordinate, up to which positions coincide."""
    distinct_frames: float = 5.0
    """Extents by which two frames must differ to be distinguished."""
    other_frame: float = 1e3
    """Extents (points' plus cameras') from which points and cameras are in different frames."""


LIMITS = OriginLimits()


def choose_origin(
    places: Float[np.ndarray, "N 3"], *, in_order: bool = False
) -> Float64[np.ndarray, " 3"]:
    """Choose a round origin for positions; 0 if float32 resolves them as they are.

    ``in_order``: the positions follow a path, so that their distances bound depths.
    """
    known = _known(places)
    if not len(known):
        return np.zeros(3)
    middle, extent = _middle(known)
    far = float(np.abs(middle).max())
    if extent <= LIMITS.rounding * far:  # in one place, as the parts of a panorama
        extent = LIMITS.single_point_extent
    spacing = far * LIMITS.float32_step
    coarse = spacing > LIMITS.coarse * extent
    if in_order and len(known) > 1 and not coarse and far > LIMITS.min_gain * extent:
        step = float(np.median(np.abs(np.diff(known, axis=0)).max(axis=1)))
        coarse = spacing > LIMITS.coarse_step * step > 0
    if not coarse:
        return np.zeros(3)
    unit = 10.0 ** math.ceil(math.log10(extent))
    return np.asarray(np.rint(middle / unit) * unit)


def recentered(scene: Scene, exact: Float64[np.ndarray, "N 3"] | None = None) -> Scene:
    """Recentre a scene that was just read, if it is far from 0.

    ``exact``: the float64 positions of its points, if the reader has them.
    """
    scene = _with_offset(scene)
    images = sorted(scene.images, key=lambda image: image.name)
    centers = np.array([image.camera.center for image in images]).reshape(-1, 3)
    places = centers if len(centers) else scene.points.xyz if exact is None else exact
    origin = choose_origin(places, in_order=len(centers) > 0)
    if origin.any():
        known = _known(places)
        findings = [_far_away(scene, origin, known), *_lost_precision(scene, exact, origin)]
        scene = translated(scene, origin, exact)
        scene = replace(scene, findings=(*scene.findings, *findings))
    return replace(scene, findings=(*scene.findings, *_other_frame(scene, centers - origin)))


def translated(
    scene: Scene, offset: Float64[np.ndarray, " 3"], exact: Float64[np.ndarray, "N 3"] | None = None
) -> Scene:
    """Subtract an offset from all positions, and add it to the scene's origin."""
    xyz, tracks = scene.points.xyz if exact is None else exact, scene.tracks
    if tracks is not None:
        xyz = xyz.astype(np.float64)
        xyz[: len(tracks)] = tracks.xyz
        tracks = replace(tracks, xyz=tracks.xyz - offset)
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite points are dropped later
        points = scene.points.replace(xyz=(xyz.astype(np.float64) - offset).astype(np.float32))
    images = tuple(translated_image(image, offset) for image in scene.images)
    # The origin directly: a scene's own ``replace`` looks whose tracks new points keep.
    return replace(scene, points=points, images=images, tracks=tracks, origin=scene.origin + offset)


def middle_of_cameras(scene: Scene) -> Float64[np.ndarray, " 3"]:
    """Return the mean camera centre, else the median point, rounded to integers."""
    centers = np.array([image.camera.center for image in scene.images])
    if len(centers):
        return np.asarray(np.rint(centers.mean(axis=0)))
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    return np.rint(np.median(xyz, axis=0)) if len(xyz) else np.zeros(3)


def find_shift(
    scene: Scene,
    xyz: Float[np.ndarray, "N 3"],
    recorded: Float64[np.ndarray, " 3"] | None = None,
    *,
    unrecorded: bool = False,
) -> Float64[np.ndarray, " 3"]:
    """Find the translation from external positions (same axes and units) to the scene's frame.

    It follows from the ``recorded`` offset, else assumes the coordinates of the scene's files. If
    the result is far from the cameras, the original frame is tried and, if ``unrecorded``, the
    scene's own.
    """
    if recorded is None and not scene.offset.any():
        return np.zeros(3)
    shifts = [-scene.origin if recorded is None else recorded - scene.offset]
    shifts += [*[np.zeros(3)] * unrecorded, -scene.origin, -scene.offset]
    places = np.array([image.camera.center for image in scene.images])
    places = places if len(places) else scene.points.xyz[scene.points.finite].astype(np.float64)
    known = _known(xyz)
    if not len(places) or not len(known):
        return shifts[0]
    (here, extent), there = _middle(places), np.median(known, axis=0)
    away = [float(np.abs(there + shift - here).max()) for shift in shifts]
    best = int(np.argmin(away))
    apart = float(np.abs(shifts[best] - shifts[0]).max())
    much_nearer = away[best] * LIMITS.min_gain < away[0]
    nearer = much_nearer and apart > LIMITS.distinct_frames * extent
    return shifts[best if nearer else 0]


def write_offset(path: Path, offset: Float64[np.ndarray, " 3"]) -> None:
    """Record the offset of a folder or a model file.

    A zero offset writes no file, and removes that of an earlier model of the same name.
    """
    target = path / RECENTER if path.is_dir() else path.with_name(f"{path.name}.{RECENTER}")
    if offset.any():
        meaning = "coordinates before = after + offset"
        write_json(target, {"offset": offset.tolist(), "meaning": meaning})
    elif not path.is_dir():
        target.unlink(missing_ok=True)


def add_offset(folder: Path, offset: Float64[np.ndarray, " 3"]) -> None:
    """Record the offset of a finished output folder, and list the file in its manifest."""
    if offset.any():
        add_files(folder, [RECENTER])  # else overwriting would treat it as the user's
        write_offset(folder, offset)


def offset_beside(path: Path) -> Float64[np.ndarray, " 3"] | None:
    """Read the offset of a folder or a file; None if not recorded."""
    places = [path / RECENTER]
    if not path.is_dir():
        places = [path.with_name(f"{path.name}.{RECENTER}"), path.parent / RECENTER]
    file = next((each for each in places if each.is_file()), None)
    if file is None:
        return None
    fix = "Correct the file, or remove it."
    content = read_json(file, fix=fix)
    offset = content.get("offset") if isinstance(content, dict) else None
    try:
        values = np.array(offset, np.float64)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise SceneFormatError(
            f"three numbers as offset in {file}", found=repr(offset)[:80], fix=fix
        )
    return values


def format_offset(offset: Sequence[float] | np.ndarray) -> str:
    """Format an offset for messages."""
    return f"({', '.join(f'{value:.12g}' for value in offset)})"


def _with_offset(scene: Scene) -> Scene:
    source = scene.source
    place = source.points_path if source.format == "ply" else source.root
    offset = None if place is None else offset_beside(place)
    if offset is None:
        return scene
    x, y, z = offset.tolist()
    return replace(scene, source=replace(source, offset=(x, y, z)))


def _known(places: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "n 3"]:
    """Select finite positions."""
    return np.asarray(places[np.isfinite(places).all(axis=1)], np.float64)


def _middle(places: Float64[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, " 3"], float]:
    """Return the median position, and twice the median Chebyshev distance from it."""
    middle = np.median(places, axis=0)
    return middle, 2 * float(np.median(np.abs(places - middle).max(axis=1)))


def translated_image(image: Image, offset: Float64[np.ndarray, " 3"]) -> Image:
    """Subtract an offset from the position of an image's camera."""
    rotation = image.camera.cam_from_world[:3, :3]
    return replace(image, translation=image.translation + rotation @ offset)


def _far_away(
    scene: Scene, origin: Float64[np.ndarray, " 3"], places: Float64[np.ndarray, "N 3"]
) -> Finding:
    middle, extent = _middle(places)
    far, nouns = float(np.abs(middle).max()), "cameras" if scene.images else "points"
    step = np.spacing(np.float32(far))
    text = (
        f"The {nouns} are so far from 0 that float32 has steps of {step:.2g} there: "
        f"{format_offset(origin)} is subtracted from all coordinates. Outputs stay recentred, with "
        f"the offset in {RECENTER}."
    )
    if (step := np.spacing(far)) > LIMITS.coarse * extent > 0:
        text += f" Even double precision has steps of {step:.2g} there."
    return Finding("far-from-origin", text)


def _lost_precision(
    scene: Scene, exact: Float64[np.ndarray, "N 3"] | None, origin: Float64[np.ndarray, " 3"]
) -> list[Finding]:
    """Report points far from 0 that were stored in float32, and so lost precision."""
    xyz = scene.points.xyz if exact is None else exact
    # Ignore points of another frame, nearer to 0.
    xyz = xyz[np.abs(xyz - origin).max(axis=1, initial=0.0) < np.abs(origin).max() / 2]
    path = scene.source.points_path
    if path is None or len(xyz) < 2 or not np.array_equal(xyz, xyz.astype(np.float32)):
        return []
    text = f"The points in {path.name} were stored in single precision, which "
    text += "has rounded their positions: store them in double precision, or recentred."
    return [Finding("rounded-positions", text)]


def _other_frame(scene: Scene, centers: Float64[np.ndarray, "I 3"]) -> list[Finding]:
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    if not len(xyz) or not len(centers):
        return []
    (here, around), (there, extent) = _middle(xyz), _middle(centers)
    away = float(np.abs(here - there).max())
    if away <= LIMITS.other_frame * (around + extent) or not around + extent:
        return []
    text = f"The points are {away:,.0f} from the cameras, {away / (around + extent):,.0f} times "
    text += "their extent: points and poses are in different frames, such as a national grid and "
    return [Finding("points-in-another-frame", f"{text}a local one.", "error")]
