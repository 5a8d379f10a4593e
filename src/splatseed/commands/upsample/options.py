"""The options of ``splatseed upsample``, with those of every method."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from inspect import getdoc
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from splatseed.checkup.choices import UnfitPoints
from splatseed.commands.options import check_minimum, parse_options, parse_some, refuse
from splatseed.depthmap import DepthKind
from splatseed.io.regions import REGION_FORM
from splatseed.methods import METHODS, Profile, Upsampler, configure
from splatseed.runtime.memory import parse_bytes
from splatseed.seeding.advice import DEFAULT_METHOD
from splatseed.text import quoted
from splatseed.training.request import ExcludeChoice, MaskChoice

POINT_FILES = (".ply", ".las", ".laz", ".e57", ".pcd", ".xyz", ".pts", ".npz", ".bin", ".txt")
"""Suffixes that suggest the user wants a point file, not a scene folder."""
COVERING = ("auto", "cover")
"""Methods that cover empty cells themselves, without --cover."""
CLOUD = "cloud"
WITH_CLOUD = (CLOUD, "auto", "stereo", "cover", "depth")
"""Methods that take --cloud."""


@dataclass(frozen=True)
class Options:
    """Upsample the points of a scene, ready for any 3DGS trainer."""

    scene: Annotated[Path, tyro.conf.Positional]
    """A COLMAP folder, one with transforms.json, an RGB-D capture, or a .ply of points; other
    clouds are seeds of a scene (--cloud)."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])]
    """The scene folder to write."""
    method: str = DEFAULT_METHOD
    """The method that makes new points; --method NAME --help shows its own options. FILE.py:NAME
    is a method of your own."""
    ratio: float | None = None
    """Total points per original point, for methods that interpolate; 4 unless --num-points is
    given."""
    num_points: int | None = None
    """Total points, not a ratio."""
    budget: Annotated[str | None, tyro.conf.arg(metavar="N|Xrho")] = None
    """Maximum points: a number, or 0.25rho for a quarter of the pixels of a photograph of at most
    1600 a side. Methods auto and stereo make up to that many where photographs confirm them."""
    cover_cell: Annotated[int | None, tyro.conf.arg(name="cover")] = None
    """Add a seed to every photograph cell without a point; the value is the cell's side in pixels.
    Methods auto and cover have --auto.cell and --cover.cell instead."""
    region: Annotated[str | None, tyro.conf.arg(metavar=REGION_FORM)] = None
    """Make new points in a region alone: a box by its minimum and maximum corners, a sphere, or the
    matrix of a turned box, as numbers or a file. The scene's own points stay everywhere; write
    --region=-1,... if the first number is negative."""
    seed: int = 0
    """Random seed: same seed, same bytes."""
    profile: Profile = "default"
    """Defaults of the methods' options: improved ones, or those of the paper's text."""
    depth_maps: Annotated[Path | None, tyro.conf.arg(name="depth", metavar="DIR")] = None
    """For --method depth: a folder of maps, as docs/formats.md lists them; by default the
    scene's own."""
    depth_kind: DepthKind | None = None
    """Values of the maps: planar depth (z), distance along the ray, or inverse depth; by default
    the folder's own statement, else z."""
    depth_scale: float | None = None
    """Stored units per unit of depth: 1000 for millimetres in a scene in metres; by default the
    folder's own statement."""
    masks: MaskChoice = None
    """A folder of masks, where pixels of 0 do not count, or none; inverted: only they count. By
    default the folder masks beside the photographs. Transparent pixels are empty space around an
    object that is cut out, and do not count elsewhere; none: always empty, alpha: never."""
    refine_poses: bool = False
    """First refine the poses, such as a phone's or SLAM's, unless that gains nothing. Points are
    triangulated there in place of those with tracks; others, such as LiDAR's, stay."""
    unfit_points: UnfitPoints = "drop"
    """What to do with the scene's points where photographs contradict them: leave them out, move
    them by the similarity that fits, or keep them."""
    drop_wrong_poses: bool = False
    """Leave out single photographs whose poses do not fit the points that other photographs
    confirm."""
    exclude: ExcludeChoice = ()
    """Photographs to leave out: a name, a pattern such as 'IMG_00*', or a .txt file of these."""
    cloud_files: Annotated[
        tyro.conf.UseAppendAction[tuple[Path, ...]],
        tyro.conf.arg(name="cloud", metavar="FILE", help_behavior_hint="(repeatable)"),
    ] = ()
    """Seeds from a scan or dense cloud (docs/scans.md), alone or with
    auto, stereo, cover or depth."""
    cloud_transform: Annotated[Path | None, tyro.conf.arg(name="transform")] = None
    """For --cloud: a 4x4 matrix from its frame to the scene's, as text or JSON, or nerfstudio's
    dataparser_transforms.json."""
    align: bool = False
    """For --cloud: find the transform by aligning the cloud with the scene's points."""
    recenter: bool = False
    """Move the scene, and a cloud in its frame, to the origin; recenter.json has the offset."""
    memory: Annotated[str | None, tyro.conf.arg(metavar="BYTES|4G")] = None
    """For --cloud: the memory within which scans are merged; by default what is free, at most
    4G."""
    preview: bool = False
    """Also write pictures: before and after, origins, cells covered, the method's stereo maps."""
    gaussians: Path | None = None
    """Also write the initial Gaussians as a 3DGS .ply, for trainers that start from one."""
    format: Literal["auto", "colmap", "transforms"] = "auto"
    """Layout to write: auto is COLMAP's, and for a scene from a transforms.json both."""
    copy_images: bool = False
    """Copy images instead of linking them."""
    overwrite: bool = False
    """Replace an earlier output."""

    @property
    def memory_bytes(self) -> int | None:
        """The memory limit in bytes; None if there is none."""
        return None if self.memory is None else parse_bytes(self.memory)


