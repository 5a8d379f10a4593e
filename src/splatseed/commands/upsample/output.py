"""What ``splatseed upsample`` says it will do, and what it prints, draws and writes at its end."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatseed.commands.next_steps import tell_training
from splatseed.commands.upsample.cloud import ALIGNMENT
from splatseed.console import StageClock, print_note, print_pairs
from splatseed.io import WriteReport
from splatseed.io.origin import write_offset
from splatseed.methods import Profile, Upsampler, chooses_number, configure, source_name
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.diagnostics import far_share
from splatseed.seeding.photo_methods import MAX_SIZE, Stereo, photographed, read_views
from splatseed.seeding.upsampling import CELL, share_covered
from splatseed.splat.formats import write_model
from splatseed.training.seeds import gaussians_of_scene
from splatseed.training.settings import TrainSettings

if TYPE_CHECKING:
    from splatseed.commands.upsample.command import Options

PAIR, ORIGINS, CELLS, MAPS = PICTURES = (
    "preview.png",
    "preview_origins.png",
    "preview_cells.png",
    "preview_maps.png",
)
PHOTOGRAPHS_SHOWN = 4
"""Photographs whose cells and maps are drawn."""
TOLD_ELSEWHERE = {"files", "transform", "memory", "alone"}
"""Parameters of a cloud that other lines tell."""


def parameters_of(method: Upsampler) -> dict[str, object]:
    """The parameters of a method by name; a cloud's files are told elsewhere."""
    given = dataclasses.asdict(method)  # type: ignore[call-overload]  # a method is a dataclass
    return {name: value for name, value in given.items() if name not in TOLD_ELSEWHERE}


def provenance(options: Options, scene: Scene, method: Upsampler) -> dict[str, object]:
    """How the output was made, for ``splatseed.json``."""

    def full(path: Path | None) -> str | None:
        return None if path is None else str(path.resolve())

    cloud = {
        "files": [full(path) for path in options.cloud_files],
        "transform": full(options.cloud_transform),
        "align": options.align,
        "recenter": options.recenter,
        "memory": options.memory_bytes,
    }
    return {
        "command": "upsample",
        "method": options.method,
        "profile": options.profile,
        "parameters": parameters_of(method),
        "listed_tests_held_out": scene.listed is not None,
        "cloud": cloud if options.cloud_files else None,
        "depth": full(options.depth_maps),
        "ratio": options.ratio,
        "num_points_asked": options.num_points,
        "budget": options.budget,
        "cover": options.cover_cell,
        "verify": options.verify,
        "seed": options.seed,
    }


def method_words(name: str, method: Upsampler, profile: Profile) -> str:
    """A method with what the user changed about it.

    Example:
        >>> method_words("mls", configure("mls", "paper", k=12), "paper")
        'mls (profile paper, k=12)'
    """
    plain = parameters_of(configure(name, profile))
    words = [] if profile == "default" else [f"profile {profile}"]
    words += [f"{k}={v}" for k, v in parameters_of(method).items() if v != plain[k]]
    return f"{name} ({', '.join(words)})" if words else name


def number_words(total: int | None, most: int | None, changed_by: Sequence[str] = ()) -> str:
    """How many points there will be, if ``changed_by`` adds none and drops none.

    Example:
        >>> number_words(None, 50_000), number_words(800, 1000)
        ('at most 50,000 points', '800 points')
    """
    if most is not None and (total is None or total > most):
        return f"at most {most:,} points"
    if total is None:
        return "as many points as the photographs need"
    before = f" before {' and '.join(changed_by)}" if changed_by else ""
    return f"{total:,} points{before}"


