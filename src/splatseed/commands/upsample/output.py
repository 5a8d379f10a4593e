"""What ``splatseed upsample`` says it will do, and what it prints, draws and writes at its end."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from splatseed.commands.next_steps import tell_training
from splatseed.console import StageClock, print_note, print_pairs
from splatseed.errors import OutputError, ParameterError
from splatseed.io import WriteReport
from splatseed.io.staging import check_parents
from splatseed.pointcloud import PointCloud
from splatseed.progress import Progress, silent
from splatseed.scene import Image, Scene
from splatseed.seeding.photographs import (
    MAX_SIZE,
    Stereo,
    begins_from_points,
    has_points,
    photographed,
    read_views,
)
from splatseed.seeding.upsampling import CELL
from splatseed.splat.formats import write_model
from splatseed.train.seeds import gaussians_of_scene
from splatseed.train.settings import TrainSettings
from splatseed.upsample import Profile, Upsampler, configure
from splatseed.upsample.registry import origin_name

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


def method_words(name: str, method: Upsampler, profile: Profile) -> str:
    """A method with what the user changed about it.

    Example:
        >>> method_words("mls", configure("mls", "paper", k=12), "paper")
        'mls (profile paper, k=12)'
    """
    plain = parameters_of(configure(name, profile))
    changed = [f"{k}={v}" for k, v in parameters_of(method).items() if v != plain[k]]
    words = [] if profile == "default" else [f"profile {profile}"]
    told = ", ".join([*words, *changed])
    return f"{name} ({told})" if told else name


def number_words(total: int | None, most: int | None, changed_by: Sequence[str] = ()) -> str:
    """How many points there will be.

    Args:
        total: Points in all; None if the photographs determine the number.
        most: The budget, if there is one.
        changed_by: Options that add points to the method's, or drop some of them.

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


def found_how(scene: Scene, method: Upsampler) -> str:
    """How a method that compares photographs finds depth without enough points; else empty.

    Args:
        scene: The scene.
        method: The method that makes its points.
    """
    if not isinstance(method, Stereo) or begins_from_points(scene):
        return ""
    points = "too few" if has_points(scene) else "no"
    where = "" if scene.depths is None else ", around its depth maps"
    return f": {points} points, so depth is found by comparing photographs{where}"


def check_start(path: Path, output: Path, *, overwrite: bool) -> None:
    """Refuse an unusable name for the initial Gaussians before any work is done.

    Args:
        path: The .ply.
        output: The scene folder that is written beside it.
        overwrite: Whether an existing file may be replaced.

    Raises:
        ParameterError: It is not named .ply.
        OutputError: It is taken, or lies in the output folder.
    """
    if path.suffix.lower() != ".ply":
        raise ParameterError("--gaussians FILE.ply", found=str(path), fix="Name a .ply file.")
    check_parents(path)
    target, folder = path.resolve(), output.resolve()
    if folder == target or folder in target.parents:
        raise OutputError(
            "a file outside the scene that is written, for the initial Gaussians",
            found=f"{path} in {output}, where some trainers read any .ply as points",
            fix="Name a file beside the folder.",
        )
    if path.exists() and not overwrite:
        raise OutputError(
            f"no file at {path}", found="one", fix="Choose another name, or pass --overwrite."
        )


def write_start(path: Path, scene: Scene, method: Upsampler, progress: Progress) -> None:
    """Write the Gaussians that training from a scene's points would start with.

    Args:
        path: The .ply.
        scene: The scene with the seeds as its points; the Gaussians are in its world.
        method: The method that made them; photographs that it held out are not used.
        progress: Told how far it is.

    Raises:
        SceneNotFoundError: The scene has no photographs, which bound the size of a Gaussian.
        OutputError: The file cannot be written.
    """
    images = photographed(scene, getattr(method, "hold_out", 0))
    views = read_views(scene, images, MAX_SIZE, progress)
    settings = TrainSettings(strategy="grow", seed_colors=True)
    write_model(path, gaussians_of_scene(scene.points, views, settings))


def write_previews(
    scene: Scene,
    seeds: PointCloud,
    name: str,
    method: Upsampler,
    seed: int,
    folder: Path,
    clock: StageClock,
) -> None:
    """Draw before and after; with photographs also origins, covered cells and stereo's maps.

    Args:
        scene: The scene, with the originals that were used.
        seeds: The points that were written.
        name: The name of the method that made them.
        method: That method.
        seed: The seed that was used.
        folder: Where the pictures go.
        clock: Told the stages.
    """
    from splatseed.view.clouds import preview_origins, preview_pair  # noqa: PLC0415  (Pillow)
    from splatseed.view.maps import preview_maps  # noqa: PLC0415  (Pillow)

    clock("preview", 0.0)
    preview_pair(scene, seeds, folder / PAIR, title=name)
    if scene.has_photographs:
        clock("preview", 0.4)
        preview_origins(scene, seeds, folder / ORIGINS)
        clock("preview", 0.6)
        _draw_cells(scene, seeds, folder / CELLS)
    if isinstance(method, Stereo):
        shown = _some_of(photographed(scene, method.hold_out))
        # Recomputed for the few that are shown: keeping all maps would take as much memory as the
        # views.
        maps = method.maps(scene, shown, seed, clock)
        clock("preview", 0.9)
        preview_maps(scene, maps, folder / MAPS)
    clock("preview", 1.0)


