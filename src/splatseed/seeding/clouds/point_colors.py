"""Colours of points without any, from the photographs that see them.

Some programs write models and clouds without colours: all points are black, white or grey. Points
*lack colours* if nearly all have the same one. Promise: positions stay, and points of another
colour keep it.
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
_ALIKE = 0.99  # share of the points that have the same colour, if they lack colours


def lacks_color(rgb: UInt8[np.ndarray, "N 3"]) -> Bool[np.ndarray, " N"]:
    """Return which points lack a colour: none, or nearly all."""
    code = rgb.astype(np.int64) @ np.array([1 << 16, 1 << 8, 1])
    codes, counts = np.unique(code, return_counts=True)
    if len(rgb) < _MIN_POINTS or counts.max() < _ALIKE * len(rgb):
        return np.zeros(len(rgb), np.bool_)
    return np.asarray(code == codes[counts.argmax()])


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
