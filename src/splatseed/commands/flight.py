"""``splatseed flight``: a video of a camera path through a trained model, or its pictures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
import tyro

from splatseed.commands.options import check_free, parse_options, refuse
from splatseed.console import add_results, print_note, print_pairs, stage_display
from splatseed.errors import ParameterError
from splatseed.findings import Finding
from splatseed.io.origin import find_shift
from splatseed.io.staging import check_output
from splatseed.pointcloud import PointCloud
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.similarity import Similarity
from splatseed.training.folder import model_file
from splatseed.training.request import ExcludeChoice
from splatseed.training.settings import Backend

if TYPE_CHECKING:  # importing PyTorch takes a while: --help must not wait for it
    from splatseed.photos.view import View
    from splatseed.viewer.camera_path import CameraPath
    from splatseed.viewer.cameras import GivenCameras
    from splatseed.viewer.models import ViewerItem

DEFAULT_SIDE = 1280  # longer side at most, unless --size or a path's file sets another
MIN_SIDE, MAX_SIDE = 16, 8192
MAX_FRAMES = 20_000
FPS, SECONDS = 30.0, 10.0
"""Frames per second, and length, unless a path file has its own."""
ORBIT = Path("orbit")
WITHOUT_CAMERAS = (960, 720)
VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
"""All hold H.264."""


@dataclass(frozen=True)
class Options:
    """Render a trained model along a path past its training cameras, or from given cameras."""

    model: Annotated[Path, tyro.conf.Positional]
    """A run folder of splatseed train, or a file of Gaussians."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The video to write: .mp4, .mkv or .mov; or a folder for a PNG of each frame."""
    scene: Path | None = None
    """The scene of a file of Gaussians, for its cameras; a run has its own. Without cameras, the
    video circles the Gaussians."""
    path: Annotated[Path | None, tyro.conf.arg(metavar="FILE|orbit")] = None
    """A camera path to fly instead: nerfstudio's JSON, in the world of the model's file or that of
    --transform; or orbit, to circle the cameras' focus."""
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="SCENE|FILE")] = None
    """Cameras to render instead, each at its own size and focal length, without distortion: those
    of a scene (a COLMAP model, a transforms.json, ...), in the world of the model's scene;
    graphdeco's cameras.json or a camera path, in the world of the model's file. A folder as output
    gets a PNG of each camera's name."""
    exclude: ExcludeChoice = ()
    """Photographs whose cameras are left out, of --cameras or else of the model's scene: a name, a
    pattern such as 'IMG_00*', or a .txt file of these."""
    transform: Annotated[str | None, tyro.conf.arg(metavar="FILE|gsplat|flipped|none")] = None
    """Transform from the scene's world to the path's or the cameras', if that is not the model's:
    the dataparser_transforms.json of nerfstudio's run, or other values of evaluate --transform;
    none for a path in the scene's world."""
    compare: Path | None = None
    """Another run or file of the same scene, shown in the right half."""
    depth: bool = False
    """Show depth instead of colour; near is bright."""
    seconds: float | None = None
    """Length of the video in seconds, by default that of the path's file, else 10."""
    size: Annotated[str | None, tyro.conf.arg(metavar="WxH")] = None
    """Size of the frames in pixels, by default that of the path's file, else the photographs', at
    most 1280 a side; odd numbers of a video are rounded, as H.264 needs even numbers."""
    backend: Backend = "auto"
    """Where to render; auto takes a GPU if PyTorch sees one."""
    overwrite: bool = False
    """Replace an existing file, or a folder that flight wrote before."""

    @property
    def file(self) -> Path | None:
        """What holds the cameras, if not the model's scene."""
        return self.cameras or (self.path if self.path != ORBIT else None)

    @property
    def is_video(self) -> bool:
        """Whether the output is a video; else a folder."""
        return self.output.suffix.lower() in VIDEO_SUFFIXES


