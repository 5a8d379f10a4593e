"""Scenes that splatseed wrote: which points are originals, and what is known about the others.

Point files have no field for a point's origin, but ``splatseed.json`` beside them says how many of
the first points were in the input, and ``seeds.npz`` which method made each of the others. New
points must never be taken for originals: upsampling an output again starts from its originals and
replaces the points made from them.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from splatseed.io.output.seeds_npz import SEEDS, read_seeds
from splatseed.io.staging import MANIFEST, read_manifest, write_json
from splatseed.pointcloud import GENERATED, ORIGINAL
from splatseed.scene import Scene

UPSAMPLED = "upsampled"
"""Where the manifest of an undistorted scene holds that of the points."""


def recall_seeds(scene: Scene) -> Scene:
    """The scene with the attributes from ``seeds.npz`` and its manifest, if they match."""
    if scene.source is None or not len(scene.points):
        return scene
    known = read_seeds(scene.source.root, scene.points)
    source = known.points.source if known.has_source else _by_manifest(scene)
    points = known.points.replace(source=source)
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
    source[: number_of_originals(root, total)] = ORIGINAL
    return source


def number_of_originals(root: Path, total: int) -> int:
    """How many of the points of a file are originals: all unless the manifest beside it says so.

    Args:
        root: The file's folder.
        total: Points of the file.
    """
    facts = read_manifest(root)
    originals = facts.get("num_original")
    if facts.get("num_points") == total and isinstance(originals, int) and 0 <= originals < total:
        return originals
    return total


def was_upsampled(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made or thinned these points."""
    return upsampling(scene) is not None or scene.points.num_original < len(scene.points)


def saw_all_photographs(scene: Scene) -> bool:
    """Whether ``splatseed upsample`` made new points from photographs and held none out."""
    facts = upsampling(scene) or {}
    try:
        return bool(facts["num_new"]) and facts["parameters"]["hold_out"] == 0
    except (TypeError, KeyError):
        return False  # not made from photographs


def upsampling(scene: Scene) -> dict[str, Any] | None:
    """What ``splatseed upsample`` wrote about the scene's points; None if it did not make them.

    A scene that was undistorted since holds it, too.
    """
    if scene.source is None:
        return None
    facts = read_manifest(scene.source.root)
    if facts.get("command") == "upsample":
        return facts
    carried = facts.get(UPSAMPLED)
    return carried if isinstance(carried, dict) else None


def carry_seeds(scene: Scene, written: Path, folder: Path) -> None:
    """Let an undistorted scene remember where its points come from, and what is known of them.

    Args:
        scene: The scene that is undistorted.
        written: What ``write_scene`` made of it.
        folder: The undistorted scene, with the same points in the same order.

    Raises:
        OSError: A file cannot be written.
    """
    if (written / SEEDS).is_file():
        shutil.copyfile(written / SEEDS, folder / SEEDS)
    counts = {key: read_manifest(written)[key] for key in ("num_points", "num_original")}
    write_json(folder / MANIFEST, {**counts, UPSAMPLED: upsampling(scene)})
