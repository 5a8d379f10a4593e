"""What ``splatseed info --depth`` reports about a scene's depth maps, in words and numbers.

Promise: images are listed worst first: those left out, then by residual.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from splatseed.console import OUT, print_pairs, print_table
from splatseed.depth.alignment import Alignment
from splatseed.depthmap import DepthKind, DepthMap, DepthMaps
from splatseed.scene import Scene

ROWS = 12
"""Most images listed."""


def print_depth(title: str, scene: Scene, alignments: Mapping[str, Alignment]) -> None:
    """Print a summary, a table of images, and why some were left out.

    Args:
        title: Heading of the summary.
        scene: A scene with depth maps.
        alignments: The alignments of its images, by name.
    """
    example = _example(scene)
    kind: DepthKind = example.kind if example else "z"
    if not len(scene.points):  # nothing to compare with
        print_pairs(title, [("maps", _maps(scene, example, alignments))])
        return
    print_pairs(title, _summary(scene, example, alignments))
    ordered = sorted(alignments, key=lambda name: _badness(name, alignments[name]))
    listed = ordered[:ROWS]
    header = ["image", "points", "scale", *(["shift"] if kind == "inverse" else []), "residual"]
    rows = [_row(name, alignments[name], len(header)) for name in listed]
    some = "" if len(listed) == len(ordered) else f", the {len(listed)} worst; --json has all"
    print_table(f"depth against SfM points{some}", header, rows)
    _print_rejections(alignments, listed)


def _example(scene: Scene) -> DepthMap | None:
    """The first map of an image of the scene."""
    depths: DepthMaps | None = scene.depths
    names = (image.name for image in scene.images if depths is not None and image.name in depths)
    first = next(names, None)
    return None if first is None or depths is None else depths.read(first)


def _maps(scene: Scene, example: DepthMap | None, alignments: Mapping[str, Alignment]) -> str:
    """How many maps there are, and of which size and kind."""
    maps = f"{len(alignments):,} of {len(scene.images):,} images"
    if example is None:
        return maps
    return f"{maps}, the first {example.width} x {example.height}, kind {example.kind}"


def _summary(
    scene: Scene, example: DepthMap | None, alignments: Mapping[str, Alignment]
) -> list[tuple[str, str]]:
    used = [a for a in alignments.values() if a.rejected is None]
    rows = [
        ("maps", _maps(scene, example, alignments)),
        ("left out", f"{len(alignments) - len(used):,}"),
        ("SfM points per image", _spread((a.num_points for a in alignments.values()), ".0f")),
    ]
    if used:
        rows += [("scale", _spread((a.scale for a in used), ".4g"))]
        if example is not None and example.kind == "inverse":
            rows += [("shift", _spread((a.shift for a in used), ".4g"))]
        rows += [("residual", _spread((a.residual for a in used), ".2%"))]
    return rows


def _spread(values: Iterable[float], style: str) -> str:
    known = np.array([value for value in values if not math.isnan(value)])
    if not known.size:
        return "unknown"
    low, median, high = np.percentile(known, [5, 50, 95])
    return f"median {median:{style}}, 5/95% {low:{style}} {high:{style}}"


def _badness(name: str, alignment: Alignment) -> tuple[bool, float, str]:
    """Sort key: images left out first, then the largest residuals."""
    residual = -math.inf if math.isnan(alignment.residual) else -alignment.residual
    return alignment.rejected is None, residual, name


def _row(name: str, alignment: Alignment, columns: int) -> list[str]:
    numbers = [_number(alignment.scale, ".4g")]
    if columns == 5:
        numbers.append(_number(alignment.shift, ".4g") if numbers != ["-"] else "-")
    return [name, f"{alignment.num_points:,}", *numbers, _number(alignment.residual, ".2%")]


def _number(value: float, style: str) -> str:
    return "-" if math.isnan(value) else f"{value:{style}}"


def _print_rejections(alignments: Mapping[str, Alignment], listed: Sequence[str]) -> None:
    rejected = [(name, alignments[name].rejected) for name in listed]
    sentences = [f"{name}: {reason}" for name, reason in rejected if reason is not None]
    if not sentences:
        return
    OUT.print("\nleft out", style="bold")
    more = sum(a.rejected is not None for a in alignments.values()) - len(sentences)
    for sentence in [*sentences, *([f"and {more:,} more"] if more else [])]:
        OUT.print(f"  - {sentence}", soft_wrap=True)
