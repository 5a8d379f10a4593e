"""GPS positions of photographs, and the metric frame, east, north and up, that they determine.

Structure-from-Motion finds poses up to a similarity, which is fitted to the positions in EXIF: the
least median of squares over random triples (Rousseeuw 1984), then least squares over the positions
that agree. Reconstructions change in nothing but this similarity. Where cameras are too close
together for the error of GPS, or on a line, about which they could turn, the frame stays arbitrary.

Notation: N photographs; ``centers`` [N, 3] of their cameras in the model's frame; ``enu`` [N, 3],
metres east, north and up of an origin on the tangent plane of WGS84 there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64
from PIL import Image as PilImage

from splatseed.findings import Finding
from splatseed.similarity import Similarity, fit_similarity
from splatseed.text import counted, name_some

_IFD = 0x8825
_STATUS, _VOID, _ERROR = 9, "V", 31
_LATITUDE, _LONGITUDE, _ALTITUDE_REF, _ALTITUDE = 1, 3, 5, 6  # of the first two: N or S, E or W


@dataclass(frozen=True)
class GpsLimits:
    """When positions determine a frame."""

    min_photographs: int = 5
    triples: int = 500
    agreeing: float = 2.5
    """Distances from GPS, in medians, at which a position agrees: 3.9 standard deviations."""
    min_error: float = 0.3
    """Smallest assumed error along an axis, m: phones write hundredths of an arc second."""
    max_independent: int = 10
    """Positions whose errors count as independent, at most: those of successive ones are alike."""
    max_turn: float = 5.0
    """Largest standard error of the frame's axes, degrees; lengths are then known to 9%."""


LIMITS = GpsLimits()


class GpsPosition(NamedTuple):
    """Where a photograph was taken, by EXIF."""

    latitude: float  # degrees, north is positive
    longitude: float  # degrees, east is positive
    altitude: float  # m; NaN where unknown
    error: float = math.nan  # horizontal, m; NaN where unknown


@dataclass(frozen=True)
class GpsFrame:
    """The frame of a scene whose x is east, y north and z up, in metres."""

    latitude: float  # of the origin, degrees, WGS84, north is positive
    longitude: float  # degrees, east is positive
    altitude: float  # m, as in EXIF: mostly above sea level
    num_photographs: int  # whose GPS positions agree
    residual: float  # their median distance from the cameras, m
    turn_error: float  # standard error of the axes, degrees

    @property
    def origin(self) -> str:
        """The origin, to about 0.1 m."""
        north, east = "NS"[self.latitude < 0], "EW"[self.longitude < 0]
        return (
            f"{abs(self.latitude):.6f} {north}, {abs(self.longitude):.6f} {east}, "
            f"{self.altitude:.1f} m"
        )


def read_gps(image: PilImage.Image) -> GpsPosition | None:
    """Read the GPS position of an opened image; None without one, or if it is void or damaged."""
    with suppress(Exception):  # Pillow raises any exception for truncated tags
        tags = image.getexif().get_ifd(_IFD)
        latitude = _degrees(tags, _LATITUDE, "NS", 90)
        longitude = _degrees(tags, _LONGITUDE, "EW", 180)
        altitude, error = (float(tags.get(tag, math.nan)) for tag in (_ALTITUDE, _ERROR))
        below = tags.get(_ALTITUDE_REF, 0)
        if (below[0] if isinstance(below, bytes) else int(below)) % 2:  # 1; in EXIF 3.0 also 3
            altitude = -altitude
        void = str(tags.get(_STATUS, "")).startswith(_VOID)
        if (latitude or longitude) and not void:  # some cameras write 0, 0 without a fix
            return GpsPosition(latitude, longitude, altitude, error if error > 0 else math.nan)
    return None


def _degrees(tags: Mapping[int, Any], reference: int, signs: str, limit: float) -> float:
    """Return an angle from degrees, minutes and seconds; raise an exception if there is none."""
    sign = 1 - 2 * signs.index(tags[reference][0].upper())
    angle = sum((float(part) / 60**i for i, part in enumerate(tags[reference + 1])), 0.0)
    if not 0 <= angle <= limit:
        raise ValueError(angle)
    return sign * angle


