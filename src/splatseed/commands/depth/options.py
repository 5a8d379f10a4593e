"""The options of ``splatseed depth``, and which of them go together.

Promise: an option that would have no effect is refused, not ignored.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from splatseed.commands.options import check_least
from splatseed.depth.stereo.settings import LEAST_SIZE, MOST_GRID
from splatseed.depthmap import DepthKind
from splatseed.errors import ParameterError
from splatseed.process.torch_device import DeviceName


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
    preview: bool = False
    """With --stereo: also write preview_maps.png, some photographs beside their maps."""
    device: DeviceName = "auto"
    """Where to run the network; auto takes a usable GPU if there is one."""
    max_size: int | None = None
    """Photographs with a longer side are reduced to this many pixels, and so are their maps; by
    default 1600, or 800 with --stereo."""
    depth_kind: DepthKind | None = None
    """What the network predicts: planar depth, distance along the ray, or inverse depth; by default
    what its config.json says."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


_OF_NETWORK = ("device", "depth_kind")
_OF_STEREO = ("colmap", "grid", "preview")


def check_together(options: Options) -> None:
    """Check that the options name one source of depth, and none that belongs to the other.

    Raises:
        ParameterError: They do not.
    """
    if options.stereo == (options.model is not None):
        raise ParameterError(
            "either --model or --stereo",
            found="both" if options.stereo else "neither",
            fix="Name a network with --model, or match the photographs themselves with --stereo.",
        )
    check_least(options, 1, "grid")
    check_least(options, LEAST_SIZE if options.stereo else 1, "max_size")
    if (options.grid or 1) > MOST_GRID:
        found = f"{options.grid}"
        raise ParameterError(f"--grid from 1 to {MOST_GRID}", found=found, fix="Try 4.")
    idle = _given(options, _OF_NETWORK if options.stereo else _OF_STEREO)
    if idle:
        raise ParameterError(
            "options of " + ("--stereo" if options.stereo else "--model"),
            found=", ".join(f"--{name.replace('_', '-')}" for name in idle),
            fix="Leave them out" + ("." if options.stereo else ", or add --stereo."),
        )


def _given(options: Options, names: tuple[str, ...]) -> list[str]:
    """Which of the options differ from their defaults."""
    return [
        field.name
        for field in fields(options)
        if field.name in names and getattr(options, field.name) != field.default
    ]
