"""Choose frames of a film: sharp, spaced by motion, none from standing still.

Notation: the *motion* at a frame is the cumulative image motion since the first, in image widths:
measured in the pictures (``sfm``), or by ``pose_motion`` where poses are known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, Int64


@dataclass(frozen=True)
class FilmSettings:
    """How many frames of a recording are used."""

    max_photographs: int = 500
    """Of the photographs of a recording: a capture's usual number, at most; such apps save 30 or 60
    a second."""
    max_frames: int = 300
    """Of a video's frames: neighbours are then some centimetres apart in a walk of a minute, and
    the JPEGs of 1,920 x 1,440 pixels take 0.3 GB."""
    min_step: float = 0.02
    """Smallest image motion between chosen frames of a video, in widths."""
    distance: float = 2.0
    """Assumed distance of what a walking camera sees, metres: weighs steps against turns."""


FILM = FilmSettings()


def choose_frames(
    sharpness: Float64[np.ndarray, " F"],
    motion: Float64[np.ndarray, " F"],
    limit: int,
    min_step: float = FILM.min_step,
) -> Int64[np.ndarray, " P"]:
    """Choose the sharpest frame in each of at most ``limit`` equal intervals of motion.

    Intervals are ``min_step`` or longer.
    """
    if not len(motion):
        return np.empty(0, np.int64)
    step = max(motion[-1] / limit, min_step)
    interval = np.minimum((motion / step).astype(np.int64), max(int(motion[-1] / step) - 1, 0))
    order = np.lexsort((-sharpness, interval))
    return np.sort(order[np.unique(interval[order], return_index=True)[1]])


def pose_motion(
    rotations: Float64[np.ndarray, "F 3 3"], centers: Float64[np.ndarray, "F 3"], focal: float
) -> Float64[np.ndarray, " F"]:
    """Predict the cumulative image motion of a moving camera, in widths.

    A turn by an angle a moves the picture by about f a; a step s, seen at the assumed distance d,
    by f s / d.

    Args:
        rotations: World from camera, in order of time.
        centers: Of the cameras, metres.
        focal: Focal length f in image widths.
    """
    if not len(centers):
        return np.zeros(0)
    # Two rotations an angle a apart differ by sqrt(8) sin(a / 2) in the Frobenius norm.
    apart = np.linalg.norm(np.diff(rotations, axis=0), axis=(1, 2))
    turns = 2 * np.arcsin(np.minimum(apart / np.sqrt(8), 1.0))
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(focal * (turns + steps / FILM.distance))])


def choose_photographs(
    details: Float64[np.ndarray, " F"],
    rotations: Float64[np.ndarray, "F 3 3"],
    centers: Float64[np.ndarray, "F 3"],
    focal: float,
) -> Int64[np.ndarray, " P"]:
    """Choose among the photographs of a recording: all, unless there are too many.

    Args:
        details: Higher for the sharper of two photographs of the same content.
        rotations: As of ``pose_motion``, likewise the others.
        centers: Of the cameras.
        focal: In image widths.
    """
    if len(details) <= FILM.max_photographs:
        return np.arange(len(details))
    motion = pose_motion(rotations, centers, focal)
    return choose_frames(details, motion, FILM.max_photographs)