@dataclass(frozen=True)
class _Choice:
    """The options that determine which methods have options here, and the defaults of those."""

    method: str | None = None  # perhaps unknown
    profile: Profile = "default"


def parse(arguments: list[str]) -> tuple[Options, dict[str, Upsampler]]:
    """Parse the options of the verb and of every method."""
    chosen = parse_some(_Choice, arguments)
    names = dict.fromkeys(METHODS)
    earlier = any(word.partition("=")[0] == "--depth.region" for word in arguments)
    refuse((earlier, "--depth.central-fraction", "its earlier name, --depth.region", "Rename it."))
    if chosen.method is not None:
        METHODS[chosen.method]  # raises for an unknown one, with advice
        names[chosen.method] = None

    def parsed(names: Iterable[str], *, quiet: bool = False) -> Any:
        kind = _with_methods({name: configure(name, chosen.profile) for name in names})
        return parse_options(kind, "upsample", arguments, quiet=quiet)

    if {"-h", "--help"} & set(arguments):  # the options of all methods are too many to read
        parsed([] if chosen.method is None else [chosen.method])
    try:  # the options of all methods would take four times as long
        with_options = (name for name in names if ":" in name or _has_options(name, arguments))
        options = parsed(with_options, quiet=True)
    except SystemExit as stop:
        if not stop.code:  # what was asked for is printed
            raise
        options = parsed(names)  # what is wrong is told with all methods in view
    if options.cloud_files and chosen.method is None:
        options = replace(options, method=CLOUD)
    return options, {
        name: getattr(options, _field(name), None) or configure(name, chosen.profile)
        for name in names
    }


def _field(method: str) -> str:
    """Return the prefix of a method's options: its name, without its place."""
    name = method.rpartition(":")[2]
    return f"own_{name}" if name != method and name in METHODS else name


def _has_options(method: str, arguments: list[str]) -> bool:
    start = f"--{_field(method)}.".replace("_", "-")  # tyro takes either
    return any(word.replace("_", "-").startswith((start, "--tyro-")) for word in arguments)


def full_options() -> type[Options]:
    """Return the options of the verb and of every method."""
    return _with_methods({name: configure(name) for name in METHODS})


def _with_methods(methods: Mapping[str, Upsampler]) -> type[Options]:
    """Return the options with a field per method, whose default is the method given."""
    # Named here, a method's help need not be searched for in sources, half the time to parse.
    fields: list[Any] = [
        (_field(name), type(method),
         dataclasses.field(default=method, metadata={"help": getdoc(method)}))
        for name, method in methods.items() if dataclasses.is_dataclass(method)
    ]  # fmt: skip
    names = tuple(dict.fromkeys((*METHODS, *methods)))
    full = dataclasses.make_dataclass(
        "UpsampleOptions",
        [("method", Literal[names], dataclasses.field(default=DEFAULT_METHOD)), *fields],
        bases=(Options,),
        frozen=True,
    )
    full.__doc__ = Options.__doc__
    return full


def check(options: Options) -> None:
    """Refuse options out of range, and combinations in which one has no effect."""
    check_minimum(options, 1, "num_points")
    check_minimum(options, 0, "seed")
    method, cell, folder = options.method, options.cover_cell, options.output
    maps = options.depth_kind is not None or options.depth_scale is not None
    moved = options.cloud_transform is not None
    framed = moved or options.align or method == CLOUD
    refuse(
        (folder.suffix.lower() in POINT_FILES and not folder.is_dir(),
         "a folder for -o, as a whole scene is written", f"{folder}, the name of a file",
         f"Pass -o {quoted(folder.parent / folder.stem)}: a .ply of the points is included."),
        (cell is not None and cell < 1, "--cover of 1 or more", cell, "Try --cover 8."),
        (cell is not None and method in COVERING,
         f"--{method}.cell for method {method}, which already covers", f"--cover {cell}",
         f"Use --{method}.cell {cell} instead."),
        (maps and options.depth_maps is None,
         "--depth DIR, which --depth-kind and --depth-scale refer to", "none", "Name the folder."),
        (framed and not options.cloud_files, "--cloud FILE", "none", "Name the scan."),
        (options.memory is not None and not options.cloud_files,
         "--cloud FILE with --memory, within which scans are merged", "none", "Leave it out."),
        (options.cloud_files and method not in WITH_CLOUD,
         f"--method {', '.join(WITH_CLOUD[:-1])} or {WITH_CLOUD[-1]} with --cloud", method,
         "Leave --method out for the cloud's points alone: interpolating needs no scan."),
        (options.align and moved, "--align or --transform", "both", "Leave one of them out."),
    )  # fmt: skip
    if (start := options.gaussians) is not None:
        inside = folder.resolve() in (start.resolve(), *start.resolve().parents)
        refuse(
            (start.suffix.lower() != ".ply", "--gaussians FILE.ply", start, "Name a .ply file."),
            (inside, "a file outside the scene that is written, for the initial Gaussians",
             f"{start} in {folder}, where some trainers read any .ply as points",
             "Name a file beside the folder."),
        )  # fmt: skip
