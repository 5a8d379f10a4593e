"""``splatseed flight``: a video of a camera path through a trained model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from splatseed.commands.options import parse_options, refuse
from splatseed.commands.outputs import check_free
from splatseed.console import print_note, print_pairs, stage_display
from splatseed.errors import ParameterError
from splatseed.io.origin import find_shift
from splatseed.pointcloud import PointCloud
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.training.models import model_file
from splatseed.training.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.photos.view import View
    from splatseed.viewer.models import Shown

MOST_SIDE = 1280
LEAST_SIDE = 16
MOST_FRAMES = 20_000
FPS = 30.0
"""Frames a second, unless a path file states its own."""
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
    """The scene a file of Gaussians belongs to, for its cameras; a run knows its own. Without
    cameras, the video circles around the Gaussians."""
    path: Annotated[Path | None, tyro.conf.arg(metavar="FILE|orbit")] = None
    """A camera path to fly instead: nerfstudio's JSON, in the model's world or that of --transform;
    or orbit, to circle around what the cameras look at."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|gsplat|none")] = None
    """From the model's world to the path's, by default the same: the dataparser_transforms.json of
    nerfstudio's run, or anything else that evaluate --transform takes."""
    compare: Path | None = None
    """Another run or file of the same scene, shown in the right half; the model is in the left."""
    depth: bool = False
    """Show depth, near bright and far dark, instead of colour."""
    seconds: float = 10.0
    """Length of the video in seconds; a path file states its own."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Size of the video in pixels, by default the photographs', at most 1280 a side; odd numbers
    become even, as H.264 requires."""
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
        (not 1 <= options.seconds * FPS <= MOST_FRAMES,
         f"--seconds from {1 / FPS:.2g} to {MOST_FRAMES / FPS:.0f}", f"{options.seconds:g}",
         "Try 10."),
    )  # fmt: skip
    inputs = [model_file(each) for each in (options.model, options.compare) if each is not None]
    inputs += [Path(each) for each in (options.scene, options.path) if each not in (None, ORBIT)]
    check_free(options.output, overwrite=options.overwrite, protect=inputs)
    require("torch", "imageio_ffmpeg")
    # These import PyTorch.
    from splatseed.splat.rendering import ModelRenderer
    from splatseed.training.device import pick_device
    from splatseed.viewer.flights import flight_frames, write_video
    from splatseed.viewer.models import stage_frame

    with stage_display() as clock:
        clock("read", 0.0)
        models = _opened(options)
        size = _size(options, models[0])
        views, fps = _path(options, models[0], size)
        clock("prepare", 0.0)
        device, frame = pick_device(options.backend, clock), stage_frame(models[0])
        renderers = [ModelRenderer(each.model, frame, device) for each in models]
        names = [each.name for each in models]
        frames = flight_frames(renderers, names, views, depth=options.depth, progress=clock)
        write_video(options.output, frames, size, fps)
    seconds = clock.seconds().get("render", 0.0)
    rows = [
        ("frames", f"{len(views):,} of {size[0]} x {size[1]}, {fps:g} a second"),
        ("rendering", f"{seconds:.1f} s, {1e3 * seconds / len(views):.0f} ms a frame"),
        ("video", f"{options.output}, {options.output.stat().st_size / 1e6:.1f} MB"),
    ]
    print_pairs("splatseed flight", rows)
    for note in (note for shown in models for note in shown.notes):
        print_note(note)
    if models[0].scene is None and options.path is None:
        print_note("No cameras are known, so the video circles; --scene SCENE names the scene's.")


def _opened(options: Options) -> list[Shown]:
    """The model, and the one that is compared with it, which the same cameras see."""
    from splatseed.viewer.models import names_of, open_shown, share_a_world

    paths = [path for path in (options.model, options.compare) if path is not None]
    named = zip(names_of(paths), paths, strict=True)
    models = [replace(open_shown(path, options.scene), name=name) for name, path in named]
    look = "Train it first (splatseed train), or look at it with splatseed view."
    for path, shown in zip(paths, models, strict=True):
        bare = shown.gaussians is None
        refuse((bare, f"{path} to be a trained model", "a scene or points", look))
    refuse(
        (not share_a_world(models[0], models[-1]),
         f"a model of the same scene as {options.model}, for --compare",
         f"{options.compare}, whose scene has no photograph with a pose of that scene",
         "Compare runs of one scene; if these are, name it with --scene."),
    )  # fmt: skip
    return models


def _size(options: Options, shown: Shown) -> tuple[int, int]:
    """Width and height of the video."""
    from splatseed.viewer.flights import even_size

    if options.size is not None:
        words = options.size.lower().split("x")
        if len(words) != 2 or not all(w.isdigit() and LEAST_SIDE <= int(w) <= 8192 for w in words):
            raise ParameterError(
                f"--size WxH of {LEAST_SIDE} to 8192 pixels a side",
                found=repr(options.size),
                fix="Try --size 960x540.",
            )
        return even_size(int(words[0]), int(words[1]))
    for view in shown.usual_views[:1]:
        return even_size(view.width, view.height, MOST_SIDE)
    return WITHOUT_CAMERAS


def _path(options: Options, shown: Shown, size: tuple[int, int]) -> tuple[list[View], float]:
    """The cameras, one per frame, and the frame rate."""
    from splatseed.splat.world import NO_TRANSFORM, find_transform
    from splatseed.viewer import flights

    cameras, frames = shown.usual_views, max(1, round(options.seconds * FPS))
    if options.path == ORBIT or (options.path is None and len(cameras) < 2):
        return flights.orbit(cameras, shown.model, frames, size), FPS
    if options.path is None:
        return flights.smooth_path(cameras, frames, size), FPS
    world = None
    if options.transform is not None:
        world = find_transform(options.transform, shown.scene or Scene(PointCloud.empty()))
    views, fps = flights.path_of_file(options.path, size, world)
    if world is None and shown.scene is not None:  # may be in its files' coordinates
        centers = np.array([view.camera.center for view in views])
        shift = find_shift(shown.scene, centers, unrecorded=True)
        if shift.any():
            world = Similarity(1.0, np.eye(3), -shift)
            views, fps = flights.path_of_file(options.path, size, world)
    if options.transform != NO_TRANSFORM:
        flights.check_path(options.path, views, shown.model, cameras)
    return views, fps or FPS
