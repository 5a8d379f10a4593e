"""``splatseed depth``: a depth map per photograph, by stereo or by a network."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatseed.commands.next_steps import Source, after_depth, show_maps
from splatseed.commands.options import check_minimum, parse_options, refuse
from splatseed.console import OUT, add_results, print_next, print_note, print_pairs, stage_display
from splatseed.depth.stereo.maps import MIN_SIZE
from splatseed.depthmap import DepthKind
from splatseed.findings import Finding, without_kinds
from splatseed.io import dense, load_scene
from splatseed.io.exclusion import exclude
from splatseed.io.photograph_checks import with_photographs
from splatseed.io.seeds import facts_for_reading
from splatseed.io.staging import check_output
from splatseed.requirements import require, versions_of
from splatseed.scene import Scene
from splatseed.seeding.advice import is_distorted
from splatseed.text import name_some, quoted, visible
from splatseed.training.request import ExcludeChoice

if TYPE_CHECKING:  # stereo is loaded after the options are parsed
    from splatseed.depth.stereo import StereoMap

NAMES_SHOWN = 5
PACKAGES = ("splatseed", "transformers", "torch", "numba", "numpy", "pillow", "scipy")
MIN_PIXELS = 3
"""Photographs that must confirm a point fused by COLMAP. Its default of 5 suits unconfirmed maps;
our pixels are confirmed already, and few views see the borders."""


@dataclass(frozen=True)
class Options:
    """Make a depth map for each photograph, by stereo between the photographs or by a network.

    Nothing is downloaded.
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with photographs."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The folder of maps to write: one float32 .npy per image."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    model: Annotated[str | None, tyro.conf.arg(metavar="NAME|PATH")] = None
    """A depth network to run instead of stereo: a folder in transformers' format, or an id in
    Hugging Face's cache."""
    depth_kind: DepthKind | None = None
    """What the network predicts: planar depth, distance along the ray, or inverse depth; by default
    what its config.json implies."""
    colmap: bool = False
    """Write stereo's maps as a COLMAP dense workspace, which colmap stereo_fusion turns into a
    cloud."""
    max_size: int | None = None
    """Maximum pixels on the longer side of the photographs; by default 800 for stereo, whose maps
    are a quarter of that, and 1600 for a network."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "depth", arguments)
    check_minimum(options, MIN_SIZE, "max_size")
    refuse(
        (options.model is not None and options.colmap, "--colmap without --model", "both",
         "Leave out one of them: only stereo's maps have the normals that COLMAP fuses."),
        (options.model is None and options.depth_kind is not None, "--depth-kind with --model",
         "no --model", "Leave out --depth-kind: stereo's depth is planar."),
    )  # fmt: skip
    if options.model is not None:
        require("torch", "transformers")
    check_output(options.output, kind="depth", overwrite=options.overwrite, protect=[options.scene])
    if options.model is None:
        _run_stereo(options)
    else:
        _run_network(options, options.model)


def _provenance(options: Options) -> dict[str, object]:
    given = {name: value for name, value in asdict(options).items() if value is not None}
    return {"command": "depth", "options": given, "versions": versions_of(PACKAGES)}


def _run_network(options: Options, model: str) -> None:
    with stage_display() as clock:
        clock("read", 0.0)
        scene = exclude(load_scene(options.scene, require_points=False), options.exclude)
        clock("load network", 0.0)
        from splatseed.depth.monocular import estimate_depths, load_network

        network = load_network(model, depth_kind=options.depth_kind)
        kind, reason = network.meaning
        facts = {"kind": kind, "kind_because": reason, "device": network.device}
        size: dict[str, Any] = {} if options.max_size is None else {"max_size": options.max_size}
        report = estimate_depths(
            scene, network, options.output, overwrite=options.overwrite,
            provenance={**_provenance(options), **facts}, progress=clock, **size,
        )  # fmt: skip
    sizes, num = list(report.sizes.values()), len(report.sizes)
    rows = [
        ("network", model),
        ("device", network.device),
        ("predicts", f"{kind} ({reason})"),
        ("maps", f"{num:,} of {_size_range(sizes)}"),
        ("seconds", f"{report.seconds:.1f}, {report.seconds / num:.2f} per image"),
        ("output", str(options.output)),
    ]
    print_pairs("splatseed depth", rows)
    add_results(output=options.output, maps=num, seconds=report.seconds, network=model, **facts)
    print_note(*scene.findings)
    if report.flat:
        flat = name_some(report.flat, NAMES_SHOWN)
        text = f"the network predicted no depth (a constant map, or none) for: {flat}"
        print_note(Finding("no-depth", text, subjects=tuple(report.flat)))
    known = num * min(math.prod(size) for size in sizes)
    source = Source(options.scene, options.exclude)
    print_next(after_depth(source, scene, options.output, known, aligned=False))


def _run_stereo(options: Options) -> None:
    from splatseed.depth.stereo import stereo_depths
    from splatseed.photos.undistortion import undistort

    start = time.perf_counter()
    with stage_display() as clock:
        clock("read", 0.0)
        scene = exclude(load_scene(options.scene, require_points=False), options.exclude)
        scene = with_photographs(scene) if scene.images else scene
        if options.colmap:
            dense.check_dense_scene(scene, undistorts=True)
        size: dict[str, Any] = {} if options.max_size is None else {"max_size": options.max_size}
        maps = stereo_depths(scene, progress=clock, **size)
        how: dict[str, Any] = {
            "overwrite": options.overwrite,
            "provenance": {**_provenance(options), **facts_for_reading(scene)},
            "progress": clock,
        }
        if options.colmap:
            report = dense.write_dense_workspace(
                scene, maps, options.output, undistort=undistort, **how
            )
        else:
            report = dense.write_dense_maps(scene, maps, options.output, **how)
    _summarise_stereo(options, scene, maps, report, time.perf_counter() - start)


def _summarise_stereo(
    options: Options,
    scene: Scene,
    maps: Sequence[StereoMap],
    report: dense.DenseReport,
    seconds: float,
) -> None:
    path, sizes = report.path, [each.depth.shape[::-1] for each in maps]
    OUT.print(
        f"{report.num_maps:,} depth maps of {_size_range(sizes)}: {report.share_known:.0%} of the "
        f"pixels confirmed by other views, in {seconds:.1f} s, written to {visible(path)}",
        soft_wrap=True,
    )
    share = {"maps": report.num_maps, "confirmed": report.share_known}
    add_results(output=path, **share, seconds=seconds)
    print_note(*without_kinds(scene.findings, "lens-distortion"))
    if report.empty:
        text = f"no other view confirms any pixel of: {name_some(report.empty, NAMES_SHOWN)}"
        print_note(Finding("no-depth", text, subjects=tuple(report.empty)))
    if options.colmap:
        fuse = f"--workspace_path {quoted(path)} --output_path {quoted(path / 'fused.ply')}"
        fuse = f"colmap stereo_fusion {fuse} --StereoFusion.min_num_pixels {MIN_PIXELS}"
        # The workspace is itself a scene, without distortion.
        print_next([show_maps(Source(path), path), ("fuse", fuse)])
        return
    if is_distorted(scene):
        text = "the cameras have lens distortion, and these maps belong to the undistorted "
        text += "photographs: --colmap writes both, as a scene to continue with"
        print_note(Finding("lens-distortion", text, "info"))
    known = report.num_known
    source = Source(options.scene, options.exclude)
    print_next(after_depth(source, scene, path, known, aligned=True))


def _size_range(sizes: Sequence[Sequence[int]]) -> str:
    """Smallest to largest width x height, by area."""
    ordered = sorted(sizes, key=math.prod)
    ends = dict.fromkeys(f"{width} x {height}" for width, height in (ordered[0], ordered[-1]))
    return " to ".join(ends)
