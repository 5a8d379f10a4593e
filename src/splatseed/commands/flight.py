"""``splatseed flight``: a video of a camera path through a trained model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from splatseed.commands.options import check_free, parse_options, refuse
from splatseed.console import print_note, print_pairs, stage_display
from splatseed.errors import ParameterError
from splatseed.findings import Finding
from splatseed.io.origin import find_shift
from splatseed.pointcloud import PointCloud
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.training.folder import model_file
from splatseed.training.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.photos.view import View
    from splatseed.viewer.models import ViewerItem

DEFAULT_SIDE = 1280  # longer side at most, unless --size asks for more
MIN_SIDE, MAX_SIDE = 16, 8192
MAX_FRAMES = 20_000
FPS = 30.0
"""Frames per second, unless a path file has its own."""
ORBIT = Path("orbit")
WITHOUT_CAMERAS = (960, 720)
VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
"""All hold H.264."""


@dataclass(frozen=True)
class Options:
    """Fly through a trained model: a video of a smooth path past its training cameras."""

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The video to write: .mp4, .mkv or .mov."""
    scene: Path | None = None
    """The scene of a file of Gaussians, for its cameras; a run has its own. Without cameras, the
    video circles the Gaussians."""
    path: Annotated[Path | None, tyro.conf.arg(metavar="FILE|orbit")] = None
    """A camera path to fly instead: nerfstudio's JSON, in the world of the model's file or that of
    --transform; or orbit, to circle the cameras' focus."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|gsplat|flipped|none")] = None
    """Transform from the scene's world to the path's, if that is not the model's: the
    dataparser_transforms.json of nerfstudio's run, or other values of evaluate --transform; none
    for a path in the scene's world."""
    compare: Path | None = None
    """Another run or file of the same scene, shown in the right half."""
    depth: bool = False
    """Show depth instead of colour; near is bright."""
    seconds: float = 10.0
    """Length of the video in seconds; a path file has its own."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Size of the video in pixels, by default that of the path's file, else the photographs', at
    most 1280 a side; odd numbers are rounded, as H.264 needs even numbers."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""
    overwrite: bool = False
    """Replace an existing file."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "flight", arguments)
    suffix = options.output.suffix
    refuse(
        (suffix.lower() not in VIDEO_SUFFIXES, f"the name of a video: {', '.join(VIDEO_SUFFIXES)}",
         suffix or "no suffix", "Name it flight.mp4."),
        (options.path in (None, ORBIT) and options.transform is not None,
         "--path with --transform", "none", "Leave --transform out."),
        (not 1 <= options.seconds * FPS <= MAX_FRAMES,
         f"--seconds from {1 / FPS:.2g} to {MAX_FRAMES / FPS:.0f}", f"{options.seconds:g}",
         "Try 10."),
    )  # fmt: skip
    inputs = [model_file(path) for path in (options.model, options.compare) if path is not None]
    inputs += [Path(path) for path in (options.scene, options.path) if path not in (None, ORBIT)]
    check_free(options.output, overwrite=options.overwrite, protect=inputs)
    require("torch", "imageio_ffmpeg")
    from splatseed.splat.rendering import ModelRenderer
    from splatseed.training.device import pick_device
    from splatseed.viewer.flights import flight_frames, write_video
    from splatseed.viewer.models import viewer_frame

    with stage_display() as clock:
        clock("read", 0.0)
        items = _open_models(options)
        size = _size(options, items[0])
        views, fps = _path(options, items[0], size)
        clock("prepare", 0.0)
        device, frame = pick_device(options.backend, clock), viewer_frame(items[0])
        renderers = [ModelRenderer(i.model, frame, device, i.background) for i in items]
        names = [item.name for item in items]
        frames = flight_frames(renderers, names, views, depth=options.depth, progress=clock)
        write_video(options.output, frames, size, fps)
    seconds = clock.seconds().get("render", 0.0)
    rows = [
        ("frames", f"{len(views):,} of {size[0]} x {size[1]}, {fps:g} a second"),
        ("rendering", f"{seconds:.1f} s, {1e3 * seconds / len(views):.0f} ms a frame"),
        ("video", f"{options.output}, {options.output.stat().st_size / 1e6:.1f} MB"),
    ]
    print_pairs("splatseed flight", rows)
    print_note(*(finding for item in items for finding in item.findings))
    if items[0].moved and options.path not in (None, ORBIT) and options.transform is None:
        text = f"The path {options.path} is taken to be in the model's frame, too, and was "
        text += "transformed with it; for one in the scene's frame, pass --transform none."
        print_note(Finding("path-frame", text, "info"))
    if items[0].scene is None and options.path is None:
        text = "The model has no cameras, so the video circles it; pass --scene for a path."
        print_note(Finding("no-cameras", text, "info"))


