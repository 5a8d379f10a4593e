"""``splatseed demo``: the whole workflow on a synthetic capture with known surfaces.

It photographs a synthetic room, finds points as Structure-from-Motion would, upsamples them by
every method, and measures how far the new points lie from the true surfaces and how well they cover
them. Then, if PyTorch and gsplat are installed, it takes the points away and asks what seeds gain
where only poses are known: it trains briefly from the default method's seeds, for longer from a
random start, and, to compare, from the points. A second process compiles kernels ahead of the
first.

Promise: the default method's picture comes first, when its folder is already in place; later files
are added one by one, each whole. Runs differ only in their seeds and their steps, and have the same
number of Gaussians at most; the time to make seeds is counted; the view that is shown is chosen
before any is rendered; what is said of the runs is computed from them.
"""

from __future__ import annotations

import csv
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass, replace
from importlib import invalidate_caches
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from splatseed.commands.options import parse_options, refuse
from splatseed.console import (
    StageClock,
    add_results,
    print_next,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.errors import MissingDependencyError
from splatseed.findings import Finding
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.staging import add_files, atomic_file, output_folder, read_manifest
from splatseed.methods import METHODS, chooses_number, configure, methods_for
from splatseed.pointcloud import PointCloud
from splatseed.progress import watched
from splatseed.requirements import require, version_of
from splatseed.runtime.child import Child
from splatseed.scene import Scene
from splatseed.text import quoted

if TYPE_CHECKING:  # they load Numba, or PyTorch, which may be absent
    from splatseed.scores import TrainingResult
    from splatseed.seeding.geometry_score import GeometryScore
    from splatseed.training.settings import TrainSettings
    from splatseed.viewer.page import Tile

SHOWN = "auto"
SEED = 0
RATIO = 8.0
"""Total points per original point, for methods that interpolate."""
TEST_EVERY = 8
"""Every n-th photograph is a test view, which no method uses."""
SAMPLES = 20_000
"""Samples of the true surfaces at which coverage is measured."""
PICTURES = ("preview.png", "preview_methods.png", "preview_errors.png")
TABLE, TRAINED_PICTURE = "geometry.csv", "preview_trained.png"
RANDOM, POSES, SFM = "random", "poses", "sfm"
ARMS = {RANDOM: "random start", POSES: f"{SHOWN}, poses alone", SFM: "SfM's points"}
"""The trained arms, by the suffix of their folders; all but the last start without SfM's points."""
TRAINING = "training"
AHEAD = (SHOWN, TRAINING, "voronoi", "spline")
"""Parts that the second process compiles, in this order; training right after the first."""
SMALL = {"num_views": 8, "width": 96, "height": 72}
"""The capture on which the second process runs them."""
POLL = 0.5
"""Seconds between the second process's checks whether PyTorch is installed."""


@dataclass(frozen=True)
class Options:
    """Make a small scene, upsample it by every method, train from it, and show the result."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """The folder to write."""
    views: int = 40
    """Photographs of the synthetic room."""
    train_steps: int = 500
    """Training steps; 0 for no training. A random start gets more, for the time of seeding."""
    training: Literal["now", "later", "only"] = "now"
    """When to train: now, at the end; later, not yet (while PyTorch installs); only, in a
    demo folder made with later."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "demo", arguments)
    out, later, only = options.output, options.training == "later", options.training == "only"
    none = only and read_manifest(out).get("command") != "demo"
    refuse(
        (options.train_steps < 0, "--train-steps of 0 or more", options.train_steps,
         "Pass 0 not to train."),
        (none, f"a demo at {out}", "none", "Make it first: splatseed demo."),
    )  # fmt: skip
    parts = [each for each in AHEAD if options.train_steps or each != TRAINING]
    with compiled_ahead([TRAINING] if only else parts) as finish:
        if not only:
            _make_points(options)
        if later:
            with stage_display() as clock:
                clock.compilation(True)
                finish()
                clock.compilation(False)
            return
        trained = _train(options) if options.train_steps else False
    another = f"splatseed upsample {quoted(out / 'scene')} --method spline --ratio 16 -o OUT"
    longer = f"splatseed train {quoted(out / f'scene_{SHOWN}')} --max-steps 3000 -o RUN"
    commands = [("another method", another), ("a longer run", longer)]
    if trained:
        model = quoted(out / f"run_{POSES}")
        commands += [("the scores again", f"splatseed evaluate {model}")]
        commands += [("a page with the model", f"splatseed export {model} -o model.html")]
    elif options.train_steps:
        steps = f" --train-steps {options.train_steps}"
        same = steps if options.train_steps != Options.train_steps else ""
        rest = f"splatseed demo -o {quoted(out)} --training only{same}"
        commands.insert(0, ("training, once its packages are installed", rest))
    print_next(commands)


def _upsample_by(name: str, scene: Scene, ratio: float = RATIO) -> PointCloud:
    """Upsample the scene; methods that choose their number ignore the ratio."""
    from splatseed.seeding.upsampling import upsample

    looks = hasattr(METHODS[name], "test_every")
    method = configure(name, test_every=TEST_EVERY) if looks else configure(name)
    return upsample(scene, method, ratio=None if chooses_number(name) else ratio, seed=SEED)


# Kernels ------------------------------------------------------------------------------------------


@contextmanager
def compiled_ahead(parts: Sequence[str]) -> Iterator[Callable[[], None]]:
    """Start a process that compiles at the first compilation; yields a function to wait for it.

    It does not wait for a process that still waits for PyTorch.
    """
    child: Child | None = None

    def start(begins: bool) -> None:
        nonlocal child
        if begins and child is None:
            nowhere = Path(os.devnull).open("wb")  # noqa: SIM115  (the child closes it)
            child = Child(compile_ahead, parts, log=nowhere)

    def finish() -> None:
        with suppress(Exception):  # what it could not do, we shall do, and report
            if child is not None and (TRAINING not in parts or _has_pytorch()):
                child.result()

    try:
        with watched(start):
            yield finish
    finally:
        if child is not None:
            child.close()


def compile_ahead(parts: Sequence[str]) -> None:
    """Compile the kernels of methods and training by running a small demo, in a second process."""
    from splatseed.synthetic import make_capture, write_capture

    waiting = list(parts)
    with tempfile.TemporaryDirectory(prefix="splatseed-", ignore_cleanup_errors=True) as folder:
        write_capture(make_capture(SEED, **SMALL), Path(folder) / "scene")
        scene = _load(Path(folder))
        while waiting:
            part = next((each for each in waiting if each != TRAINING or _has_pytorch()), None)
            if part is None:  # a package may still be installing
                time.sleep(POLL)
                continue
            waiting.remove(part)
            with suppress(Exception):  # the demo itself will hit and report it
                _compile(part, scene, Path(folder))


def _compile(part: str, scene: Scene, folder: Path) -> None:
    from splatseed.viewer.clouds import preview_pair

    if part == TRAINING:
        from splatseed.training.settings import TrainSettings

        settings = TrainSettings(cap_max=2000, max_steps=4, backend="cpu")
        _train_arm(folder, SFM, settings, StageClock())
        return
    cloud = _upsample_by(part, scene, 2.0)
    if part == SHOWN:
        write_scene(scene.replace(points=cloud), folder / "shown")
        preview_pair(scene, cloud, folder / "preview.png", title=part)


def _has_pytorch() -> bool:
    invalidate_caches()
    # Versions come from what pip writes last.
    return all(map(version_of, ("torch", "gsplat", "torchmetrics", "flip-evaluator")))


# Points -------------------------------------------------------------------------------------------


def _make_points(options: Options) -> None:
    from splatseed.photos.viewpoint import choose_camera
    from splatseed.seeding.geometry_score import mean_spacing, measure
    from splatseed.synthetic import make_capture, write_capture
    from splatseed.viewer import clouds as pictures

    clock, out = StageClock(), options.output
    with (
        stage_display(clock),
        output_folder(out, kind="demo", overwrite=options.overwrite) as folder,
    ):
        clock("photograph", 0.0)
        capture = make_capture(SEED, options.views)
        write_capture(capture, folder / "scene")
        scene = _load(folder)
        clock("upsample", 0.0)
        clouds = {SHOWN: _upsample_by(SHOWN, scene)}
        clock("write", 0.0)
        # Images are copied: a link would point into the folder's temporary place.
        write_scene(
            scene.replace(points=clouds[SHOWN]),
            folder / f"scene_{SHOWN}",
            copy_images=True,
            provenance={"method": SHOWN},
        )
        clock("pictures", 0.0)
        pictures.preview_pair(scene, clouds[SHOWN], folder / PICTURES[0], title=SHOWN)
    seconds = sum(clock.seconds().values())
    text = f"the first picture is ready after {seconds:.0f} s: {out / PICTURES[0]}"
    print_note(Finding("first-picture", text, "info"))

    scene, methods = _load(out), methods_for(_load(out))
    add_files(out, [TABLE, *PICTURES[1:]])
    with stage_display(clock):
        # Last those that the second process compiles: it should be done with them.
        for name in sorted(methods, key=lambda name: name in AHEAD):
            if name not in clouds:
                clock("upsample", len(clouds) / len(methods))
                clouds[name] = _upsample_by(name, scene)
        clouds = {name: clouds[name] for name in methods}
        clock("measure", 0.0)
        xyz, surfaces = scene.points.xyz, capture.surfaces
        h, samples = mean_spacing(xyz), capture.sample_visible(SAMPLES, np.random.default_rng(0))
        new = {name: cloud.select(slice(len(xyz), None)) for name, cloud in clouds.items()}
        scores = {"originals": measure(xyz, xyz, surfaces, samples, h)}
        for name, cloud in clouds.items():
            scores[name] = measure(new[name].xyz, cloud.xyz, surfaces, samples, h)
        with atomic_file(out / TABLE) as path, path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)  # in units of the originals' spacing
            writer.writerow(["method", "error_h", "median_h", "p95_h", "coverage_h", "share_far"])
            writer.writerows([k, *(f"{x:.4f}" for x in astuple(s))] for k, s in scores.items())
        clock("pictures", 0.0)
        pictures.preview_methods(scene, clouds, out / PICTURES[1])
        clock("pictures", 0.6)
        errors = {name: surfaces.distance(cloud.xyz) / h for name, cloud in new.items()}
        pictures.preview_errors(new, errors, choose_camera(scene), out / PICTURES[2])
        clock("pictures", 1.0)
    _summarise(out, len(xyz), scores, clock.seconds())


