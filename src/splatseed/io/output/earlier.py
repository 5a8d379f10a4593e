"""Scenes that splatseed wrote: which points are originals, and what is known about the others.

Point files have no field for a point's origin, but ``splatseed.json`` beside them says how many of
the first points were in the input, and ``seeds.npz`` which method made each of the others. New
points must never be taken for originals: upsampling an output again starts from its originals and
replaces the points made from them. If no point at all is an original, all count as such.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatseed.io.output.seeds_npz import read_seeds
from splatseed.io.output.staging import MANIFEST, kind_of
from splatseed.pointcloud import GENERATED, ORIGINAL
from splatseed.scene import Scene

__all__ = ["number_of_originals", "recall_seeds", "saw_all_photographs", "was_upsampled"]


def recall_seeds(scene: Scene) -> Scene:
    """The scene with the attributes from ``seeds.npz`` and its manifest, if they match."""
    if scene.source is None or not len(scene.points):
        return scene
    known = read_seeds(scene.source.root, scene.points)
    source = known.points.source if known.has_source else _by_manifest(scene)
    points = known.points.replace(source=source if (source == ORIGINAL).any() else None)
    notes = (known.warning,) if known.warning else ()
    # Tracks belong to the first points, and a new point has none.
    first_new = int(np.append(points.source != ORIGINAL, True).argmax())
    tracks = scene.tracks
    if tracks is not None:
        tracks = tracks.select(np.arange(len(tracks)) < first_new)
    return replace(scene, points=points, tracks=tracks, warnings=(*scene.warnings, *notes))


def _by_manifest(scene: Scene) -> UInt8[np.ndarray, " N"]:
    """The origin of each point, from the number of originals in the manifest."""
    root = scene.source.root if scene.source else Path()
    total = len(scene.points)
    source = np.full(total, GENERATED, np.uint8)
    source[: _num_original(root / MANIFEST, total)] = ORIGINAL
    return source


def number_of_originals(root: Path, total: int) -> int:
    """How many of the points of a file are originals, by the manifest beside it.

    Args:
        root: The file's folder.
        total: Points of the file.
    """
    return _num_original(root / MANIFEST, total)


def was_upsampled(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made or thinned these points."""
    written = scene.source is not None and kind_of(scene.source.root) == "upsample"
    return written or scene.points.num_original < len(scene.points)


def saw_all_photographs(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made new points from photographs and held none out."""
    if scene.source is None or kind_of(scene.source.root) != "upsample":
        return False
    try:
        facts = json.loads((scene.source.root / MANIFEST).read_text(encoding="utf-8"))
        return bool(facts["num_new"]) and facts["parameters"]["hold_out"] == 0
    except (OSError, ValueError, TypeError, KeyError):
        return False  # not made from photographs


def _num_original(manifest: Path, total: int) -> int:
    """How many of ``total`` points are originals; all unless a manifest for this cloud says so."""
    try:
        facts = json.loads(manifest.read_text(encoding="utf-8"))
        num_points, num_original = facts["num_points"], facts["num_original"]
    except (OSError, ValueError, TypeError, KeyError):
        return total  # no manifest, or somebody else's file of that name
    fits = num_points == total and isinstance(num_original, int) and 0 < num_original < total
    return num_original if fits else total
