"""Colours of points without any, from the photographs that see them.

Some programs write models and clouds without colours: all points are black, white or grey. Points
*lack colours* if nearly all have the same one, or if many are black: those are. Promise: positions
stay, and points of another colour keep it.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64, UInt8

from splatseed.findings import Finding
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Note, Progress
from splatseed.scene import Scene
from splatseed.seeding.photo_methods import MAX_SIZE, photographed, read_views

_MIN_POINTS = 10  # points of one colour that are no chance
ALIKE = 0.99  # share of the points from which on all lack colours
_BLACK = 0.25  # share of exactly black points, if they lack colours; dark scenes have up to 0.08
_LINEAR_AT, _LINEAR_GAIN = 16.0, 0.5
"""Median difference from the photographs, in grey levels, from which on colours may be linear, and
the part of it that must be left after they are encoded as sRGB."""
_LINEAR = np.arange(256) / 255.0
_SRGB = np.where(_LINEAR <= 0.0031308, 12.92 * _LINEAR, 1.055 * _LINEAR ** (1 / 2.4) - 0.055)


def lacks_color(rgb: UInt8[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Return which points lack a colour: none, many that are black, or nearly all."""
    code = rgb.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    codes, counts = np.unique(code, return_counts=True)
    if len(rgb) < _MIN_POINTS:
        return np.zeros(len(rgb), np.bool_)
    if counts.max() >= ALIKE * len(rgb):
        return np.asarray(code == codes[counts.argmax()])
    black = np.asarray(code == 0)
    return black if black.mean() >= _BLACK else np.zeros(len(rgb), np.bool_)


def encoded_if_linear(
    rgb: UInt8[np.ndarray, "N 3"], seen: UInt8[np.ndarray, "N 3"], sample: np.ndarray
) -> UInt8[np.ndarray, "N 3"] | None:
    """Return colours encoded as sRGB (IEC 61966-2-1), if photographs show that they are linear.

    ``seen`` are the photographs' colours of the rows ``sample``. Returns None if they fit as well
    as they are.
    """
    encoded = np.rint(255.0 * _SRGB).astype(np.uint8)[rgb]
    before, after = (
        float(np.median(np.abs(colors[sample].astype(np.int16) - seen)))
        for colors in (rgb, encoded)
    )
    is_linear = before >= _LINEAR_AT and after <= _LINEAR_GAIN * before
    return np.asarray(encoded) if is_linear else None


def missing_color_findings(scene: Scene) -> list[Finding]:
    """Report points that lack colours, for a scene whose photographs have them."""
    lacking = _rows_without(scene.points)
    if not len(lacking) or not scene.has_photographs:
        return []
    color = tuple(scene.points.rgb[lacking[0]].tolist())
    text = f"{len(lacking):,} points have the same colour, {color}: seeds take theirs from the "
    text += "photographs."
    return [Finding("colors-of-photographs", text, "info")]


def with_colors(scene: Scene, test_every: int, note: Note, progress: Progress) -> Scene:
    """Return the scene with points that lack colours in those of the photographs that see them.

    Points that no photograph sees become grey. Test views, every ``test_every``-th (0: none), are
    not read. ``note`` gets a finding if there are such points.
    """
    findings = missing_color_findings(scene)
    if not findings:
        return scene
    # Loads Numba, for which `--help` would wait.
    from splatseed.seeding.clouds.photo_consistency import colors_of_points  # noqa: PLC0415

    lacking = _rows_without(scene.points)
    views = read_views(scene, photographed(scene, test_every), MAX_SIZE, progress)
    rgb = scene.points.rgb.copy()
    rgb[lacking] = colors_of_points(views, scene.points.xyz[lacking], progress)
    for finding in findings:
        note(finding)
    return scene.with_points(scene.points.replace(rgb=rgb))


def _rows_without(points: PointCloud) -> Int64[np.ndarray, " M"]:
    """Return the rows of the finite originals that lack a colour."""
    rows = np.flatnonzero((points.source == ORIGINAL) & points.finite)
    return np.asarray(rows[lacks_color(points.rgb[rows])])
