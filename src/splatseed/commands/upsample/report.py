"""Describe, summarise and draw a run of ``splatseed upsample``."""

from __future__ import annotations

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from splatseed.commands.next_steps import Source, print_training
from splatseed.commands.upsample.options import Options
from splatseed.console import StageClock, add_results, print_note, print_pairs
from splatseed.depthmap import in_scene_units
from splatseed.findings import Finding
from splatseed.io import WriteReport
from splatseed.io.load import depths_beside
from splatseed.io.staging import read_manifest
from splatseed.methods import (
    Profile,
    Upsampler,
    chooses_number,
    configure,
    source_code,
    source_name,
)
from splatseed.pointcloud import ORIGINAL, PointCloud
from splatseed.progress import silent
from splatseed.sampling import evenly_spaced
from splatseed.scene import Scene
from splatseed.seeding.geometry_score import far_share
from splatseed.seeding.photo_methods import CELL, MAX_SIZE, Stereo, photographed, read_views
from splatseed.text import agreeing, counted, quoted

ALIGNMENT = "alignment.json", "preview_alignment.png"
PAIR, ORIGINS, CELLS, MAPS = PICTURES = (
    "preview.png",
    "preview_origins.png",
    "preview_cells.png",
    "preview_maps.png",
)
PHOTOGRAPHS_SHOWN = 4
"""Photographs whose cells and maps are drawn."""
CLOUD_PARAMETERS = {"files", "transform", "memory", "alone"}
"""Parameters of the method cloud that other lines show."""
MEASURED = {
    "stereo": "points on surfaces that photographs confirm",
    "depth": "points at the depth of depth maps",
    "cloud": "points of the scan",
}
"""Origins of new points at a measured depth, and what they are."""
GUESSED = "guessed from neighbours"
INTERPOLATING = ("linear", "triangle", "spline", "mls", "voronoi", "random")


def parameters_of(method: Upsampler) -> dict[str, object]:
    """Return a method's parameters by name, without those of a cloud that other lines show."""
    given: dict[str, Any] = {}
    if dataclasses.is_dataclass(method) and not isinstance(method, type):
        given = dataclasses.asdict(method)
    return {name: value for name, value in given.items() if name not in CLOUD_PARAMETERS}


def provenance(
    options: Options, scene: Scene, method: Upsampler, coverage: Coverage | None
) -> dict[str, object]:
    """Return how the output was made, for ``splatseed.json``."""

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
        "exclude": options.exclude,
        "listed_tests_held_out": scene.listed is not None,
        "cloud": cloud if options.cloud_files else None,
        "depth": full(options.depth_maps),
        "ratio": options.ratio,
        "num_points_asked": options.num_points,
        "budget": options.budget,
        "cover": options.cover_cell,
        "region": options.region,
        "covered": None if coverage is None else {"cell": CELL, **coverage._asdict()},
        "seed": options.seed,
    }


def method_description(name: str, method: Upsampler, profile: Profile) -> str:
    """Name a method and the parameters that differ from the profile's.

    Example:
        >>> method_description("mls", configure("mls", "paper", k=12), "paper")
        'mls (profile paper, k=12)'
    """
    plain = parameters_of(configure(name, profile))
    changes = [] if profile == "default" else [f"profile {profile}"]
    changes += [f"{k}={v}" for k, v in parameters_of(method).items() if v != plain[k]]
    return f"{name} ({', '.join(changes)})" if changes else name


def triangulated(own: int, kept: int, total: int) -> str:
    """Say which of a number of points refinement triangulated; empty if none.

    Example:
        >>> triangulated(5740, 0, 100), triangulated(5740, 5000, 5100)
        (", triangulated in place of the scene's 5,740", ', 100 of them triangulated')
    """
    if kept == total or not own:
        return ""
    return (
        f", {total - kept:,} of them triangulated"
        if kept
        else f", triangulated in place of the scene's {own:,}"
    )


def number_summary(total: int | None, limit: int | None, *, covered: bool = False) -> str:
    """Say how many points to expect; if ``covered``, ``--cover`` adds some.

    Example:
        >>> number_summary(None, 50_000), number_summary(800, 1000)
        ('at most 50,000 points', '800 points')
    """
    if limit is not None and (total is None or total > limit):
        return f"at most {limit:,} points"
    if total is None:
        return "as many points as the photographs need"
    return f"{total:,} points before --cover" if covered else f"{total:,} points"