class _Flight(NamedTuple):
    """What is rendered: views in the model's world."""

    views: list[View]
    fps: float
    given: GivenCameras | None = None
    world: Similarity | None = None  # from the model's world to that of the given cameras
    findings: tuple[Finding, ...] = ()

    @property
    def path(self) -> CameraPath | None:
        return self.given.path if self.given else None


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "flight", arguments)
    suffix, seconds = options.output.suffix, options.seconds
    refuse(
        (suffix and not options.is_video and not options.output.is_dir(),
         f"the name of a video ({', '.join(VIDEO_SUFFIXES)}), or of a folder for pictures", suffix,
         "Name it flight.mp4, or without a suffix."),
        (options.path is not None and options.cameras is not None, "--path or --cameras", "both",
         "Leave out one of them."),
        (options.file is None and options.transform is not None,
         "--path or --cameras with --transform", "none", "Leave --transform out."),
        (seconds is not None and not 1 <= seconds * FPS <= MAX_FRAMES,
         f"--seconds from {1 / FPS:.2g} to {MAX_FRAMES / FPS:.0f}", f"{seconds}", "Try 10."),
        (options.size is not None and options.cameras is not None and not options.is_video,
         "--size without --cameras", "both", "Cameras have sizes of their own: leave --size out."),
    )  # fmt: skip
    inputs = [model_file(path) for path in (options.model, options.compare) if path is not None]
    inputs += [path for path in (options.scene, options.file) if path is not None]
    if options.is_video:
        check_free(options.output, overwrite=options.overwrite, protect=inputs)
    else:
        check_output(options.output, kind="flight", overwrite=options.overwrite, protect=inputs)
    require("torch", *["imageio_ffmpeg"] * options.is_video)
    from splatseed.splat.rendering import ModelRenderer
    from splatseed.training.device import pick_device
    from splatseed.viewer import videos
    from splatseed.viewer.models import viewer_frame

    with stage_display() as clock:
        clock("read", 0.0)
        items = _open_models(options)
        flight = _flight(options, items[0])
        views, path = flight.views, flight.path
        models = [path.cropped(i.model, flight.world) if path else i.model for i in items]
        clock("prepare", 0.0)
        device, frame = pick_device(options.backend, clock), viewer_frame(items[0])
        crop = path.crop if path else None
        renderers = [
            ModelRenderer(model, frame, device, crop.background if crop else item.background)
            for model, item in zip(models, items, strict=True)
        ]
        frames = videos.flight_frames(
            renderers, [item.name for item in items], views, depth=options.depth, progress=clock
        )
        shown = list[float]()

        def pictures() -> Iterator[np.ndarray]:
            for each in frames:
                shown.append(each.shown)
                yield each.picture

        names = [view.name for view in views]
        if options.is_video:
            size = views[0].width, views[0].height
            videos.write_video(options.output, pictures(), size, flight.fps)
        else:
            videos.write_pictures(options.output, pictures(), names, overwrite=options.overwrite)
        guessed = videos.guessed_findings(renderers[0], views, items[0].train_views, clock)
    _summarise(options, flight, clock.seconds().get("render", 0.0))
    print_note(*(finding for item in items for finding in item.findings), *flight.findings)
    if path is not None:
        size = views[0].width, views[0].height
        print_note(*path.findings(size, len(models[0]), len(items[0].model)))
    print_note(*videos.unseen_findings(shown, names), *guessed)
    if items[0].moved and flight.given and not flight.given.of_scene and options.transform is None:
        text = f"{options.file} is taken to be in the model's frame, too, and was transformed with "
        text += "it; for the scene's frame, pass --transform none."
        print_note(Finding("path-frame", text, "info"))
    if items[0].scene is None and options.path is None and not flight.given:
        text = "The model has no cameras, so the path circles it; pass --scene for another."
        print_note(Finding("no-cameras", text, "info"))


def _summarise(options: Options, flight: _Flight, seconds: float) -> None:
    number = len(flight.views)
    sizes = [(view.width, view.height) for view in flight.views]
    ends = dict.fromkeys((min(sizes), max(sizes)))
    size = " to ".join(f"{width} x {height}" for width, height in ends)
    files = [options.output] if options.is_video else list(options.output.glob("*.png"))
    written = f"{options.output}, {sum(each.stat().st_size for each in files) / 1e6:.1f} MB"
    rows = [
        ("frames", f"{number:,} of {size}" + f", {flight.fps:g} a second" * options.is_video),
        ("rendering", f"{seconds:.1f} s, {1e3 * seconds / number:.0f} ms a frame"),
        ("video" if options.is_video else "pictures", written),
    ]
    print_pairs("splatseed flight", rows)
    add_results(output=options.output, frames=number, sizes=list(ends), seconds=seconds)


