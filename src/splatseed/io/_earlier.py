"""Scenes that splatseed wrote before: which of their points are originals.

Point files have no place for a point's origin, but ``splatseed.json`` beside them says how many of the
points, the first ones, were in the input. New points must never be taken for originals: upsampling an
output again starts from its originals and replaces what was made from them.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from splatseed.io.staging import MANIFEST
from splatseed.pointcloud import GENERATED
from splatseed.scene import Scene, Tracks

__all__ = ["mark_generated"]


def mark_generated(scene: Scene) -> Scene:
    """The scene with ``source`` set as its manifest says; unchanged where that does not fit."""
    total = len(scene.points)
    num_original = _num_original(scene.source.root / MANIFEST, total) if scene.source else total
    if num_original == total:
        return scene
    source = np.full(total, GENERATED, np.uint8)
    source[:num_original] = 0
    warning = (
        f"{total - num_original:,} of the points were added by splatseed to {num_original:,} originals;"
        " upsampling again would replace them."
    )
    return replace(
        scene,
        points=scene.points.replace(source=source),
        tracks=None if scene.tracks is None else _first(scene.tracks, num_original),
        warnings=(*scene.warnings, warning),
    )


def _num_original(manifest: Path, total: int) -> int:
    """How many of ``total`` points are originals; all unless a manifest of this cloud says so."""
    try:
        facts = json.loads(manifest.read_text(encoding="utf-8"))
        num_points, num_original = facts["num_points"], facts["num_original"]
    except (OSError, ValueError, TypeError, KeyError):
        return total  # no manifest, or somebody else's file of that name
    fits = num_points == total and isinstance(num_original, int) and 0 < num_original < total
    return num_original if fits else total


def _first(tracks: Tracks, n: int) -> Tracks:
    """The tracks of the first ``n`` points."""
    end = int(tracks.offsets[min(n, len(tracks))])
    return Tracks(
        tracks.point_ids[:n],
        tracks.xyz[:n],
        tracks.errors[:n],
        tracks.offsets[: n + 1],
        tracks.image_ids[:end],
        tracks.point2d_idx[:end],
    )