def unused_maps(options: Options, scene: Scene, method: Upsampler) -> tuple[Finding, ...]:
    """Point out the scene's depth maps if the method does not use them."""
    attached, beside = scene.depths, depths_beside(scene)
    maps = attached or beside
    used = in_scene_units(attached) and getattr(method, "depth_maps", False)
    if not maps or used or options.method == "depth" or options.depth_maps is not None:
        return ()
    others = "method depth aligns them with the points"
    if in_scene_units(attached):
        others = "methods auto and depth use them"
    are = agreeing(len(maps), "is", "are")
    text = f"Its {counted(len(maps), 'depth map')} {are} not used by {options.method}: {others}."
    return (Finding("unused-depth-maps", text),)


class Coverage(NamedTuple):
    """Shares, 0 to 1, of the photographs' cells, ``CELL`` pixels a side, that hold a point."""

    before: float  # of the scene
    measured: float  # of the scene, or at a depth that was measured
    total: float  # of any kind, guesses included


def measure_coverage(scene: Scene, seeds: PointCloud) -> Coverage | None:
    """Return the coverage of the photographs; None without images."""
    if not scene.images:
        return None
    from splatseed.seeding.upsampling import share_covered

    measured = seeds.select(np.isin(seeds.source, [ORIGINAL, *map(source_code, MEASURED)]))
    return Coverage(*(share_covered(scene, each) for each in (scene.points, measured, seeds)))


def quality_rows(
    options: Options, scene: Scene, seeds: PointCloud, method: Upsampler, coverage: Coverage | None
) -> list[tuple[str, str]]:
    """Return rows on new points far from the originals, and on photograph cells covered."""
    rows = []
    if len(scene.points) and not chooses_number(method):
        new = seeds.xyz[seeds.source != ORIGINAL]
        far = far_share(scene.points.xyz, new)
        rows.append(("far from any original", f"{far:.2%} of the new points, over 3 spacings"))
    if coverage is not None:
        rows += _coverage_rows(coverage, origin_counts(seeds, options.method))
    return rows


def _coverage_rows(coverage: Coverage, counts: Mapping[str, int]) -> list[tuple[str, str]]:
    """Describe cells with measured points, and those that only hold points of other kinds."""
    kinds = [words for name, words in MEASURED.items() if name in counts]
    if coverage.before or not kinds:
        kinds.insert(0, "points of the scene")
    cells = f"of the {CELL} x {CELL} pixel cells of the photographs hold {' or '.join(kinds)}"
    before = f"; {coverage.before:.1%} before" if coverage.before else ""
    rows = [("covered", f"{coverage.measured:.1%} {cells}{before}")]
    others = {n: counts[n] for n in counts if n not in {*MEASURED, source_name(ORIGINAL)}}
    if others:
        how = {**dict.fromkeys(INTERPOLATING, "interpolated between points"), "cover": GUESSED}
        made = " or ".join(f"{how.get(name, 'made')} by {name}" for name in others)
        of = f"{sum(others.values()):,} of {sum(counts.values()):,} points"
        share = max(0.0, coverage.total - coverage.measured)
        label = "guessed" if {*others} == {"cover"} else "not confirmed"
        rows.append((label, f"{share:.1%} hold only points {made} ({of})"))
    return rows


def origin_counts(seeds: PointCloud, method: str, written: int | None = None) -> dict[str, int]:
    """Count the points by origin, ``method`` if no other is known.

    Fewer than ``seeds`` are ``written`` if positions repeat.
    """
    if written is not None and len(seeds) > written:
        seeds = seeds.select(seeds.distinct)
    codes, counts = np.unique(seeds.source, return_counts=True)
    names = [source_name(code, method) for code in codes.tolist()]
    return dict(zip(names, counts.tolist(), strict=True))


def colmap_command(arguments: Sequence[str], output: Path) -> str:
    """Return the command that writes the same scene in COLMAP's layout, beside the output.

    Example:
        >>> colmap_command(["my scene", "-o", "OUT", "--ratio=8"], Path("OUT"))
        "splatseed upsample 'my scene' --ratio=8 --format colmap -o OUT-colmap"
    """
    replaced, words, rest = ("-o", "--output", "--format"), list[str](), iter(arguments)
    for word in rest:
        if word in replaced:
            next(rest, None)  # its value
        elif word.partition("=")[0] not in replaced:
            words.append(shlex.quote(word))
    return f"splatseed upsample {' '.join(words)} --format colmap -o {quoted(f'{output}-colmap')}"


