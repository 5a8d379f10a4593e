"""What ``splatseed info`` shows of a scene: rows of a table, and facts for ``--json``."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

from splatseed.camera import Intrinsics
from splatseed.commands.capture_check import PoseCheck
from splatseed.commands.next_steps import Planned
from splatseed.io.load import depths_beside
from splatseed.scene import Image, Scene
from splatseed.seeding import diagnostics
from splatseed.seeding.advice import Advice
from splatseed.seeding.photo_methods import Auto
from splatseed.text import counted

KINDS_SHOWN = 3
"""Kinds of cameras listed; collections of photographs from the web have one per photograph."""


def scene_facts(scene: Scene) -> dict[str, Any]:
    """Return the source and the contents of a scene, for ``--json``."""
    train, test = _parts(scene)
    return {
        "format": scene.source.format,
        "root": str(scene.source.root),
        "images": len(scene.images),
        "train_images": len(train),
        "test_images": len(test),
        "photographs": scene.has_photographs,
        "few_photographs": _has_pixel_seeds(scene),
        "cameras": [
            {"id": c.camera_id, "model": c.model, "width": c.width, "height": c.height}
            for c in _cameras(scene)
        ],
        "depth_maps": 0 if scene.depths is None else len(scene.depths),
        "depth_maps_beside": len(depths_beside(scene) or ()),
    }


def _parts(scene: Scene) -> list[list[Image]]:
    """Return the images to train on and to test; if any has a photograph, those that have one."""
    some = any(image.has_photograph for image in scene.images)
    parts = scene.split(scene.default_test_every)
    return [[image for image in part if image.has_photograph or not some] for part in parts]


def _cameras(scene: Scene) -> list[Intrinsics]:
    """Return all cameras, in pixels of their photographs, in the order of their records."""
    used: dict[int, dict[Intrinsics, None]] = {}
    for image in scene.images:
        used.setdefault(image.lens.camera_id, {})[image.lens] = None
    return [c for record in scene.intrinsics for c in used.get(record.camera_id, (record,))]


def source_rows(scene: Scene) -> list[tuple[str, str]]:
    """Return rows on the format, the cameras and the images."""
    sizes = Counter(f"{c.model} {c.width}x{c.height}" for c in _cameras(scene))
    cameras = [f"{count:,} {kind}" for kind, count in sizes.most_common(KINDS_SHOWN)]
    if len(sizes) > KINDS_SHOWN:
        cameras.append(f"{len(sizes) - KINDS_SHOWN:,} more kinds")
    train, test = _parts(scene)
    by = f", by its {scene.listed.origin}" if scene.listed else ""
    images = f"{len(scene.images):,} ({len(train):,} to train, {len(test):,} to test{by})"
    rows = [
        ("format", scene.source.format),
        ("cameras", ", ".join(cameras) or "none"),
        ("images", images if scene.images else "none"),
    ]
    few = _has_pixel_seeds(scene)
    if few is not False:
        seeds = "method auto gives every second pixel a seed"
        unless = "" if few else ", unless the photographs are close together"
        rows.append(("few photographs", f"{seeds}{unless} (docs/few_photographs.md)"))
    return rows


def _has_pixel_seeds(scene: Scene) -> bool | None:
    """Whether method auto takes the training photographs for few; None if it depends on seeds."""
    if not scene.has_photographs:
        return False
    from splatseed.seeding.few_photographs import MAX_PHOTOGRAPHS

    cameras = [image.camera for image in scene.split(scene.default_test_every)[0]]
    if not 2 <= len(cameras) <= MAX_PHOTOGRAPHS:
        return False
    points = scene.points.originals
    few = Auto().fills_pixels(scene, cameras, points.xyz[points.finite])
    return few or (False if len(points) or Auto().uses_maps(scene) else None)


def depth_map_rows(
    maps: diagnostics.DepthMapStatistics | None, beside: int
) -> list[tuple[str, str]]:
    """Return a row on depth maps; ``beside`` lie beside the photographs."""
    if maps is None:
        there = f"{beside:,} beside the photographs; method depth aligns them with the points"
        return [("depth maps", there)] * (beside > 0)
    size = f"{maps.num_maps:,} of {maps.width} x {maps.height} pixels"
    if maps.confidence is not None:
        low, medium, high = maps.confidence
        size += f", of high confidence at {high:.0%}, medium {medium:.0%}, low {low:.0%}"
    elif maps.known < 1:
        size += f", with a depth at {maps.known:.0%}"
    return [("depth maps", f"{size}; method auto uses them" if maps.in_scene_units else size)]


def cloud_rows(cloud: diagnostics.CloudStatistics) -> list[tuple[str, str]]:
    """Return rows on the points."""
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
        ("float32 resolution", f"{cloud.resolution:.2g}"),
    ]


def track_rows(tracks: diagnostics.TrackStatistics | None) -> list[tuple[str, str]]:
    """Return rows on the tracks."""
    if tracks is None:
        return [("tracks", "none")]

    def summary(mean: float, percentiles: tuple[float, ...], style: str) -> str:
        spread = " ".join(f"{x:{style}}" for x in percentiles)
        return "unknown" if math.isnan(mean) else f"mean {mean:{style}}, 5/25/50/75/95% {spread}"

    return [
        ("track length, images", summary(tracks.mean_length, tracks.length, ".3g")),
        ("reprojection error, px", summary(tracks.mean_error, tracks.error, ".3f")),
    ]


def photograph_rows(
    regions: diagnostics.EmptyRegions | None,
    poses: PoseCheck | None,
    masks: diagnostics.MaskStatistics,
) -> list[tuple[str, str]]:
    """Return rows on what photographs show of points and poses."""
    rows = []
    if masks.images:
        share = f"{masks.share:.0%} of their pixels, on average, do not count"
        rows.append(("masks", f"of {counted(masks.images, 'photograph')}; {share}"))
    if regions is not None:
        worst = f"{regions.worst:.0%} in {regions.worst_name}"
        grid = f"(of cells, {diagnostics.EMPTY_CELLS} along the longer side)"
        rows.append(("image area without points", f"{regions.mean:.0%} on average, {worst} {grid}"))
    if poses and (poses.error is not None or not poses.doubts):
        from splatseed.checkup.poses import agreement_findings

        few = bool(agreement_findings(poses.agreement))
        agreed = f"at {poses.agreement:.0%} of the pixels compared: {'few' if few else 'enough'}"
        error = poses.error
        miss = "unknown: too few corners are found again" if error is None else error.verdict
        rows += [("photographs agree", agreed), ("pose error", miss)]
    return rows


def advice_rows(advice: Advice, planned: Planned) -> list[tuple[str, str]]:
    """Return the advice, its reasons, and the training it is for."""
    size = f" ({planned.rho})" if planned.rho else ""
    plan = f"{planned.budget:,} Gaussians at most{size}, {planned.max_steps:,} steps, strategy"
    rows = [("planned", f"{plan} {planned.strategy.name}"), ("advice", advice.sentence)]
    if advice.measured.layout:
        rows.insert(0, ("cameras stand", advice.measured.layout))
    return rows + [("" if i else "why", reason) for i, reason in enumerate(advice.reasons)]
