"""``splatseed demo``: the main job from end to end, on a capture whose truth is known.

It photographs a made-up room, finds points as Structure-from-Motion would, writes them as a COLMAP
scene, reads that back, upsamples it and shows the result. Then it does so by every method, and measures
how far the new points lie from the true surfaces and how well they cover them. Then, where PyTorch and
gsplat are installed, it trains for a short while from the points as found and from the upsampled ones,
and compares. What has to be compiled is compiled by a second process ahead of the first.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from splatseed.commands._demo_kernels import TRAINING, KernelsAhead, kernels_ahead
from splatseed.commands._demo_methods import SHOWN, upsample_by
from splatseed.commands._options import parse_options
from splatseed.console import (
    StageClock,
    print_commands,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.errors import MissingDependencyError, OutputError, ParameterError
from splatseed.geometry import GeometryScore, measure, spacing
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.staging import add_files, atomic_file, kind_of, output_folder
from splatseed.literal import quoted
from splatseed.pointcloud import PointCloud
from splatseed.preview import choose_camera, preview_errors, preview_methods, preview_pair
from splatseed.requirements import require
from splatseed.scene import Scene
from splatseed.synthetic import Capture, make_capture, write_capture
from splatseed.upsample import methods_for, planned_size

if TYPE_CHECKING:  # importing PyTorch takes a while, and it may be absent
    from splatseed.commands._demo_training import TrainedArm

__all__ = ["run"]

SAMPLES = 20_000
"""Places on the surfaces at which coverage is taken."""
FIRST_PICTURE = "preview.png"
METHOD_PICTURES = ("preview_methods.png", "preview_errors.png")
TRAINED_PICTURE = "preview_trained.png"
TABLE = "geometry.csv"


@dataclass(frozen=True)
class Options:
    """Make a small scene, upsample it by every method, train from it, and show the result."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """The folder to write."""
    ratio: float = 8.0
    """Points in all, as a multiple of the originals, for methods that interpolate."""
    views: int = 40
    """Photographs of the made-up room."""
    seed: int = 0
    """The same seed gives the same demo."""
    train_steps: int = 500
    """Training steps from each of two sets of seeds; 0 for no training."""
    training: Literal["now", "later", "only"] = "now"
    """When to train: now, at the end; later, when PyTorch is being installed meanwhile; only, in a demo
    folder that was made with later."""
    preview: bool = True
    """Write pictures."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Do what the command line asks for."""
    options = parse_options(Options, "demo", arguments)
    _check(options)
    with kernels_ahead(training=options.training != "only" and options.train_steps > 0) as ahead:
        if options.training != "only":
            clock = StageClock()
            capture, seeded = _make_first(options, clock, ahead)
            _make_rest(options, capture, seeded, clock, ahead)
        if options.training == "later":
            ahead.wait_for(TRAINING)
            return
        trained = _train(options, ahead) if options.train_steps else False
    _say_what_next(options, trained=trained)


def _check(options: Options) -> None:
    """Refuse what would fail after a minute's work."""
    planned_size(1, options.ratio, None)
    if options.train_steps < 0:
        raise ParameterError(
            "--train-steps of 0 or more", found=f"{options.train_steps}", fix="Pass 0 not to train."
        )
    if options.training == "only" and kind_of(options.output) != "demo":
        raise OutputError(
            f"a demo at {options.output}", found="none", fix="Make it first: splatseed demo."
        )


def _make_first(
    options: Options, clock: StageClock, ahead: KernelsAhead
) -> tuple[Capture, PointCloud]:
    """The capture, its points as the default method adds to them, both as scenes, and a picture."""
    with (
        stage_display(clock),
        output_folder(options.output, kind="demo", overwrite=options.overwrite) as folder,
    ):
        clock("photograph", 0.0)
        capture = make_capture(options.seed, options.views)
        write_capture(capture, folder / "scene")
        scene = _load(folder)
        _wait(ahead, SHOWN, clock)
        clock("upsample", 0.0)
        seeded = upsample_by(SHOWN, scene, options.ratio, options.seed)
        clock("write", 0.0)
        # Images are copied: a link would point into the folder's temporary place.
        write_scene(scene.replace(points=seeded), folder / f"scene_{SHOWN}", copy_images=True)
        if options.preview:
            clock("pictures", 0.0)
            preview_pair(scene, seeded, folder / FIRST_PICTURE, title=SHOWN)
    if options.preview:
        seconds = sum(clock.seconds().values())
        print_note(
            f"the first picture is there after {seconds:.0f} s: {options.output / FIRST_PICTURE}"
        )
    return capture, seeded


def _load(folder: Path) -> Scene:
    scene = load_scene(folder / "scene")
    return scene.replace(depths=find_depths(scene, folder / "scene"))


def _wait(ahead: KernelsAhead, part: str, clock: StageClock) -> None:
    """Wait for what the other process compiles just now, and count that as compilation."""
    clock.begin_compilation()
    ahead.wait_for(part)
    clock.end_compilation()


