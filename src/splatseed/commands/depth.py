"""``splatseed depth``: a depth map per photograph, by a network or from the photographs alone.

Promise: an option that would have no effect is refused, not ignored.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from splatseed.commands.next_steps import after_depth, look
from splatseed.commands.options import check_minimum, parse_options, refuse
from splatseed.console import OUT, print_note, print_pairs, stage_display
from splatseed.depth.stereo.maps import LEAST_SIZE, MOST_GRID
from splatseed.depthmap import DepthKind
from splatseed.io import dense, load_scene
from splatseed.io.photograph import warnings_without_lens
from splatseed.io.photograph_checks import with_photographs
from splatseed.io.staging import check_output
from splatseed.requirements import require
from splatseed.runtime.torch_device import DeviceName
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import is_distorted
from splatseed.text import name_some, quoted, visible

if TYPE_CHECKING:  # kernels load with their use
    from splatseed.depth.stereo import StereoMap

NAMES_SHOWN = 5
MAX_SIZE = 1600
"""For a network."""
PICTURE = "preview_maps.png"
PACKAGES = ("splatseed", "transformers", "torch", "numba", "numpy", "pillow", "scipy")
OF_NETWORK = ("device", "depth_kind")
OF_STEREO = ("colmap", "grid", "preview", "test_every")
MIN_PIXELS = 3
"""Photographs that must confirm a point fused by COLMAP. Its default of 5 suits unconfirmed maps;
our pixels are confirmed already, and few views see the borders."""


@dataclass(frozen=True)
class Options:
    """Make a depth map for every photograph: by a network, or from the photographs alone.

    Nothing is downloaded.
    """

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with photographs."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The folder of maps to write: one float32 .npy per image."""
    model: Annotated[str | None, tyro.conf.arg(metavar="NAME|PATH")] = None
    """A network: a folder in transformers' format, or an id that Hugging Face's cache holds."""
    stereo: bool = False
    """Match the photographs with each other instead: no network, on the CPU; normals and confidence
    too."""
    colmap: bool = False
    """With --stereo: write a COLMAP dense workspace, which colmap stereo_fusion turns into a
    cloud."""
    grid: int | None = None
    """With --stereo: one pixel of the map per block of GRID x GRID pixels of the photograph; 4 by
    default."""
    test_every: int | None = None
    """With --stereo: leave out every n-th image by name; 8 leaves out those that trainers test
    on."""
    preview: bool = False
    """With --stereo: also write preview_maps.png, some photographs beside their maps."""
    device: DeviceName = "auto"
    """Where to run the network; auto takes a usable GPU if there is one."""
    max_size: int | None = None
    """Maximum pixels on the longer side of photographs, and so of their maps; by default 1600, or
    800 with --stereo, which divides by a whole number."""
    depth_kind: DepthKind | None = None
    """What the network predicts: planar depth, distance along the ray, or inverse depth; by default
    what its config.json says."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "depth", arguments)
    check_minimum(options, 1, "grid")
    check_minimum(options, 2, "test_every")
    check_minimum(options, LEAST_SIZE if options.stereo else 1, "max_size")
    foreign = OF_NETWORK if options.stereo else OF_STEREO
    idle = [name for name in foreign if getattr(options, name) != getattr(Options, name)]
    refuse(
        (options.stereo == (options.model is not None),
         "either --model or --stereo", "both" if options.stereo else "neither",
         "Name a network with --model, or match the photographs themselves with --stereo."),
        ((options.grid or 1) > MOST_GRID, f"--grid from 1 to {MOST_GRID}", options.grid, "Try 4."),
        (idle, "options of " + ("--stereo" if options.stereo else "--model"),
         ", ".join(f"--{name.replace('_', '-')}" for name in idle),
         "Leave them out" + ("." if options.stereo else ", or add --stereo.")),
    )  # fmt: skip
    check_output(options.output, kind="depth", overwrite=options.overwrite, protect=[options.scene])
    if options.stereo:
        _run_stereo(options)
    else:
        _run_network(options)


def _provenance(options: Options) -> dict[str, object]:
    """How maps were made, for ``splatseed.json``."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        with suppress(PackageNotFoundError):
            versions[package] = version(package)
    given = {name: value for name, value in asdict(options).items() if value is not None}
    return {"command": "depth", "options": given, "versions": versions}


