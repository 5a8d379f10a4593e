"""The origin that a scene is worked on around, and the file that records it beside what is written.

Gaussians, seeds and most formats hold float32, whose steps grow with the distance from 0: half a
unit around the earth's centre. The *origin* of such a scene is subtracted, in float64, from poses
and points while they are read; what is written stays around it, and ``recenter.json`` beside it has
the *offset*: coordinates before = after + offset. Poses alone decide, or points where there are
none, by medians, so that fewer than half of them, however far away, change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from splatseed.errors import SceneFormatError
from splatseed.io.files import read_json
from splatseed.io.staging import add_files, write_json
from splatseed.scene import Image, Scene

RECENTER = "recenter.json"
"""The file that records an offset: of a folder, or, after the name of a model's file, of that."""
STEP = 2.0**-23
"""The step of float32 is up to this share of a coordinate."""
COARSE = 1e-5
"""Steps of more than this share of the cameras' extent show where depths are a tenth of it."""
COARSE_PACE, GAIN = 1e-3, 8.0
"""In a long walk depths are as small as the distance from camera to camera, of which this share is
too coarse; an origin then helps if coordinates are so many extents."""
UNKNOWN = 1e3
"""The extent of what is in one place: it may be of any size."""
APART = 5.0
"""Frames are told from each other if they are so many extents of the cameras apart."""
ELSEWHERE = 1e3
"""Points so many extents from the cameras, of theirs and the cameras', are in another frame."""


def choose_origin(
    places: Float[np.ndarray, "N 3"], *, in_order: bool = False
) -> Float64[np.ndarray, " 3"]:
    """The origin to work on places around, a round number; 0 where float32 resolves them there.

    ``in_order``: they are stops of a walk, whose distances bound depths.
    """
    known = _known(places)
    if not len(known):
        return np.zeros(3)
    middle, extent = _middle(known)
    far, extent = float(np.abs(middle).max()), extent or UNKNOWN
    coarse = far * STEP > COARSE * extent
    if in_order and len(known) > 1 and not coarse and far > GAIN * extent:
        pace = float(np.median(np.abs(np.diff(known, axis=0)).max(axis=1)))
        coarse = far * STEP > COARSE_PACE * pace > 0
    if not coarse:
        return np.zeros(3)
    unit = 10.0 ** math.ceil(math.log10(extent))
    return np.asarray(np.rint(middle / unit) * unit)


def recentered(scene: Scene, exact: Float64[np.ndarray, "N 3"] | None = None) -> Scene:
    """A scene as a reader made it, around its own origin if it is far from 0.

    ``exact`` are the positions of its points in double precision, if it has any.
    """
    scene = _with_offset(scene)
    images = sorted(scene.images, key=lambda image: image.name)
    centers = np.array([image.camera.center for image in images]).reshape(-1, 3)
    places = centers if len(centers) else scene.points.xyz if exact is None else exact
    origin = choose_origin(places, in_order=len(centers) > 0)
    if origin.any():
        known = _known(places)
        notes = [_note(scene, origin, known), *_lost(scene, exact, origin)]
        scene = translated(scene, origin, exact)
        scene = replace(scene, warnings=(*scene.warnings, *notes))
    return replace(scene, warnings=(*scene.warnings, *_elsewhere(scene, centers - origin)))


def translated(
    scene: Scene, offset: Float64[np.ndarray, " 3"], exact: Float64[np.ndarray, "N 3"] | None = None
) -> Scene:
    """The scene with an offset subtracted from all positions, and added to its origin."""
    xyz, tracks = scene.points.xyz if exact is None else exact, scene.tracks
    if tracks is not None:
        xyz = xyz.astype(np.float64)
        xyz[: len(tracks)] = tracks.xyz
        tracks = replace(tracks, xyz=tracks.xyz - offset)
    with np.errstate(over="ignore", invalid="ignore"):  # not finite stays so, to be dropped
        points = scene.points.replace(xyz=(xyz.astype(np.float64) - offset).astype(np.float32))
    images = tuple(_moved(image, offset) for image in scene.images)
    # The origin directly: a scene's own ``replace`` looks whose tracks new points keep.
    return replace(scene, points=points, images=images, tracks=tracks, origin=scene.origin + offset)


