"""The lists of a TUM RGB-D capture, and matching them by time.

Notation: times are seconds, sorted; ``quats`` are unit wxyz of ``world_from_cam`` (the files have
xyzw).
Promise: a line that is neither a comment nor a record is a ``SceneFormatError`` that names it;
records that are not finite (tracking was lost) are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, Int64

from splatseed.errors import SceneFormatError
from splatseed.io.rgbd.capture import read_text

TOLERANCE = 0.02
"""Seconds by which an image, its depth and its pose may differ: the benchmark's own."""

_NORM_SLACK = 0.01  # of a quaternion, which is written with four digits


class Track(NamedTuple):
    """The camera's trajectory.

    Args:
        times: Seconds, float64 [M], sorted.
        centers: World coordinates, float64 [M, 3].
        quats: Unit wxyz of ``world_from_cam``, float64 [M, 4].
    """

    times: Float64[np.ndarray, " M"]
    centers: Float64[np.ndarray, "M 3"]
    quats: Float64[np.ndarray, "M 4"]


def read_list(path: Path) -> tuple[Float64[np.ndarray, " N"], tuple[str, ...]]:
    """The times and the relative paths of ``rgb.txt`` or ``depth.txt``, sorted by time.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: A line is not a time and a path inside the folder.
    """
    records = []
    for where, words in _lines(path, 2):
        name = PurePosixPath(words[1].replace("\\", "/"))
        time = _numbers(where, words[:1])[0]
        if name.is_absolute() or ".." in name.parts or not name.name or not np.isfinite(time):
            raise _bad(where, "a time and a path inside the folder", " ".join(words))
        records.append((time, str(name)))
    records.sort()
    return np.array([time for time, _ in records], np.float64), tuple(name for _, name in records)


def read_track(path: Path) -> Track:
    """The poses of ``groundtruth.txt`` that are finite, sorted by time.

    Raises:
        SceneNotFoundError: There is no such file.
        SceneFormatError: A line is not a time, a position and a unit quaternion.
    """
    rows = []
    for where, words in _lines(path, 8):
        row = _numbers(where, words)
        if not np.isfinite(row).all():
            continue
        if abs(np.linalg.norm(row[4:]) - 1) > _NORM_SLACK:
            raise _bad(where, "a quaternion of length 1", " ".join(words[4:]))
        rows.append(row)
    table = np.array(sorted(rows), np.float64).reshape(-1, 8)
    quats = table[:, [7, 4, 5, 6]]
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return Track(table[:, 0], table[:, 1:4], quats / norms)


def nearest_in_time(
    times: Float64[np.ndarray, " M"], wanted: Float64[np.ndarray, " N"]
) -> Int64[np.ndarray, " N"]:
    """Index of the sorted ``times`` nearest to each wanted one; -1 beyond the tolerance."""
    if not len(times):
        return np.full(len(wanted), -1, np.int64)
    before, after = _around(times, wanted)
    earlier = np.abs(times[before] - wanted) <= np.abs(times[after] - wanted)
    nearest = np.where(earlier, before, after)
    return np.where(np.abs(times[nearest] - wanted) <= TOLERANCE, nearest, -1)


def poses_at(
    track: Track, times: Float64[np.ndarray, " N"]
) -> tuple[Float64[np.ndarray, "N 4"], Float64[np.ndarray, "N 3"], Bool[np.ndarray, " N"]]:
    """Quaternions [N, 4] and centres [N, 3] at given times, and which are known [N].

    Between two records that are near enough a pose is interpolated, else it is the nearest one's.
    """
    if not len(track.times):
        return np.ones((len(times), 4)), np.zeros((len(times), 3)), np.zeros(len(times), bool)
    nearest = nearest_in_time(track.times, times)
    before, after = _around(track.times, times)
    span = track.times[after] - track.times[before]
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (times - track.times[before]) / span
    between = (share >= 0) & (share <= 1) & (span <= 2 * TOLERANCE)
    share = np.where(between, share, nearest == after)[:, None]
    start, end = track.quats[before], track.quats[after]
    end = end * np.where((start * end).sum(axis=1) < 0, -1, 1)[:, None]  # the shorter way round
    quats = (1 - share) * start + share * end  # as good as slerp over hundredths of a second
    centers = (1 - share) * track.centers[before] + share * track.centers[after]
    return quats / np.linalg.norm(quats, axis=1, keepdims=True), centers, nearest >= 0


def _around(
    times: Float64[np.ndarray, " M"], wanted: Float64[np.ndarray, " N"]
) -> tuple[Int64[np.ndarray, " N"], Int64[np.ndarray, " N"]]:
    """The records before and after each wanted time; the same one at the ends."""
    after = np.searchsorted(times, wanted)
    last = len(times) - 1
    return np.clip(after - 1, 0, last), np.clip(after, 0, last)


def _lines(path: Path, words: int) -> Iterator[tuple[str, list[str]]]:
    """The location and the words of each record."""
    for number, line in enumerate(read_text(path).splitlines(), 1):
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        where = f"{path} line {number}"
        if len(fields) != words:
            raise _bad(where, f"{words} words", f"{len(fields)}")
        yield where, fields


def _numbers(where: str, words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as error:
        raise _bad(where, "numbers", str(error)) from None


def _bad(where: str, expected: str, found: str) -> SceneFormatError:
    return SceneFormatError(f"{expected} in {where}", found=found[:200], fix="Correct the line.")