def align_to_gps(
    pycolmap: Any, model_dir: Path, folder: Path, positions: Mapping[str, GpsPosition]
) -> tuple[Path, GpsFrame | None, Finding]:
    """Move a model to the frame of its photographs' GPS positions, if these determine one.

    Args:
        pycolmap: The imported package.
        model_dir: The folder of the model, which stays as it is.
        folder: The folder to write the moved model to.
        positions: GPS positions by name of photograph.

    Returns:
        The folder of the resulting model (``model_dir`` if there is no frame), the frame, and the
        finding that describes it, or says why there is none.
    """
    model = pycolmap.Reconstruction(model_dir)
    posed = {im.name: im.projection_center() for im in model.images.values() if im.has_pose}
    names = sorted(n for n in posed.keys() & positions.keys() if positions[n].altitude < math.inf)
    if len(names) < LIMITS.min_photographs:
        text = f"{len(names)} photographs with a pose have a GPS position with altitude, and "
        return model_dir, None, _undetermined(f"{text}{LIMITS.min_photographs} are needed.")
    places = np.array([positions[name] for name in names])
    if np.ptp(places[:, 1]) > 180:  # on both sides of the antimeridian
        places[:, 1] %= 360
    latitude, longitude, altitude = origin = np.median(places[:, :3], axis=0).tolist()
    enu = pycolmap.GPSTransform().ellipsoid_to_enu(places[:, :3], *origin)
    centers = np.array([posed[name] for name in names])
    found = fit_robustly(centers, enu)
    if found is None:
        text = "the cameras, or their GPS positions, are in one place or on one line."
        return model_dir, None, _undetermined(text)
    enu_from_model, agrees = found
    moved, distances = enu_from_model.points(centers), residuals(enu_from_model, centers, enu)
    stated = places[agrees, 3]
    stated = stated[~np.isnan(stated)]
    error = max(
        float(np.sqrt(np.square(distances[agrees]).sum() / (3 * agrees.sum() - 7))),
        float(np.median(stated)) / math.sqrt(2) if len(stated) else 0.0,
        LIMITS.min_error,
    )
    turn = turn_error(moved[agrees], error)
    if turn > LIMITS.max_turn:
        text = (
            f"positions that err by {error:.2g} m along an axis leave its axes uncertain by "
            f"{turn:.2g} degrees (at most {LIMITS.max_turn:g} would do): the cameras are too close "
            "together, or nearly on a line."
        )
        return model_dir, None, _undetermined(text)
    model.transform(pycolmap.Sim3d(enu_from_model.matrix))
    folder.mkdir()
    model.write(folder)
    residual = float(np.median(distances[agrees]))
    longitude = (longitude + 180) % 360 - 180
    frame = GpsFrame(latitude, longitude, altitude, int(agrees.sum()), residual, turn)
    others = tuple(name for name, good in zip(names, agrees, strict=True) if not good)
    number = counted(model.num_reg_frames(), "photograph")  # not of each panorama's six
    text = (
        f"By the GPS of {agrees.sum()} of {number}, the scene is in metres, x east, y north, z up. "
        f"Its origin is at {frame.origin}. Cameras are {residual:.2g} m from their GPS positions "
        f"(median), so that its axes are known to {turn:.2g} degrees."
    )
    if others:
        text += f" Not used are the positions of {name_some(others, 3)}, which contradict them."
    return folder, frame, Finding("gps-frame", text, "info", subjects=others)


def _undetermined(why: str) -> Finding:
    return Finding("gps-frame", f"GPS does not determine the scene's frame: {why}", "info")


def fit_robustly(
    centers: Float64[np.ndarray, "N 3"], enu: Float64[np.ndarray, "N 3"]
) -> tuple[Similarity, Bool[np.ndarray, " N"]] | None:
    """Fit the similarity from centres to positions, of which nearly half may be wrong.

    Returns it, and which positions agree; None if no three determine one.
    """
    rng, lowest, found = np.random.default_rng(0), math.inf, None
    for _ in range(LIMITS.triples):
        three = rng.choice(len(centers), 3, replace=False)
        if (fit := fit_similarity(centers[three], enu[three])) is not None:
            median = float(np.median(residuals(fit, centers, enu)))
            lowest, found = min((lowest, found), (median, fit), key=lambda each: each[0])
    if found is None:
        return None
    for _ in range(3):
        distances = residuals(found, centers, enu)
        agrees = distances <= max(LIMITS.agreeing * float(np.median(distances)), LIMITS.min_error)
        found = fit_similarity(centers[agrees], enu[agrees]) or found
    return found, agrees


def residuals(
    enu_from_model: Similarity, centers: Float64[np.ndarray, "N 3"], enu: Float64[np.ndarray, "N 3"]
) -> Float64[np.ndarray, " N"]:
    """Return the distances between cameras and their GPS positions, m."""
    return np.asarray(np.linalg.norm(enu_from_model.points(centers) - enu, axis=1))


def turn_error(centers: Float64[np.ndarray, "N 3"], error: float) -> float:
    """Return the standard error of the turn about the cameras' longest axis, degrees.

    It is the largest of the three axes. ``error`` is that of a position along an axis, m.
    """
    spreads = np.linalg.svd(centers - centers.mean(axis=0), compute_uv=False) / math.sqrt(
        len(centers)
    )
    independent = min(len(centers), LIMITS.max_independent)
    across = math.hypot(*spreads[1:]) * math.sqrt(independent)
    return math.degrees(error / across) if across else math.inf
