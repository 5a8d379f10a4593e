"""``splatseed depth``: a depth map per photograph, by a network or from photographs alone."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from splatseed.commands.depth.next_steps import after_network
from splatseed.commands.depth.options import Options, check_together
from splatseed.commands.depth.stereo import provenance, run_stereo
from splatseed.commands.options import parse_options
from splatseed.commands.planned import Planned
from splatseed.console import print_commands, print_note, print_pairs, stage_display
from splatseed.io import load_scene
from splatseed.io.staging import check_output
from splatseed.monocular import DepthReport, estimate_depths
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.train.schedule import FULL_RUN

if TYPE_CHECKING:
    from splatseed.monocular.network import DepthNetwork

NAMES_SHOWN = 5
MAX_SIZE = 1600
PACKAGES = ("splatseed", "transformers", "torch", "numpy", "pillow")


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "depth", arguments)
    check_together(options)
    if options.stereo:
        run_stereo(options)
    else:
        _run_network(options)


def _run_network(options: Options) -> None:
    max_size = MAX_SIZE if options.max_size is None else options.max_size
    options = replace(options, max_size=max_size)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        check_output(
            options.output, kind="depth", overwrite=options.overwrite, protect=[options.scene]
        )
        clock("load network", 0.0)
        require("torch", "transformers")
        from splatseed.monocular.network import load_network  # noqa: PLC0415  (imports PyTorch)

        network = load_network(str(options.model), kind=options.depth_kind, device=options.device)
        report = estimate_depths(
            scene,
            network,
            options.output,
            max_size=max_size,
            overwrite=options.overwrite,
            provenance={**provenance(options, PACKAGES), **_said_by(network)},
            progress=clock,
        )
    _summarise(options, scene, network, report)


def _said_by(network: DepthNetwork) -> dict[str, object]:
    meaning = network.meaning
    return {"kind": meaning.kind, "kind_because": meaning.reason, "device": network.device}


def _summarise(options: Options, scene: Scene, network: DepthNetwork, report: DepthReport) -> None:
    small, large = (f"{width} x {height}" for width, height in report.sizes)
    each = report.seconds / report.num_images
    rows = [
        ("network", str(options.model)),
        ("run by", network.device),
        ("predicts", f"{network.meaning.kind} ({network.meaning.reason})"),
        ("maps", f"{report.num_images:,} of {large if small == large else f'{small} to {large}'}"),
        ("seconds", f"{report.seconds:.1f}, {each:.2f} per image"),
        ("output", str(report.path)),
    ]
    print_pairs("splatseed depth", rows)
    for warning in scene.warnings:
        print_note(warning)
    if report.flat:
        shown = ", ".join(report.flat[:NAMES_SHOWN])
        more = len(report.flat) - NAMES_SHOWN
        print_note(
            "the network predicted no depth (a constant map, or none) for:  "
            + shown
            + (f" and {more} more" if more > 0 else "")
        )
    known = report.num_images * math.prod(report.sizes[0])
    most = Planned.of(scene, None, FULL_RUN).most_seeds
    print_commands("next", after_network(options.scene, scene, report.path, known, most))