def _make_rest(
    options: Options, capture: Capture, seeded: PointCloud, clock: StageClock, ahead: KernelsAhead
) -> None:
    """Every other method, the table and the pictures of all."""
    folder = options.output
    scene = _load(folder)
    add_files(folder, [TABLE, *METHOD_PICTURES])
    with stage_display(clock):
        clouds = _upsample_all(options, scene, {SHOWN: seeded}, clock, ahead)
        scores = _measure_all(capture, scene, clouds, clock)
        _write_table(folder / TABLE, scores)
        if options.preview:
            _write_pictures(folder, capture, scene, clouds, clock)
        seconds = clock.seconds()
    _summarise(options, scene, scores, seconds)


def _upsample_all(
    options: Options,
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
            _wait(ahead, name, clock)
            clouds[name] = upsample_by(name, scene, options.ratio, options.seed)
    clock("upsample", 1.0)
    return {name: clouds[name] for name in methods}


def _measure_all(
    capture: Capture, scene: Scene, clouds: Mapping[str, PointCloud], clock: StageClock
) -> dict[str, GeometryScore]:
    """Scores of the originals by themselves and of every method's new points."""
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
    """Every method, and every method's errors."""
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
        f"{len(scene.points):,} points, {options.ratio:g}x where the method has a ratio; distances in "
        "units of the originals' spacing, less is better",
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
    names = [FIRST_PICTURE, *METHOD_PICTURES] if options.preview else []
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


def _train(options: Options, ahead: KernelsAhead) -> bool:
    """Train from both sets of seeds and compare, if what it takes is installed."""
    try:
        require("torch", "gsplat")
    except MissingDependencyError as error:
        print_note(f"not trained: {error.found} installed. {error.fix}")
        return False
    # These import PyTorch.
    from splatseed.commands._demo_training import Arm, train_arm, write_comparison  # noqa: PLC0415
    from splatseed.train.settings import TrainSettings  # noqa: PLC0415

    folder = options.output
    runs = [f"run_{name}" for name in ("sfm", SHOWN)]
    add_files(folder, [*runs, TRAINED_PICTURE])
    arms = [
        Arm("SfM seeds", folder / "scene", folder / runs[0]),
        Arm(SHOWN, folder / f"scene_{SHOWN}", folder / runs[1]),
    ]
    settings = TrainSettings(strategy="none", max_steps=options.train_steps, seed=options.seed)
    with stage_display() as clock:
        _wait(ahead, TRAINING, clock)
        trained = [train_arm(arm, settings, clock) for arm in arms]
        if options.preview:
            write_comparison(trained, folder / TRAINED_PICTURE)
    _summarise_training(options, trained)
    return True


def _summarise_training(options: Options, trained: Sequence[TrainedArm]) -> None:
    """Both runs side by side, and what they do and do not show."""
    base = trained[0].metrics
    goal = base["tests"][-1]["psnr"]
    rows = [_row(each, goal) for each in trained]
    print_table(
        f"{options.train_steps:,} training steps, {len(base['per_image'])} test views",
        ("seeds", "Gaussians", "seconds", "PSNR, dB", "SSIM", f"{goal:.2f} dB after"),
        rows,
    )
    pictures = [("pictures", str(options.output / TRAINED_PICTURE))] if options.preview else []
    print_pairs(
        "what this shows",
        [
            ("fixed", "no Gaussian is added or removed, so this is the worth of the seeds alone"),
            ("cost", "a step takes longer with more Gaussians: compare the seconds as well"),
            (
                "limits",
                "a made-up room, one run each, no error bars; a long run with densification",
            ),
            ("", "adds Gaussians of its own, and the difference can be smaller or gone"),
            *pictures,
        ],
    )


def _row(each: TrainedArm, goal: float) -> tuple[str, ...]:
    from splatseed.commands._demo_training import when_reached  # noqa: PLC0415  (as above)

    metrics, reached = each.metrics, when_reached(goal, each.metrics)
    return (
        each.arm.label,
        f"{metrics['num_gaussians']:,}",
        f"{metrics['train_seconds']:.1f}",
        f"{metrics['psnr']:.2f}",
        f"{metrics['ssim']:.4f}",
        "not reached" if reached is None else f"{reached[0]:,} steps, {reached[1]:.1f} s",
    )


def _say_what_next(options: Options, *, trained: bool) -> None:
    scene, seeded = (options.output / name for name in ("scene", f"scene_{SHOWN}"))
    run = options.output / f"run_{SHOWN}"
    commands = [
        (
            "another method",
            f"splatseed upsample {quoted(scene)} --method spline --ratio 16 -o OUT",
        ),
        ("a longer run", f"splatseed train {quoted(seeded)} --max-steps 3000 -o RUN"),
    ]
    if trained:
        commands.append(("the scores again", f"splatseed evaluate {quoted(run)}"))
    print_commands("next", commands)
