"""``splatseed flight``: a video of a camera path through a trained model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatseed.commands.models import model_file
from splatseed.commands.options import parse_options
from splatseed.console import StageClock, print_note, print_pairs, stage_display
from splatseed.errors import OutputError, ParameterError
from splatseed.io.staging import check_parents
from splatseed.requirements import require
from splatseed.train.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.view.models import ModelRenderer, Shown
    from splatseed.views.view import View

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
    """Instead of past the cameras: a camera path in nerfstudio's JSON, in the model's world or that
    of --transform; or orbit, to circle around what the cameras look at."""
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
    _check(options)
    require("torch", "imageio_ffmpeg")
    from splatseed.view.flights import flight_frames, write_video  # noqa: PLC0415  (imports PyTorch)

    with stage_display() as clock:
        clock("read", 0.0)
        shown = _open(options, options.model)
        models = [shown]
        if options.compare is not None:
            models.append(_compared(options, options.compare, shown))
        size = _size(options, shown)
        views, fps = _views(options, shown, size)
        renderers = _renderers(options, models, clock)
        names = [each.name for each in models]
        frames = flight_frames(renderers, names, views, depth=options.depth, progress=clock)
        write_video(options.output, frames, size, fps)
    circles_unasked = shown.scene is None and options.path is None
    _summarise(options, views, size, fps, clock, circles_unasked=circles_unasked)


def _check(options: Options) -> None:
    """Check what can be checked before any work starts."""
    suffix = options.output.suffix
    if suffix.lower() not in VIDEO_SUFFIXES:
        raise ParameterError(
            f"the name of a video: {', '.join(VIDEO_SUFFIXES)}",
            found=suffix or "no suffix",
            fix="Name it flight.mp4.",
        )
    check_parents(options.output)
    if options.output.exists() and not options.overwrite:
        fix = "Pass --overwrite to replace it, or choose another name."
        raise OutputError(f"no file at {options.output}", found="one", fix=fix)
    if options.path in (None, ORBIT) and options.transform is not None:
        raise ParameterError("--path with --transform", found="none", fix="Leave it out.")
    if not 1 <= options.seconds * FPS <= MOST_FRAMES:
        raise ParameterError(
            f"--seconds from {1 / FPS:.2g} to {MOST_FRAMES / FPS:.0f}",
            found=f"{options.seconds:g}",
            fix="Try 10.",
        )
    for each in (options.model, options.compare):
        if each is not None:
            model_file(each)


def _open(options: Options, path: Path) -> Shown:
    from splatseed.view.models import open_shown  # noqa: PLC0415  (loads with its use)

    shown = open_shown(path, options.scene)
    if shown.gaussians is None:
        raise ParameterError(
            f"{path} to be a trained model",
            found="a scene or points",
            fix="Train it first (splatseed train), or look at it with splatseed view.",
        )
    return shown


def _compared(options: Options, path: Path, first: Shown) -> Shown:
    """The model beside the first, which the same cameras see."""
    from splatseed.view.models import share_a_world  # noqa: PLC0415  (loads with its use)

    shown = _open(options, path)
    if not share_a_world(first, shown):
        raise ParameterError(
            f"a model of the same scene as {options.model}, for --compare",
            found=f"{path}, whose scene has no photograph with a pose of that scene",
            fix="Compare runs of one scene; if these are, name it with --scene.",
        )
    return shown


def _size(options: Options, shown: Shown) -> tuple[int, int]:
    """Width and height of the video."""
    from splatseed.view.flights import even_size  # noqa: PLC0415  (loads with its use)
    from splatseed.views.view import poses_of  # noqa: PLC0415  (loads with its use)

    if options.size is not None:
        words = options.size.lower().split("x")
        if len(words) != 2 or not all(w.isdigit() and LEAST_SIDE <= int(w) <= 8192 for w in words):
            raise ParameterError(
                f"--size WxH of {LEAST_SIDE} to 8192 pixels a side",
                found=repr(options.size),
                fix="Try --size 960x540.",
            )
        return even_size(int(words[0]), int(words[1]))
    if shown.scene is None or not shown.scene.images:
        return WITHOUT_CAMERAS
    first = poses_of(shown.scene.images, shown.data_factor)[0]
    return even_size(first.width, first.height, MOST_SIDE)


def _views(options: Options, shown: Shown, size: tuple[int, int]) -> tuple[Sequence[View], float]:
    """The cameras, one per frame, and the frame rate."""
    from splatseed.view.flights import orbit, smooth_path  # noqa: PLC0415  (loads with its use)

    if options.path not in (None, ORBIT):
        return _views_of_file(options.path, options.transform, shown, size)
    frames = max(1, round(options.seconds * FPS))
    cameras = shown.train_views
    assert shown.gaussians is not None  # noqa: S101  (see _open)
    if options.path == ORBIT or len(cameras) < 2:
        return orbit(cameras, shown.gaussians, frames, size), FPS
    return smooth_path(cameras, frames, size), FPS


def _views_of_file(
    path: Path, transform: str | None, shown: Shown, size: tuple[int, int]
) -> tuple[Sequence[View], float]:
    """The cameras of a path's file in the model's world, and the frame rate."""
    from splatseed.io.colmap.scene import empty_cloud  # noqa: PLC0415  (loads with its use)
    from splatseed.scene import Scene  # noqa: PLC0415  (loads with its use)
    from splatseed.splat.world import NO_TRANSFORM, find_transform  # noqa: PLC0415  (imports PyTorch)
    from splatseed.view.flights import check_path, path_of_file  # noqa: PLC0415  (loads with its use)

    world = None
    if transform is not None:
        world = find_transform(transform, shown.scene or Scene(empty_cloud()))
    views, named = path_of_file(path, size, world)
    assert shown.gaussians is not None  # noqa: S101  (see _open)
    if transform != NO_TRANSFORM:
        check_path(path, views, shown.gaussians, shown.train_views)
    return views, named or FPS


def _renderers(options: Options, models: Sequence[Shown], clock: StageClock) -> list[ModelRenderer]:
    """The renderers of the models, all on the first one's stage."""
    from splatseed.train.device import pick_device  # noqa: PLC0415  (imports PyTorch)
    from splatseed.view.models import ModelRenderer, stage_frame  # noqa: PLC0415  (loads with its use)

    clock("prepare", 0.0)
    device, frame = pick_device(options.backend, clock), stage_frame(models[0])
    return [
        ModelRenderer(each.gaussians, frame, device)
        for each in models
        if each.gaussians is not None
    ]


def _summarise(
    options: Options,
    views: Sequence[View],
    size: tuple[int, int],
    fps: float,
    clock: StageClock,
    *,
    circles_unasked: bool,
) -> None:
    seconds = clock.seconds().get("render", 0.0)
    rows = [
        ("frames", f"{len(views):,} of {size[0]} x {size[1]}, {fps:g} a second"),
        ("rendering", f"{seconds:.1f} s, {1e3 * seconds / len(views):.0f} ms a frame"),
        ("video", f"{options.output}, {options.output.stat().st_size / 1e6:.1f} MB"),
    ]
    print_pairs("splatseed flight", rows)
    if circles_unasked:
        print_note("No cameras are known, so the video circles; --scene SCENE names the scene's.")
