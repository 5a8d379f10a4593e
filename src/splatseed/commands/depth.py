"""``splatseed depth``: a depth map for every photograph, by a network that is on this machine."""

from __future__ import annotations

import platform
import shlex
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated, Any

import tyro

from splatseed.commands._options import parse_options
from splatseed.console import print_commands, print_note, print_pairs, stage_display
from splatseed.depthmap import DepthKind
from splatseed.io import load_scene
from splatseed.io.staging import check_output
from splatseed.monocular import (
    DepthNetwork,
    DepthReport,
    DeviceName,
    Preparation,
    estimate_depths,
    load_network,
)

__all__ = ["run"]

NAMES_SHOWN = 5
Channels = tuple[float, float, float]


def _number(default: str) -> Any:
    """How an optional number shows in the help."""
    return tyro.conf.arg(constructor=int, metavar="INT", help_behavior_hint=f"(default: {default})")


_BESIDE = tyro.conf.arg(help_behavior_hint="(default: as beside the file, else ImageNet's)")


@dataclass(frozen=True)
class Options:
    """Predict a depth map for every photograph of a scene. Nothing is downloaded."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A scene with photographs."""
    model: str
    """A folder in transformers' format, an id that Hugging Face's cache holds, or an .onnx file."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The folder of maps to write: one float32 .npy an image."""
    batch: int = 1
    """Photographs that the network sees at once: more is faster on a GPU, and takes more memory."""
    device: DeviceName = "auto"
    """Where to run; auto takes a GPU if there is one that can be used."""
    max_size: int = 1600
    """Photographs with a longer side are reduced to this many pixels, and so are their maps."""
    depth_kind: Annotated[
        DepthKind | None, tyro.conf.arg(help_behavior_hint="(default: what config.json tells)")
    ] = None
    """What the network predicts: planar depth, distance along the ray, or inverse depth."""
    input_size: Annotated[int | None, _number("as beside the file, else 518")] = None
    """Of an .onnx file that leaves it open: what the sides are scaled to, in pixels."""
    input_multiple: Annotated[int | None, _number("as beside the file, else 14")] = None
    """Of such a file: what the sides are then rounded to a multiple of."""
    mean: Annotated[Channels | None, _BESIDE] = None
    """Of an .onnx file: taken away from red, green and blue in 0..1."""
    std: Annotated[Channels | None, _BESIDE] = None
    """Of an .onnx file: what red, green and blue are divided by then."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Do what the command line asks for."""
    options = parse_options(Options, "depth", arguments)
    with stage_display() as clock:
        clock("read", 0.0)
        scene = load_scene(options.scene, require_points=False)
        check_output(options.output, overwrite=options.overwrite, protect=[options.scene])
        clock("load network", 0.0)
        network = _network(options)
        report = estimate_depths(
            scene,
            network,
            options.output,
            batch=options.batch,
            max_size=options.max_size,
            overwrite=options.overwrite,
            provenance=_provenance(options, network),
            progress=clock,
        )
    _summarise(options, network, report)


def _network(options: Options) -> DepthNetwork:
    preparation = Preparation(options.input_size, options.input_multiple, options.mean, options.std)
    return load_network(
        options.model, kind=options.depth_kind, device=options.device, preparation=preparation
    )


def _provenance(options: Options, network: DepthNetwork) -> dict[str, object]:
    """How the maps came about, for ``splatseed.json``."""
    versions = {"python": platform.python_version()}
    for package in ("splatseed", "transformers", "torch", "onnxruntime", "numpy", "pillow"):
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return {
        "command": "depth",
        "options": {name: value for name, value in asdict(options).items() if value is not None},
        "kind": network.meaning.kind,
        "kind_because": network.meaning.reason,
        "device": network.device,
        "versions": versions,
    }


def _summarise(options: Options, network: DepthNetwork, report: DepthReport) -> None:
    small, large = (f"{width} x {height}" for width, height in report.sizes)
    each = report.seconds / report.num_images
    rows = [
        ("network", options.model),
        ("run by", network.device),
        ("predicts", f"{network.meaning.kind} ({network.meaning.reason})"),
        ("maps", f"{report.num_images:,} of {large if small == large else f'{small} to {large}'}"),
        ("seconds", f"{report.seconds:.1f}, {each:.2f} an image"),
        ("output", str(report.path)),
    ]
    print_pairs("splatseed depth", rows)
    if report.flat:
        shown = ", ".join(report.flat[:NAMES_SHOWN])
        more = len(report.flat) - NAMES_SHOWN
        print_note(
            "the network saw no depth (one value all over, or none) in: "
            + shown
            + (f" and {more} more" if more > 0 else "")
        )
    scene, maps = (shlex.quote(str(path)) for path in (options.scene, report.path))
    commands = [
        ("look", f"splatseed info {scene} --depth {maps} --picture depth.png"),
        ("use", f"splatseed upsample {scene} --method depth --depth {maps} --ratio 16 -o OUT"),
    ]
    print_commands("next", commands)