def middle_of_cameras(scene: Scene) -> Float64[np.ndarray, " 3"]:
    """The mean of the cameras, or without any the median of the points, in whole units."""
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
    """What brings positions of elsewhere, in the scene's axes and units, to those of the scene.

    By the ``recorded`` offset, if there is one, else from the coordinates of the scene's files. If
    that leads far from the cameras, positions may be in the world or, if ``unrecorded`` offsets are
    possible, around the scene's own.
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
    nearer = away[best] * GAIN < away[0] and apart > APART * extent
    return shifts[best if nearer else 0]


def write_offset(path: Path, offset: Float64[np.ndarray, " 3"]) -> None:
    """Record an offset beside a folder's files, or beside the file of a model.

    No file is written for none, and one of an earlier model of that name is removed.
    """
    target = path / RECENTER if path.is_dir() else path.with_name(f"{path.name}.{RECENTER}")
    if offset.any():
        meaning = "coordinates before = after + offset"
        write_json(target, {"offset": offset.tolist(), "meaning": meaning})
    elif not path.is_dir():
        target.unlink(missing_ok=True)


def add_offset(folder: Path, offset: Float64[np.ndarray, " 3"]) -> None:
    """As ``write_offset``, for a folder that is complete but for this file."""
    if offset.any():
        add_files(folder, [RECENTER])  # or --overwrite would take it for the user's
        write_offset(folder, offset)


def offset_beside(path: Path) -> Float64[np.ndarray, " 3"] | None:
    """The offset recorded beside a folder's files, or beside a file; None where none is.

    Raises:
        SceneFormatError: A file of that name holds no offset.
    """
    own = path.with_name(f"{path.name}.{RECENTER}")
    places = (path / RECENTER,) if path.is_dir() else (own, path.parent / RECENTER)
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
    """An offset for a person to read."""
    return f"({', '.join(f'{value:.12g}' for value in offset)})"


def _with_offset(scene: Scene) -> Scene:
    """The scene with the offset that stands beside its files."""
    source = scene.source
    if source is None:
        return scene
    offset = offset_beside(source.points_path if source.format == "ply" else source.root)
    if offset is None:
        return scene
    x, y, z = offset.tolist()
    return replace(scene, source=replace(source, offset=(x, y, z)))


def _known(places: Float[np.ndarray, "N 3"]) -> Float64[np.ndarray, "n 3"]:
    """Those that are finite."""
    return np.asarray(places[np.isfinite(places).all(axis=1)], np.float64)


def _middle(places: Float64[np.ndarray, "N 3"]) -> tuple[Float64[np.ndarray, " 3"], float]:
    """The median of places, and twice their median distance from it, along the farthest axis."""
    middle = np.median(places, axis=0)
    return middle, 2 * float(np.median(np.abs(places - middle).max(axis=1)))


def _moved(image: Image, offset: Float64[np.ndarray, " 3"]) -> Image:
    rotation = image.camera.cam_from_world[:3, :3]
    return replace(image, translation=image.translation + rotation @ offset)


def _note(
    scene: Scene, origin: Float64[np.ndarray, " 3"], places: Float64[np.ndarray, "N 3"]
) -> str:
    middle, extent = _middle(places)
    far, what = float(np.abs(middle).max()), "cameras" if scene.images else "points"
    step = np.spacing(np.float32(far))
    note = (
        f"The {what} lie so far from 0 that float32 has steps of {step:.2g} there: "
        f"{format_offset(origin)} is subtracted from all coordinates, and what is written stays "
        f"around it, with {RECENTER} beside it."
    )
    if (step := np.spacing(far)) > COARSE * extent > 0:
        note += f" Even double precision has steps of {step:.2g} there."
    return note


def _lost(
    scene: Scene, exact: Float64[np.ndarray, "N 3"] | None, origin: Float64[np.ndarray, " 3"]
) -> list[str]:
    """A note where points were stored in single precision, which has lost their places."""
    xyz = scene.points.xyz if exact is None else exact
    # Points around another place, of a wrong frame, lost nothing.
    xyz = xyz[np.abs(xyz - origin).max(axis=1, initial=0.0) < np.abs(origin).max() / 2]
    if scene.source is None or len(xyz) < 2 or not np.array_equal(xyz, xyz.astype(np.float32)):
        return []
    note = f"The points in {scene.source.points_path.name} were stored in single precision, which "
    return [f"{note}has rounded their places: store them in double precision, or around an offset."]


def _elsewhere(scene: Scene, centers: Float64[np.ndarray, "I 3"]) -> list[str]:
    """A note where points are so far from the cameras that none can see them."""
    xyz = scene.points.xyz[scene.points.finite].astype(np.float64)
    if not len(xyz) or not len(centers):
        return []
    (here, around), (there, extent) = _middle(xyz), _middle(centers)
    away = float(np.abs(here - there).max())
    if away <= ELSEWHERE * (around + extent) or not around + extent:
        return []
    note = f"The points lie {away:,.0f} from the cameras, {away / (around + extent):,.0f} times "
    note += "their extent: points and poses are in different frames, such as a national grid and "
    return [f"{note}a local one."]