def _open_models(options: Options) -> list[ViewerItem]:
    from splatseed.viewer.models import open_item, same_world, unique_names

    paths = [path for path in (options.model, options.compare) if path is not None]
    named = zip(unique_names(paths), paths, strict=True)
    items = [replace(open_item(path, options.scene), name=name) for name, path in named]
    fix = "Train it first (splatseed train), or view it with splatseed view."
    for path, item in zip(paths, items, strict=True):
        untrained = item.gaussians is None
        refuse((untrained, f"{path} to be a trained model", "a scene or points", fix))
    refuse(
        (not same_world(items[0], items[-1]),
         f"a model of the same scene as {options.model}, for --compare",
         f"{options.compare}, whose scene has no photograph with a pose of that scene",
         "Compare runs of one scene; if they are, pass it as --scene."),
    )  # fmt: skip
    return items


def _size(options: Options, item: ViewerItem) -> tuple[int, int]:
    from splatseed.viewer.flights import even_size, size_of_path

    if options.size is not None:
        sides = options.size.lower().split("x")
        if len(sides) != 2 or not all(
            s.isdigit() and MIN_SIDE <= int(s) <= MAX_SIDE for s in sides
        ):
            raise ParameterError(
                f"--size WxH of {MIN_SIDE} to {MAX_SIDE} pixels a side",
                found=repr(options.size),
                fix="Try --size 960x540.",
            )
        return even_size(int(sides[0]), int(sides[1]))
    if options.path not in (None, ORBIT) and (size := size_of_path(options.path)) is not None:
        return even_size(*size, DEFAULT_SIDE)
    for view in item.central_views[:1]:
        return even_size(view.width, view.height, DEFAULT_SIDE)
    return WITHOUT_CAMERAS


def _path(options: Options, item: ViewerItem, size: tuple[int, int]) -> tuple[list[View], float]:
    from splatseed.splat.model_frame import NO_TRANSFORM, find_transform
    from splatseed.viewer import flights

    cameras, frames = item.central_views, max(1, round(options.seconds * FPS))
    if options.path == ORBIT or (options.path is None and len(cameras) < 2):
        return flights.orbit(cameras, item.model, frames, size), FPS
    if options.path is None:
        return flights.smooth_path(cameras, frames, size), FPS
    # From the scene's world to the path's, which by default is the model's as in its file.
    world = item.moved.inverse if item.moved and options.transform is None else None
    if options.transform is not None:
        world = find_transform(options.transform, item.scene or Scene(PointCloud.empty()))
    views, fps = flights.read_path(options.path, size, world)
    if world is None and item.scene is not None:  # it may be in the scene's files' coordinates
        centers = np.array([view.camera.center for view in views])
        shift = find_shift(item.scene, centers, unrecorded=True)
        if shift.any():
            world = Similarity(1.0, np.eye(3), -shift)
            views, fps = flights.read_path(options.path, size, world)
    if options.transform != NO_TRANSFORM:
        flights.check_path(options.path, views, item.model, cameras)
    return views, fps or FPS