def _draw_cells(scene: Scene, seeds: PointCloud, path: Path) -> None:
    """Which cells of some photographs hold a point, before and after."""
    from splatseed.seeding.coverage import covered_cells  # noqa: PLC0415  (kernels load with use)
    from splatseed.view.clouds import CoveredView, preview_cells  # noqa: PLC0415  (Pillow)

    images = photographed(scene)
    views = read_views(scene, [images[i] for i in _some_of(images)], MAX_SIZE, silent)
    clouds = [cloud.xyz[cloud.finite] for cloud in (scene.points, seeds)]
    before, after = (covered_cells(views, xyz, CELL) for xyz in clouds)
    shown = [
        CoveredView(view.name, view.photograph, CELL, old, new)
        for view, old, new in zip(views, before, after, strict=True)
    ]
    preview_cells(shown, path)


def _some_of(images: Sequence[Image]) -> list[int]:
    """At most ``PHOTOGRAPHS_SHOWN``, evenly chosen."""
    places = np.linspace(0, len(images) - 1, min(PHOTOGRAPHS_SHOWN, len(images)))
    return [int(place) for place in np.unique(places.round())]


def summarise(
    read_from: Path,
    scene: Scene,
    seeds: PointCloud,
    report: WriteReport,
    seconds: Mapping[str, float],
    checks: Mapping[str, float],
    output: Path,
    files: Mapping[str, Sequence[str]],
) -> None:
    """Print the final table and the commands to run next.

    Args:
        read_from: Where the scene was read.
        scene: The scene as it was read.
        seeds: The points that were to be written.
        report: The report of writing.
        seconds: Seconds by stage.
        checks: ``far``, the share of new points far from any original; ``before`` and ``after``,
            the share of the photographs that the points cover.
        output: The scene folder.
        files: Names of further files in it, by label; those that are not there are left out.
    """
    written = seeds if len(seeds) == report.num_points else seeds.select(seeds.distinct)
    rows = [
        ("points in", f"{len(scene.points):,}"),
        ("points out", f"{report.num_points:,} ({_origins(written)})"),
        *_findings(checks),
        ("seconds", ", ".join(f"{stage} {time:.2f}" for stage, time in seconds.items())),
        ("output", str(output)),
    ]
    if linked := _linked(output, report):
        where = ", ".join(map(str, linked))
        rows.append(("images", f"linked, not copied: {where}; --copy-images to move OUT elsewhere"))
    if left_out := _left_out(scene, report):
        rows.insert(2, ("left out", left_out))
    for label, names in files.items():
        there = [output / name for name in names if (output / name).is_file()]
        rows += [("" if i else label, str(path)) for i, path in enumerate(there)]
    print_pairs("splatseed upsample", rows)
    for note in report.notes:
        print_note(note)
    if report.layout == "transforms":
        print_note(
            "The commands of gsplat's examples, graphdeco's code and LichtFeld are for COLMAP's "
            "layout: --format colmap."
        )
    tell_training(read_from, scene, output, report.layout)


def _linked(output: Path, report: WriteReport) -> list[Path]:
    """Where photographs lie that the output only links."""
    links = [Path(name) for name in report.files if (output / name).is_symlink()]
    photographs = [link for link in links if link.parts[0] == "images"] or links
    there = [(output / link).resolve() for link in photographs]
    return sorted({path if path.is_dir() else path.parent for path in there})


def _left_out(scene: Scene, report: WriteReport) -> str:
    """How many points of the input the output lacks, and why; empty if it has all."""
    thinned = scene.points.num_original - report.num_original
    parts = []
    if report.dropped_nonfinite + report.dropped_duplicates:
        parts += [f"{report.dropped_nonfinite:,} not finite"]
        parts += [f"{report.dropped_duplicates:,} duplicate"]
    if thinned > 0:
        parts += [f"{thinned:,} originals, for the budget, where they crowd"]
    return ", ".join(parts)


def _origins(seeds: PointCloud) -> str:
    """How many points have which origin."""
    codes, counts = np.unique(seeds.source, return_counts=True)
    return ", ".join(
        f"{count:,} {origin_name(int(code))}" for code, count in zip(codes, counts, strict=True)
    )


def _findings(checks: Mapping[str, float]) -> list[tuple[str, str]]:
    rows = []
    if "far" in checks:
        rows.append(
            ("far from any original", f"{checks['far']:.2%} of the new points, over 3 spacings")
        )
    if "after" in checks:
        share = f"{checks['after']:.1%} of the 8 x 8 pixel cells of the photographs have a point"
        rows.append(("covered", f"{share}; {checks['before']:.1%} before"))
    return rows