def _open_models(options: Options) -> list[ViewerItem]:
    from splatseed.viewer.cameras import is_scene
    from splatseed.viewer.models import open_item, same_world, unique_names

    paths = [path for path in (options.model, options.compare) if path is not None]
    scene = options.scene
    if scene is None and options.cameras and is_scene(options.cameras):
        scene = None if options.model.is_dir() else options.cameras  # a run has its own
    refuse(
        (options.exclude and options.file and not is_scene(options.file),
         "--exclude with cameras of a scene", options.file, "Leave one of them out."),
    )  # fmt: skip
    excluded = () if options.cameras else options.exclude
    named = zip(unique_names(paths), paths, strict=True)
    items = [replace(open_item(path, scene, excluded), name=name) for name, path in named]
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


def _chosen_size(options: Options) -> tuple[int, int] | None:
    if options.size is None:
        return None
    sides = options.size.lower().split("x")
    if len(sides) != 2 or not all(s.isdigit() and MIN_SIDE <= int(s) <= MAX_SIDE for s in sides):
        raise ParameterError(
            f"--size WxH of {MIN_SIDE} to {MAX_SIDE} pixels a side",
            found=repr(options.size),
            fix="Try --size 960x540.",
        )
    return int(sides[0]), int(sides[1])


def _flight(options: Options, item: ViewerItem) -> _Flight:
    from splatseed.photos.upright import vertical
    from splatseed.viewer import flights
    from splatseed.viewer.camera_path import read_camera_path
    from splatseed.viewer.cameras import GivenCameras, read_cameras
    from splatseed.viewer.videos import even_size

    chosen, cameras = _chosen_size(options), item.central_views
    size = next((even_size(v.width, v.height, DEFAULT_SIDE) for v in cameras), WITHOUT_CAMERAS)
    if options.cameras is not None:
        given = read_cameras(options.cameras, item.scene, options.exclude)
        sizes = {(view.width, view.height) for view in given.views}
        refuse(
            (options.is_video and chosen is None and len(sizes) > 1,
             "cameras of one size, for a video", f"{len(sizes)} sizes",
             "Write pictures (-o FOLDER), or pass --size."),
        )  # fmt: skip
        size = chosen or min(sizes)
    elif options.file is not None:
        path = read_camera_path(options.file)
        size = chosen or path.size or size
        given = GivenCameras(tuple(path.views(size)), of_scene=False, path=path)
    size = even_size(*(chosen or size)) if options.is_video else chosen or size
    if options.file is None:
        frames = max(1, round((options.seconds or SECONDS) * FPS))
        if options.path == ORBIT or len(cameras) < 2:
            found = list[Finding]()
            up = vertical(item.scene, [view.camera for view in cameras])
            views = flights.orbit(cameras, item.model, frames, size, up=up, note=found.append)
            return _Flight(views, FPS, findings=tuple(found))
        return _Flight(flights.smooth_path(cameras, frames, size), FPS)
    if options.is_video:
        given = replace(given, views=tuple(flights.at_size(view, size) for view in given.views))
    views, world = _in_models_world(options, item, given)
    fps = (given.path and given.path.fps) or FPS
    fps = len(views) / options.seconds if options.seconds else fps
    return _Flight(views, fps, given, world, given.findings)


def _in_models_world(
    options: Options, item: ViewerItem, given: GivenCameras
) -> tuple[list[View], Similarity | None]:
    from splatseed.splat.model_frame import NO_TRANSFORM, find_transform
    from splatseed.viewer.camera_path import check_path

    # From the scene's world to the cameras', which by default is the model's as in its file.
    world = item.moved.inverse if item.moved and not given.of_scene else None
    if options.transform is not None:
        world = find_transform(options.transform, item.scene or Scene(PointCloud.empty()))
    views = given.moved(world)
    if world is None and item.scene is not None and not given.of_scene:
        # They may be in the coordinates of the scene's files.
        centers = np.array([view.camera.center for view in views])
        shift = find_shift(item.scene, centers, unrecorded=True)
        if shift.any():
            world = Similarity(1.0, np.eye(3), -shift)
            views = given.moved(world)
    if options.transform != NO_TRANSFORM:
        assert options.file is not None  # noqa: S101  (it has the cameras)
        check_path(options.file, views, item.model, item.central_views)
    return views, world