def _load(folder: Path) -> Scene:
    scene = load_scene(folder / "scene")
    return scene.replace(depths=find_depths(scene, folder / "scene"))


def _summarise(
    out: Path, number: int, scores: Mapping[str, GeometryScore], seconds: Mapping[str, float]
) -> None:
    numbers = {name: [f"{x:.3f}" for x in astuple(s)[:4]] for name, s in scores.items()}
    print_table(
        f"{number:,} points, {RATIO:g}x where the method has a ratio; distances "
        "in units of the originals' spacing, lower is better",
        ("method", "error", "median", "95%", "coverage", "far"),
        [(name, *numbers[name], f"{s.share_far:.2%}") for name, s in scores.items()],
    )
    rows = [
        ("error", "mean distance of new points to the true surfaces; median, 95th percentile"),
        ("coverage", "mean distance of the surfaces that cameras see to the nearest point"),
        ("far", "share of new points over 3 spacings from any original"),
        ("seconds", ", ".join(f"{stage} {time:.1f}" for stage, time in seconds.items())),
        ("scene", f"{out / 'scene'} (COLMAP, with images and depths)"),
        *(("pictures" if not i else "", str(out / n)) for i, n in enumerate(PICTURES)),
    ]
    print_pairs("splatseed demo", rows)
    add_results(output=out, points=number, geometry=dict(scores))