def write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training from a scene's points would start with.

    Photographs that the method held out are not used.
    """
    images = photographed(scene, getattr(method, "test_every", 0))
    views = read_views(scene, images, MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_model(path, gaussians_of_scene(scene.points, views, settings))
    write_offset(path, scene.offset)


def write_previews(
    options: Options, scene: Scene, seeds: PointCloud, method: Upsampler, clock: StageClock
) -> None:
    """Draw before and after; with photographs also origins, covered cells and stereo's maps."""
    from splatseed.seeding.coverage import covered_cells
    from splatseed.viewer import clouds, maps

    folder = options.output
    clock("preview", 0.0)
    clouds.preview_pair(scene, seeds, folder / PAIR, title=options.method)
    if scene.has_photographs:
        clock("preview", 0.4)
        clouds.preview_origins(scene, seeds, folder / ORIGINS)
        clock("preview", 0.6)
        images = photographed(scene)
        views = read_views(scene, [images[i] for i in _some_of(images)], MAX_SIZE, silent)
        both = [cloud.xyz[cloud.finite] for cloud in (scene.points, seeds)]
        cells = zip(views, *(covered_cells(views, xyz, CELL) for xyz in both), strict=True)
        shown = [
            clouds.CoveredView(v.name, v.photograph, CELL, before, after)
            for v, before, after in cells
        ]
        clouds.preview_cells(shown, folder / CELLS)
    if isinstance(method, Stereo):
        # Recomputed for the few that are shown: keeping all maps would take as much memory as the
        # views.
        some = _some_of(photographed(scene, method.test_every))
        maps.preview_maps(scene, method.maps(scene, some, options.seed, clock), folder / MAPS)
    clock("preview", 1.0)


def _some_of(images: Sequence[Image]) -> list[int]:
    """At most ``PHOTOGRAPHS_SHOWN``, evenly chosen."""
    places = np.linspace(0, len(images) - 1, min(PHOTOGRAPHS_SHOWN, len(images)))
    return [int(place) for place in np.unique(places.round())]


def findings(scene: Scene, seeds: PointCloud, method: Upsampler) -> list[tuple[str, str]]:
    """Rows on how far off the points are, and how much of the photographs they cover."""
    rows = []
    if len(scene.points) and not chooses_number(method):
        new = seeds.xyz[seeds.source != ORIGINAL]
        far = far_share(scene.points.xyz, new)
        rows.append(("far from any original", f"{far:.2%} of the new points, over 3 spacings"))
    if scene.images:
        before, after = share_covered(scene, scene.points), share_covered(scene, seeds)
        share = f"{after:.1%} of the 8 x 8 pixel cells of the photographs have a point"
        rows.append(("covered", f"{share}; {before:.1%} before"))
    return rows


def origins_of(seeds: PointCloud, written: int) -> dict[str, int]:
    """How many of the points have each origin, of those that were ``written``."""
    if len(seeds) > written:
        seeds = seeds.select(seeds.distinct)
    codes, counts = np.unique(seeds.source, return_counts=True)
    return dict(zip(map(source_name, codes.tolist()), counts.tolist(), strict=True))


def summarise(
    options: Options,
    scene: Scene,
    num_read: int,
    origins: Mapping[str, int],
    report: WriteReport,
    seconds: Mapping[str, float],
    found: Sequence[tuple[str, str]],
) -> None:
    """Print the final table and the commands to run next."""
    output, left_out = options.output, []
    if report.dropped_nonfinite + report.dropped_duplicates:
        left_out += [f"{report.dropped_nonfinite:,} not finite"]
        left_out += [f"{report.dropped_duplicates:,} duplicate"]
    if thinned := num_read - report.num_original:
        left_out += [f"{thinned:,} originals, for the budget"]
    made = ", ".join(f"{count:,} {name}" for name, count in origins.items())
    rows = [
        ("points in", f"{num_read:,}"),
        ("points out", f"{report.num_points:,} ({made})"),
        *([("left out", ", ".join(left_out))] if left_out else []),
        *found,
        ("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in seconds.items())),
        ("output", str(output)),
    ]
    links = [Path(name) for name in report.files if (output / name).is_symlink()]
    photographs = [link for link in links if link.parts[0] == "images"] or links
    there = [(output / link).resolve() for link in photographs]
    if linked := sorted({str(path if path.is_dir() else path.parent) for path in there}):
        moving = "--copy-images to move OUT elsewhere"
        rows.append(("images", f"linked, not copied: {', '.join(linked)}; {moving}"))
    for label, names in (("alignment", ALIGNMENT), ("pictures", PICTURES)):
        paths = [output / name for name in names if (output / name).is_file()]
        rows += [("" if i else label, str(path)) for i, path in enumerate(paths)]
    print_pairs("splatseed upsample", rows)
    for note in report.notes:
        print_note(note)
    if report.layout == "transforms":
        print_note(
            "The commands for gsplat's examples, graphdeco's code and LichtFeld need COLMAP's "
            "layout: --format colmap."
        )
    tell_training(options.scene, scene, output, report.layout)
