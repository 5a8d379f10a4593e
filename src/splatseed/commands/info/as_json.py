"""``splatseed info --json``: the same facts, for scripts.

Notation: lengths are in scene units; five numbers are percentiles 5, 25, 50, 75, 95. Promise:
standard output is one JSON object and nothing else; a number that JSON does not know is null; keys
are only ever added.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from splatseed.commands.info.poses import Poses
from splatseed.console import OUT
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import CloudStatistics, EmptyRegions, TrackStatistics

if TYPE_CHECKING:  # Numba, which takes a while to load, comes with it
    from splatseed.depth.alignment import Alignment


def print_json(
    scene: Scene,
    cloud: CloudStatistics,
    tracks: TrackStatistics | None,
    regions: EmptyRegions | None,
    poses: Poses | None,
    alignments: Mapping[str, Alignment] | None,
    problems: Sequence[str],
) -> None:
    """Print the facts that ``info`` shows."""
    train, test = scene.split()
    source = scene.source
    facts = {
        "format": source.format if source else None,
        "root": str(source.root) if source else None,
        "images": len(scene.images),
        "train_images": len(train),
        "test_images": len(test),
        "photographs": scene.has_photographs,
        "cameras": [
            {"id": c.camera_id, "model": c.model, "width": c.width, "height": c.height}
            for c in scene.intrinsics
        ],
        "depth_maps": 0 if scene.depths is None else len(scene.depths),
        "points": asdict(cloud),
        "tracks": None if tracks is None else asdict(tracks),
        "empty": None if regions is None else asdict(regions),
        "poses": None if poses is None else asdict(poses),
        "depth": None if alignments is None else {k: asdict(a) for k, a in alignments.items()},
        "problems": list(problems),
    }
    print(json.dumps(_known(facts), indent=2, allow_nan=False), file=OUT.file)


def _known(value: Any) -> Any:
    """The value, with null for numbers that are not finite."""
    if isinstance(value, Mapping):
        return {str(key): _known(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_known(each) for each in value]
    if isinstance(value, float) or hasattr(value, "item"):
        number = float(value)
        return number if math.isfinite(number) else None
    return value