# Training -----------------------------------------------------------------------------------------


def _train(options: Options) -> bool:
    """Train from each set of seeds and compare, if the required packages are installed."""
    try:
        require("torch", "gsplat", "flip_evaluator")
    except MissingDependencyError as error:
        text = f"not trained: {error.found} installed."
        print_note(Finding("missing-package", text, "info", fix=error.fix))
        return False
    from splatseed.training.settings import TrainSettings
    from splatseed.viewer.page import write_grid

    folder, steps = options.output, options.train_steps
    scenes = [f"scene_{name}" for name in (RANDOM, POSES)]
    add_files(folder, [*(f"run_{name}" for name in ARMS), *scenes, TRAINED_PICTURE])
    budget = read_manifest(folder / f"scene_{SHOWN}")["num_points"]
    # On the CPU also where there is a GPU, for which gsplat's kernels would be built first.
    settings = TrainSettings(
        strategy="default", cap_max=budget, max_steps=steps, seed=SEED, backend="cpu"
    )
    with stage_display() as clock:
        seconds = _seed_poses_alone(folder, clock)
        arms = {POSES: _train_arm(folder, POSES, settings, clock)}
        # A step from a random start is no faster, so that it gets as many seconds at least.
        share = 1.0 + seconds / arms[POSES][0].train_seconds
        longer = replace(settings, max_steps=round(steps * share))
        arms[RANDOM] = _train_arm(folder, RANDOM, longer, clock)
        arms[SFM] = _train_arm(folder, SFM, settings, clock)
        results, shown = zip(*(arms[name] for name in ARMS), strict=True)
        photographs, renders, errors = zip(*shown, strict=True)
        blank = photographs[0]._replace(label="", picture=np.full_like(photographs[0].picture, 255))
        tiles = [photographs[0], *renders, blank, *errors]
        write_grid(tiles, folder / TRAINED_PICTURE, columns=1 + len(arms))
    _summarise_training(folder / TRAINED_PICTURE, seconds, dict(zip(ARMS, results, strict=True)))
    return True