def _run_network(options: Options) -> None:
    max_size = options.max_size or MAX_SIZE
    options = replace(options, max_size=max_size)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        clock("load network", 0.0)
        require("torch", "transformers")
        from splatseed.depth.monocular import estimate_depths, load_network

        network = load_network(str(options.model), kind=options.depth_kind, device=options.device)
        kind, reason = network.meaning.kind, network.meaning.reason
        said = {"kind": kind, "kind_because": reason, "device": network.device}
        report = estimate_depths(
            scene, network, options.output, max_size=max_size, overwrite=options.overwrite,
            provenance={**_provenance(options), **said}, progress=clock,
        )  # fmt: skip
    ordered, num = sorted(report.sizes.values(), key=math.prod), len(report.sizes)
    small, large = (f"{width} x {height}" for width, height in (ordered[0], ordered[-1]))
    size = large if small == large else f"{small} to {large}"
    rows = [
        ("network", str(options.model)),
        ("run by", network.device),
        ("predicts", f"{kind} ({reason})"),
        ("maps", f"{num:,} of {size}"),
        ("seconds", f"{report.seconds:.1f}, {report.seconds / num:.2f} per image"),
        ("output", str(options.output)),
    ]
    print_pairs("splatseed depth", rows)
    for warning in scene.warnings:
        print_note(warning)
    if report.flat:
        flat = name_some(report.flat, NAMES_SHOWN)
        print_note(f"the network predicted no depth (a constant map, or none) for: {flat}")
    known = num * math.prod(ordered[0])
    print_pairs("next", after_depth(options.scene, scene, options.output, known, aligned=False))


def _run_stereo(options: Options) -> None:
    from splatseed.depth.stereo import stereo_depths

    start = time.perf_counter()
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        if options.test_every:
            scene = scene.replace(images=scene.split(options.test_every)[0])
        scene = with_photographs(scene) if scene.images else scene
        if options.colmap:
            dense.check_dense_scene(scene, undistorts=True)
        given = {name: getattr(options, name) for name in ("max_size", "grid")}
        given = {name: value for name, value in given.items() if value is not None}
        maps = stereo_depths(scene, progress=clock, **given)
        how: dict[str, Any] = {"overwrite": options.overwrite, "progress": clock}
        write = dense.write_dense_maps
        if options.colmap:
            from splatseed.photos.undistortion import undistort

            write, how["undistort"] = dense.write_dense_workspace, undistort
        report = write(scene, maps, options.output, provenance=_provenance(options), **how)
        if options.preview:
            from splatseed.viewer.maps import preview_maps

            clock("preview", 0.0)
            preview_maps(scene, maps, options.output / PICTURE)
    seconds = time.perf_counter() - start
    _summarise_stereo(options, scene, maps, report, seconds)


def _summarise_stereo(
    options: Options,
    scene: Scene,
    maps: Sequence[StereoMap],
    report: dense.DenseReport,
    seconds: float,
) -> None:
    path, ordered = report.path, sorted((each.depth.shape for each in maps), key=math.prod)
    ends = dict.fromkeys((ordered[0], ordered[-1]))
    sizes = " to ".join(f"{width} x {height}" for height, width in ends)
    OUT.print(
        f"{report.num_maps:,} depth maps of {sizes}: {report.share_known:.0%} of their "
        f"pixels confirmed by other views, in {seconds:.1f} s, written to {visible(path)}",
        soft_wrap=True,
    )
    if options.preview:
        OUT.print(f"pictures: {visible(options.output / PICTURE)}", soft_wrap=True)
    for warning in warnings_without_lens(scene):
        print_note(warning)
    if report.empty:
        print_note(f"no other view confirms any pixel of: {name_some(report.empty, NAMES_SHOWN)}")
    if is_distorted(scene) and not options.colmap:
        print_note(
            "the cameras have lens distortion, and these maps belong to the undistorted "
            "photographs: --colmap writes both, as a scene to continue with"
        )
    if options.colmap:
        fuse = f"--workspace_path {quoted(path)} --output_path {quoted(path / 'fused.ply')}"
        fuse = f"colmap stereo_fusion {fuse} --StereoFusion.min_num_pixels {MIN_PIXELS}"
        # The workspace is itself a scene, without distortion.
        print_pairs("next", [look(path, path), ("fuse", fuse)])
        return
    confirmed = int(sum(np.count_nonzero(np.isfinite(each.depth)) for each in maps))
    print_pairs("next", after_depth(options.scene, scene, path, confirmed, aligned=True))
