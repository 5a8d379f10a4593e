"""What ``splatseed upsample`` prints and draws at its end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from splatseed.commands.upsample.trainers import tell_training
from splatseed.console import StageClock, print_note, print_pairs
from splatseed.io import WriteReport
from splatseed.pointcloud import PointCloud
from splatseed.progress import silent
from splatseed.scene import Image, Scene
from splatseed.seeding.photographs import MAX_SIZE, Stereo, photographed, read_views
from splatseed.seeding.upsampling import CELL
from splatseed.upsample import Upsampler
from splatseed.upsample.registry import origin_name

PAIR, ORIGINS, CELLS, MAPS = PICTURES = (
    "preview.png",
    "preview_origins.png",
    "preview_cells.png",
    "preview_maps.png",
)
PHOTOGRAPHS_SHOWN = 4
"""Photographs whose cells and maps are drawn."""


def write_previews(
    scene: Scene,
    seeds: PointCloud,
    name: str,
    method: Upsampler,
    seed: int,
    folder: Path,
    clock: StageClock,
) -> None:
    """Draw before and after; with photographs also origins, covered cells and stereo's maps.

    Args:
        scene: The scene, with the originals that were used.
        seeds: The points that were written.
        name: The name of the method that made them.
        method: That method.
        seed: The seed that was used.
        folder: Where the pictures go.
        clock: Told the stages.
    """
    from splatseed.view.clouds import preview_origins, preview_pair  # noqa: PLC0415  (Pillow)
    from splatseed.view.maps import preview_maps  # noqa: PLC0415  (Pillow)

    clock("preview", 0.0)
    preview_pair(scene, seeds, folder / PAIR, title=name)
    if scene.has_photographs:
        clock("preview", 0.4)
        preview_origins(scene, seeds, folder / ORIGINS)
        clock("preview", 0.6)
        _draw_cells(scene, seeds, folder / CELLS)
    if isinstance(method, Stereo):
        shown = _some_of(photographed(scene, method.hold_out))
        # Recomputed for the few that are shown: keeping all maps would take as much memory as the
        # views.
        maps = method.maps(scene, shown, seed, clock)
        clock("preview", 0.9)
        preview_maps(scene, maps, folder / MAPS)
    clock("preview", 1.0)


def _draw_cells(scene: Scene, seeds: PointCloud, path: Path) -> None:
    """Which cells of some photographs hold a point, before and after."""
    from splatseed.seeding.coverage import covered_cells  # noqa: PLC0415  (kernels load with use)
    from splatseed.view.clouds import CoveredView, preview_cells  # noqa: PLC0415  (Pillow)

    images = photographed(scene)
    views = read_views(scene, [images[i] for i in _some_of(images)], MAX_SIZE, silent)
    clouds = [cloud.xyz[cloud.finite] for cloud in (scene.points, seeds)]
    before, after = (covered_cells(views, xyz, CELL) for xyz in clouds)
    shown = [
        CoveredView(view.name, view.photograph, CELL, old, new)
        for view, old, new in zip(views, before, after, strict=True)
    ]
    preview_cells(shown, path)


def _some_of(images: Sequence[Image]) -> list[int]:
    """At most ``PHOTOGRAPHS_SHOWN``, evenly chosen."""
    places = np.linspace(0, len(images) - 1, min(PHOTOGRAPHS_SHOWN, len(images)))
    return [int(place) for place in np.unique(places.round())]


def summarise(
    read_from: Path,
    scene: Scene,
    seeds: PointCloud,
    report: WriteReport,
    seconds: Mapping[str, float],
    checks: Mapping[str, float],
    output: Path,
    files: Mapping[str, Sequence[str]],
) -> None:
    """Print the final table and the commands to run next.

    Args:
        read_from: Where the scene was read.
        scene: The scene as it was read.
        seeds: The points that were to be written.
        report: The report of writing.
        seconds: Seconds by stage.
        checks: ``far``, the share of new points far from any original; ``before`` and ``after``,
            the share of the photographs that the points cover.
        output: The scene folder.
        files: Names of further files in it, by label; those that are not there are left out.
    """
    written = seeds if len(seeds) == report.num_points else seeds.select(seeds.distinct)
    rows = [
        ("points in", f"{len(scene.points):,}"),
        ("points out", f"{report.num_points:,} ({_origins(written)})"),
        *_findings(checks),
        ("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in seconds.items())),
        ("output", str(output)),
    ]
    if linked := _linked(output, report):
        where = ", ".join(map(str, linked))
        rows.append(("images", f"linked, not copied: {where}; --copy-images to move OUT elsewhere"))
    if left_out := _left_out(scene, report):
        rows.insert(2, ("left out", left_out))
    for label, names in files.items():
        there = [output / name for name in names if (output / name).is_file()]
        rows += [("" if i else label, str(path)) for i, path in enumerate(there)]
    print_pairs("splatseed upsample", rows)
    for note in report.notes:
        print_note(note)
    if report.layout == "transforms":
        print_note(
            "The commands of gsplat's examples, graphdeco's code and LichtFeld are for COLMAP's "
            "layout: --format colmap."
        )
    tell_training(read_from, scene, output, report.layout)


def _linked(output: Path, report: WriteReport) -> list[Path]:
    """Where photographs lie that the output only links."""
    links = [Path(name) for name in report.files if (output / name).is_symlink()]
    photographs = [link for link in links if link.parts[0] == "images"] or links
    there = [(output / link).resolve() for link in photographs]
    return sorted({path if path.is_dir() else path.parent for path in there})


def _left_out(scene: Scene, report: WriteReport) -> str:
    """How many points of the input the output lacks, and why; empty if it has all."""
    thinned = scene.points.num_original - report.num_original
    parts = []
    if report.dropped_nonfinite + report.dropped_duplicates:
        parts += [f"{report.dropped_nonfinite:,} not finite"]
        parts += [f"{report.dropped_duplicates:,} duplicate"]
    if thinned > 0:
        parts += [f"{thinned:,} originals, for the budget, where they crowd"]
    return ", ".join(parts)


def _origins(seeds: PointCloud) -> str:
    """How many points have which origin."""
    codes, counts = np.unique(seeds.source, return_counts=True)
    return ", ".join(
        f"{count:,} {origin_name(int(code))}" for code, count in zip(codes, counts, strict=True)
    )


def _findings(checks: Mapping[str, float]) -> list[tuple[str, str]]:
    rows = []
    if "far" in checks:
        rows.append(
            ("far from any original", f"{checks['far']:.2%} of the new points, over 3 spacings")
        )
    if "after" in checks:
        share = f"{checks['after']:.1%} of the 8 x 8 pixel cells of the photographs have a point"
        rows.append(("covered", f"{share}; {checks['before']:.1%} before"))
    return rows