def summarise(
    options: Options,
    scene: Scene,
    points_in: str,
    origins: Mapping[str, int],
    written: WriteReport,
    seconds: Mapping[str, float],
    found: Sequence[tuple[str, str]],
    arguments: Sequence[str],
) -> None:
    """Print the final table and the commands to run next.

    ``points_in`` adds to their number; ``arguments`` are those of the verb.
    """
    output, left_out = options.output, []
    if written.dropped_nonfinite + written.dropped_duplicates:
        left_out += [f"{written.dropped_nonfinite:,} not finite"]
        left_out += [f"{written.dropped_duplicates:,} duplicate"]
    if thinned := len(scene.points) - written.num_original:
        left_out += [f"{thinned:,} originals, for the budget"]
    made = ", ".join(f"{count:,} {name}" for name, count in origins.items())
    rows = [
        ("points in", f"{len(scene.points) + sum(scene.left_out):,}{points_in}"),
        ("points out", f"{written.num_points:,} ({made})"),
        *([("left out", ", ".join(left_out))] if left_out else []),
        *found,
        ("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in seconds.items())),
        ("output", str(output)),
    ]
    here = output.resolve()
    links = [Path(name) for name in written.files if (output / name).is_symlink()]
    links = [link for link in links if here not in (output / link).resolve().parents]
    photographs = [link for link in links if link.parts[0] == "images"] or links
    there = [(output / link).resolve() for link in photographs]
    if linked := sorted({str(path if path.is_dir() else path.parent) for path in there}):
        hint = "--copy-images makes a folder that can be moved"
        rows.append(("images", f"linked, not copied: {', '.join(linked)}; {hint}"))
    for label, names in (("alignment", ALIGNMENT), ("pictures", PICTURES)):
        paths = [output / name for name in names if (output / name).is_file()]
        rows += [("" if i else label, str(path)) for i, path in enumerate(paths)]
    print_pairs("splatseed upsample", rows)
    made_by = {key: value for key, value in read_manifest(output).items() if key != "files"}
    add_results(output=output, **made_by, origins=origins, seconds=seconds)
    print_note(*written.findings)
    if written.layout == "transforms":
        text = (
            "gsplat's examples, graphdeco's code and LichtFeld need COLMAP's layout, written by: "
            f"{colmap_command(arguments, output)}"
        )
        print_note(Finding("colmap-layout", text, "info"))
    print_training(Source(options.scene, options.exclude), scene, output, written.layout)


def write_previews(
    options: Options, scene: Scene, seeds: PointCloud, method: Upsampler, clock: StageClock
) -> None:
    """Draw the points before and after; with photographs, also origins, cells and stereo's maps."""
    from splatseed.seeding.cover import covered_cells
    from splatseed.viewer import clouds, maps

    folder = options.output
    clock("preview", 0.0)
    clouds.preview_pair(scene, seeds, folder / PAIR, title=options.method)
    if scene.has_photographs:
        clock("preview", 0.4)
        clouds.preview_origins(scene, seeds, folder / ORIGINS, options.method)
        clock("preview", 0.6)
        images = photographed(scene)
        images = tuple(images[i] for i in evenly_spaced(len(images), PHOTOGRAPHS_SHOWN))
        views = read_views(scene, images, MAX_SIZE, silent)
        both = [cloud.xyz[cloud.finite] for cloud in (scene.points, seeds)]
        cells = zip(views, *(covered_cells(views, xyz, CELL) for xyz in both), strict=True)
        shown = [
            clouds.CoveredView(v.name, v.photograph, CELL, before, after)
            for v, before, after in cells
        ]
        clouds.preview_cells(shown, folder / CELLS)
    if isinstance(method, Stereo):
        # Recomputed for a few views: keeping all maps would take as much memory as the views.
        count = len(photographed(scene, method.test_every))
        some = evenly_spaced(count, PHOTOGRAPHS_SHOWN).tolist()
        maps.preview_maps(scene, method.maps(scene, some, options.seed, clock), folder / MAPS)
    clock("preview", 1.0)
