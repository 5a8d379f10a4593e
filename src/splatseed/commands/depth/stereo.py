"""``splatseed depth --stereo``: maps from the photographs alone, plain or as a COLMAP workspace."""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from splatseed.commands.depth.next_steps import after_stereo, look
from splatseed.commands.depth.options import Options
from splatseed.commands.planned import Planned
from splatseed.console import OUT, StageClock, print_commands, print_note, stage_display
from splatseed.io import load_scene
from splatseed.io.dense import (
    DenseReport,
    check_dense_scene,
    write_dense_maps,
    write_dense_workspace,
)
from splatseed.io.photograph import warnings_but_lens
from splatseed.io.staging import check_output
from splatseed.literal import quoted, visible
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import is_distorted
from splatseed.train.schedule import FULL_RUN

if TYPE_CHECKING:
    from splatseed.depth.stereo import StereoMap

NAMES_SHOWN = 5
PICTURE = "preview_maps.png"
PACKAGES = ("splatseed", "numba", "numpy", "pillow", "scipy")
MIN_PIXELS = 3
"""Photographs that must confirm a point fused by COLMAP. Its default of 5 suits unconfirmed maps;
our pixels are confirmed already, and few views see the borders."""


def run_stereo(options: Options) -> None:
    """Run stereo with these options."""
    start = time.perf_counter()
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        check_output(
            options.output,
            kind="depth",
            overwrite=options.overwrite,
            protect=[options.scene],
        )
        if options.colmap:
            check_dense_scene(scene, undistorts=True)
        maps = _maps(scene, options, clock)
        report = _write(scene, maps, options, clock)
        if options.preview:
            _draw(options, scene, maps, clock)
    _summarise(options, scene, maps, report, time.perf_counter() - start)


def provenance(options: Options, packages: Sequence[str]) -> dict[str, object]:
    """How maps were made, for ``splatseed.json``."""
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    given = {name: value for name, value in asdict(options).items() if value is not None}
    return {"command": "depth", "options": given, "versions": versions}


def _maps(scene: Scene, options: Options, clock: StageClock) -> tuple[StereoMap, ...]:
    """The maps, by stereo's own defaults where an option is left out."""
    from splatseed.depth.stereo import stereo_depths  # noqa: PLC0415  (loads little)

    names = ("max_size", "grid")
    given = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    return stereo_depths(scene, progress=clock, **given)


def _write(
    scene: Scene, maps: Sequence[StereoMap], options: Options, clock: StageClock
) -> DenseReport:
    how: dict[str, Any] = {
        "overwrite": options.overwrite,
        "provenance": provenance(options, PACKAGES),
        "progress": clock,
    }
    if not options.colmap:
        return write_dense_maps(scene, maps, options.output, **how)
    from splatseed.views.undistortion import undistort  # noqa: PLC0415  (Numba)

    return write_dense_workspace(scene, maps, options.output, undistort=undistort, **how)


def _draw(options: Options, scene: Scene, maps: Sequence[StereoMap], clock: StageClock) -> None:
    from splatseed.view.maps import preview_maps  # noqa: PLC0415  (Pillow)

    clock("preview", 0.0)
    preview_maps(scene, maps, options.output / PICTURE)
    clock("preview", 1.0)


def _summarise(
    options: Options,
    scene: Scene,
    maps: Sequence[StereoMap],
    report: DenseReport,
    seconds: float,
) -> None:
    OUT.print(
        f"{report.num_maps:,} depth maps of {_sizes(maps)}: {report.share_known:.0%} of their "
        f"pixels confirmed by other views, in {seconds:.1f} s, written to {visible(report.path)}",
        soft_wrap=True,
    )
    if options.preview:
        OUT.print(f"pictures: {visible(options.output / PICTURE)}", soft_wrap=True)
    for warning in warnings_but_lens(scene):
        print_note(warning)
    if report.empty:
        more = len(report.empty) - NAMES_SHOWN
        shown = ", ".join(report.empty[:NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")
        print_note(f"no other view confirms any pixel of: {shown}")
    if is_distorted(scene) and not options.colmap:
        print_note(
            "the cameras have lens distortion, and these maps belong to the undistorted "
            "photographs: --colmap writes both, as a scene to continue with"
        )
    confirmed = sum(np.count_nonzero(np.isfinite(each.depth)) for each in maps)
    print_commands("next", _next(options, scene, report.path, int(confirmed)))


def _sizes(maps: Sequence[StereoMap]) -> str:
    """Sizes of the smallest and the largest map, if they differ."""
    ordered = sorted((each.depth.shape for each in maps), key=math.prod)
    ends = dict.fromkeys((ordered[0], ordered[-1]))
    return " to ".join(f"{width} x {height}" for height, width in ends)


def _next(options: Options, scene: Scene, written: Path, confirmed: int) -> list[tuple[str, str]]:
    if not options.colmap:
        most = Planned.of(scene, None, FULL_RUN).most_seeds
        return after_stereo(options.scene, scene, written, confirmed, most)
    fused = quoted(written / "fused.ply")
    fuse = (
        f"colmap stereo_fusion --workspace_path {quoted(written)} --output_path {fused}"
        f" --StereoFusion.min_num_pixels {MIN_PIXELS}"
    )
    # The workspace is itself a scene, without distortion.
    return [look(written, written), ("fuse", fuse)]
