"""``splatseed info``: what is in a scene, and what is wrong with it."""

from __future__ import annotations

import math
import shlex
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatseed.commands._options import parse_options
from splatseed.console import OUT, print_commands, print_pairs, stage_display
from splatseed.diagnostics import (
    CloudStatistics,
    EmptyRegions,
    TrackStatistics,
    cloud_statistics,
    empty_regions,
    find_problems,
    track_statistics,
)
from splatseed.io import load_scene
from splatseed.scene import Scene

__all__ = ["run"]

KINDS_SHOWN = 3
"""Kinds of cameras listed; collections of photographs from the web have one a photograph."""


@dataclass(frozen=True)
class Options:
    """Show what is in a scene: cameras, images, points, tracks, and problems."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A COLMAP scene folder, a folder with transforms.json, or a .ply."""


def run(arguments: list[str]) -> None:
    """Do what the command line asks for."""
    options = parse_options(Options, "info", arguments)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        cloud = cloud_statistics(scene, clock)
        tracks = track_statistics(scene)
        regions = empty_regions(scene, clock)
    rows = [*_source_rows(scene), *_cloud_rows(cloud), *_track_rows(tracks), *_region_rows(regions)]
    print_pairs(str(options.scene), rows)
    problems = find_problems(scene, cloud, regions)
    OUT.print("\n[bold]problems[/bold]" if problems else "\nno problems found")
    for problem in problems:
        OUT.print(f"  - {problem}", soft_wrap=True, highlight=False, markup=False)
    if len(scene.points) or scene.images:
        print_commands("next", [("", _next_command(options.scene, scene))])


def _next_command(path: Path, scene: Scene) -> str:
    """What to run on the scene: points can be upsampled once there are some."""
    quoted = shlex.quote(str(path))
    if len(scene.points):
        return f"splatseed upsample {quoted} --method mls --ratio 8 -o OUT"
    images = scene.source.image_dir if scene.source else None
    photographs = "IMAGES" if images is None else shlex.quote(str(images))
    return f"splatseed sfm {photographs} --poses-from {quoted} -o OUT"


def _source_rows(scene: Scene) -> list[tuple[str, str]]:
    sizes = Counter(f"{c.model} {c.width}x{c.height}" for c in scene.intrinsics)
    cameras = [f"{count:,} {kind}" for kind, count in sizes.most_common(KINDS_SHOWN)]
    if len(sizes) > KINDS_SHOWN:
        cameras.append(f"{len(sizes) - KINDS_SHOWN:,} kinds more")
    train, test = scene.split()
    images = f"{len(scene.images):,} ({len(train):,} to train, {len(test):,} to test)"
    return [
        ("format", scene.source.format if scene.source else "memory"),
        ("cameras", ", ".join(cameras) or "none"),
        ("images", images if scene.images else "none"),
    ]


def _cloud_rows(cloud: CloudStatistics) -> list[tuple[str, str]]:
    rows = [("points", f"{cloud.num_points:,}"), ("not finite", f"{cloud.non_finite:,}")]
    if cloud.num_points == cloud.non_finite:  # nothing to measure
        return rows if cloud.num_points else [("points", "none")]
    low, high = (" ".join(f"{x:.4g}" for x in corner) for corner in (cloud.low, cloud.high))
    spacing = " ".join(f"{x:.4g}" for x in cloud.spacing if not math.isnan(x))
    return [
        *rows,
        ("duplicates", f"{cloud.duplicates:,}"),
        ("isolated", f"{cloud.isolated:,}"),
        ("spacing 5/25/50/75/95%", spacing or "none"),
        ("bounding box", f"{low}  to  {high}"),
        ("float32 step there", f"{cloud.resolution:.2g}"),
    ]


def _track_rows(tracks: TrackStatistics | None) -> list[tuple[str, str]]:
    if tracks is None:
        return [("tracks", "none")]
    return [
        ("track length, images", _spread(tracks.mean_length, tracks.length, ".3g")),
        ("reprojection error, px", _spread(tracks.mean_error, tracks.error, ".3f")),
    ]


def _spread(mean: float, percentiles: tuple[float, ...], style: str) -> str:
    spread = " ".join(f"{x:{style}}" for x in percentiles)
    return f"mean {mean:{style}}, 5/25/50/75/95% {spread}"


def _region_rows(regions: EmptyRegions | None) -> list[tuple[str, str]]:
    if regions is None:
        return []
    return [
        (
            "image area without points",
            f"{regions.mean:.0%} on average, {regions.worst:.0%} in {regions.worst_name}",
        )
    ]
