"""The first half of the demo: a capture, its points by every method, their errors, and pictures.

Promise: the default method's picture comes first, when its folder is already in place; later files
are added one by one, each whole.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from splatseed.commands.demo.kernels import KernelsAhead, wait
from splatseed.commands.demo.methods import RATIO, SEED, SHOWN, upsample_by
from splatseed.console import StageClock, print_note, print_pairs, print_table, stage_display
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.staging import add_files, atomic_file, output_folder
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.seeding.diagnostics import GeometryScore, measure, spacing
from splatseed.synthetic import Capture, make_capture, write_capture
from splatseed.upsample import methods_for
from splatseed.view.clouds import preview_errors, preview_methods, preview_pair
from splatseed.views.visibility import choose_camera

if TYPE_CHECKING:  # which imports this module
    from splatseed.commands.demo import Options

SAMPLES = 20_000
"""Samples of the surfaces at which coverage is measured."""
FIRST_PICTURE = "preview.png"
METHOD_PICTURES = ("preview_methods.png", "preview_errors.png")
TABLE = "geometry.csv"


def make_points(options: Options, ahead: KernelsAhead) -> None:
    """Make the demo's folder, and report what is in it.

    Raises:
        SplatseedError: As ``output_folder``, ``make_capture`` and ``upsample``.
    """
    clock = StageClock()
    capture, seeded = _make_first(options, clock, ahead)
    _make_rest(options, capture, seeded, clock, ahead)


def _make_first(
    options: Options, clock: StageClock, ahead: KernelsAhead
) -> tuple[Capture, PointCloud]:
    """The capture, and its points upsampled by the default method, as scenes and a picture."""
    with (
        stage_display(clock),
        output_folder(options.output, kind="demo", overwrite=options.overwrite) as folder,
    ):
        clock("photograph", 0.0)
        capture = make_capture(SEED, options.views)
        write_capture(capture, folder / "scene")
        scene = _load(folder)
        wait(ahead, SHOWN, clock)
        clock("upsample", 0.0)
        seeded = upsample_by(SHOWN, scene, RATIO, SEED)
        clock("write", 0.0)
        # Images are copied: a link would point into the folder's temporary place.
        write_scene(
            scene.replace(points=seeded),
            folder / f"scene_{SHOWN}",
            copy_images=True,
            provenance={"method": SHOWN, "seconds": clock.seconds()["upsample"]},
        )
        clock("pictures", 0.0)
        preview_pair(scene, seeded, folder / FIRST_PICTURE, title=SHOWN)
    seconds = sum(clock.seconds().values())
    print_note(
        f"the first picture is ready after {seconds:.0f} s: {options.output / FIRST_PICTURE}"
    )
    return capture, seeded


def _load(folder: Path) -> Scene:
    scene = load_scene(folder / "scene")
    return scene.replace(depths=find_depths(scene, folder / "scene"))


def _make_rest(
    options: Options, capture: Capture, seeded: PointCloud, clock: StageClock, ahead: KernelsAhead
) -> None:
    """Every other method, the table and all pictures."""
    folder = options.output
    scene = _load(folder)
    add_files(folder, [TABLE, *METHOD_PICTURES])
    with stage_display(clock):
        clouds = _upsample_all(scene, {SHOWN: seeded}, clock, ahead)
        scores = _measure_all(capture, scene, clouds, clock)
        _write_table(folder / TABLE, scores)
        _write_pictures(folder, capture, scene, clouds, clock)
        seconds = clock.seconds()
    _summarise(options, scene, scores, seconds)


def _upsample_all(
    scene: Scene,
    done: Mapping[str, PointCloud],
    clock: StageClock,
    ahead: KernelsAhead,
) -> dict[str, PointCloud]:
    """The scene upsampled by every method, in the table's order."""
    methods = methods_for(scene)
    clouds = dict(done)
    for name in ahead.last_first(methods):
        if name not in clouds:
            clock("upsample", len(clouds) / len(methods))
            wait(ahead, name, clock)
            clouds[name] = upsample_by(name, scene, RATIO, SEED)
    clock("upsample", 1.0)
    return {name: clouds[name] for name in methods}


def _measure_all(
    capture: Capture, scene: Scene, clouds: Mapping[str, PointCloud], clock: StageClock
) -> dict[str, GeometryScore]:
    """Scores of the originals alone and of every method's new points."""
    clock("measure", 0.0)
    originals = scene.points.xyz
    h = spacing(originals)
    samples = capture.sample_visible(SAMPLES, np.random.default_rng(0))
    scores = {"originals": measure(originals, originals, capture.surfaces, samples, h)}
    for done, (name, cloud) in enumerate(clouds.items()):
        new = cloud.xyz[len(originals) :]
        scores[name] = measure(new, cloud.xyz, capture.surfaces, samples, h)
        clock("measure", (done + 1) / len(clouds))
    return scores


def _write_table(path: Path, scores: Mapping[str, GeometryScore]) -> None:
    """Scores as CSV, in units of the originals' spacing."""
    with atomic_file(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "error_h", "median_h", "p95_h", "coverage_h", "share_far"])
        for name, s in scores.items():
            values = (s.error, s.median, s.p95, s.coverage, s.share_far)
            writer.writerow([name, *(f"{x:.4f}" for x in values)])


def _write_pictures(
    folder: Path,
    capture: Capture,
    scene: Scene,
    clouds: Mapping[str, PointCloud],
    clock: StageClock,
) -> None:
    """Pictures of every method, and of every method's errors."""
    clock("pictures", 0.0)
    methods, faults = (folder / name for name in METHOD_PICTURES)
    preview_methods(scene, clouds, methods)
    clock("pictures", 0.6)
    h = spacing(scene.points.xyz)
    new = {name: c.select(slice(len(scene.points), None)) for name, c in clouds.items()}
    errors = {name: capture.surfaces.distance(c.xyz) / h for name, c in new.items()}
    preview_errors(new, errors, choose_camera(scene), faults)
    clock("pictures", 1.0)


def _summarise(
    options: Options,
    scene: Scene,
    scores: Mapping[str, GeometryScore],
    seconds: Mapping[str, float],
) -> None:
    print_table(
        f"{len(scene.points):,} points, {RATIO:g}x where the method has a ratio; distances "
        "in units of the originals' spacing, lower is better",
        ("method", "error", "median", "95%", "coverage", "far"),
        [
            (
                name,
                *(f"{x:.3f}" for x in (s.error, s.median, s.p95, s.coverage)),
                f"{s.share_far:.2%}",
            )
            for name, s in scores.items()
        ],
    )
    names = [FIRST_PICTURE, *METHOD_PICTURES]
    rows = [
        (
            "error",
            "mean distance of new points to the true surfaces; its median and 95th percentile",
        ),
        ("coverage", "mean distance of the surfaces that cameras see to the nearest point"),
        ("far", "share of new points over 3 spacings from any original"),
        ("seconds", ", ".join(f"{stage} {time:.1f}" for stage, time in seconds.items())),
        ("scene", f"{options.output / 'scene'} (COLMAP, with images and depths)"),
        *(("pictures" if not i else "", str(options.output / n)) for i, n in enumerate(names)),
    ]
    print_pairs("splatseed demo", rows)