def _seed_poses_alone(folder: Path, clock: StageClock) -> float:
    """Write scenes whose seeds come from poses and photographs alone; return the seconds taken."""
    from splatseed.checkup.poses import random_start

    scene = load_scene(folder / "scene").replace(points=PointCloud.empty(), tracks=None)
    clock("seed poses alone", 0.0)
    begun = time.perf_counter()
    seeds = _upsample_by(SHOWN, scene)
    seconds = time.perf_counter() - begun
    dice = random_start(scene, np.random.default_rng(SEED))
    for name, points in ((POSES, seeds), (RANDOM, dice)):
        made = {"command": "upsample", "method": ARMS[name]}  # so that training checks no points
        write_scene(scene.replace(points=points), folder / f"scene_{name}", provenance=made)
    return seconds


def _train_arm(
    folder: Path, name: str, settings: TrainSettings, clock: StageClock
) -> tuple[TrainingResult, tuple[Tile, ...]]:
    """Train an arm and score it; also return a test view's photograph, render and error."""
    from splatseed.splat.evaluate import evaluate_views
    from splatseed.splat.metrics import flip_map
    from splatseed.splat.photographs import photograph_tensor
    from splatseed.splat.pictures import FLIP_LABEL, flip_heatmap, to_uint8
    from splatseed.training.prepare import prepare_run
    from splatseed.training.request import PrepareOptions
    from splatseed.viewer.page import Tile

    stage = f"train {ARMS[name]}"
    scene = load_scene(folder / ("scene" if name == SFM else f"scene_{name}"))
    run = prepare_run(
        scene, folder / f"run_{name}", settings, PrepareOptions(overwrite=True), progress=clock
    )
    clock(stage, 0.0)
    if not run.train(lambda step: clock(stage, step / settings.max_steps)):
        raise KeyboardInterrupt
    result = run.finish(evaluate_views, clock)
    shown = run.trainer.test_views[len(run.trainer.test_views) // 2]
    render = run.trainer.render(shown)
    score = f"{ARMS[name]}: {result.scores.psnr:.1f} dB over all test views"
    errors = flip_map(render, photograph_tensor(shown, run.trainer.device))
    return result, (
        Tile("photograph, not trained on", shown.photograph),
        Tile(score, to_uint8(render.cpu().numpy())),
        Tile(FLIP_LABEL, flip_heatmap(errors)),
    )


def _summarise_training(
    picture: Path, seeding: float, results: Mapping[str, TrainingResult]
) -> None:
    seconds = {name: each.train_seconds for name, each in results.items()}
    seconds[POSES] += seeding
    rows = [
        (ARMS[name], f"{each.steps:,}", f"{seconds[name]:.1f}", f"{each.scores.num_gaussians:,}",
         f"{each.scores.psnr:.2f}", f"{each.scores.ssim:.4f}")
        for name, each in results.items()
    ]  # fmt: skip
    print_table(
        "trained from poses without points, and from SfM's points",
        ("seeds", "steps", "seconds", "Gaussians", "PSNR, dB", "SSIM"),
        rows,
    )
    ours, base, points = (
        np.array([view.psnr for view in results[name].scores.per_image])
        for name in (POSES, RANDOM, SFM)
    )
    views, beyond = ours - base, (points - ours).mean()
    gained = "gain" if views.mean() > 0 else "gain nothing: they lose"
    gained = f"{gained} {abs(views.mean()):.2f} dB against a random start"
    more = "better" if beyond > 0 else "worse"
    facts = {
        "answer": f"{SHOWN}'s seeds, without points, {gained}",
        "seconds": f"{seconds[POSES]:.0f}, {seeding:.0f} of them to make the seeds; "
        f"the random start trains for {seconds[RANDOM]:.0f}",
        "test views": f"{sum(views > 0)} of {len(views)} gain: {min(views):+.2f} to "
        f"{max(views):+.2f} dB",
        "SfM's points": f"{abs(beyond):.2f} dB {more} than the seeds, after {seconds[SFM]:.0f} s; "
        "found in the test views, too",
        "limits": "a synthetic room, one run each, 3DGS's densification",
        "picture": str(picture),
    }
    print_pairs("what this shows", list(facts.items()))
    add_results(training={ARMS[name]: each.to_dict() for name, each in results.items()})
