"""``splatseed demo``: the whole workflow on a synthetic capture with known surfaces.

It photographs a synthetic room, finds points as Structure-from-Motion would, writes them as a
COLMAP scene, reads that back, upsamples it and shows the result. Then it does so by every method,
and measures how far the new points lie from the true surfaces and how well they cover them. Then,
if PyTorch and gsplat are installed, it trains briefly and compares: from poses alone, where a
trainer starts at random, and from the points as they are and upsampled. A second process compiles
kernels ahead of the first, which waits for a kernel that is being compiled.

Promise: the default method's picture comes first, when its folder is already in place; later files
are added one by one, each whole. Runs differ only in their seeds, and have the same number of
Gaussians at most; the time to make seeds is counted; the view that is shown is chosen before any is
rendered.
"""

from __future__ import annotations

import csv
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import astuple, dataclass
from importlib import invalidate_caches
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from splatseed.commands.options import parse_options
from splatseed.console import (
    StageClock,
    print_note,
    print_pairs,
    print_table,
    stage_display,
)
from splatseed.errors import MissingDependencyError, OutputError, ParameterError
from splatseed.io import find_depths, load_scene, write_scene
from splatseed.io.staging import add_files, atomic_file, output_folder, read_manifest
from splatseed.literal import quoted
from splatseed.pointcloud import PointCloud
from splatseed.requirements import require
from splatseed.runtime.compilation import watched
from splatseed.runtime.tasks import Child
from splatseed.scene import Scene
from splatseed.upsample import METHODS, chooses_number, configure, methods_for, upsample

if TYPE_CHECKING:  # they load Numba, or PyTorch, which may be absent
    from splatseed.scores import TrainingResult
    from splatseed.seeding.diagnostics import GeometryScore
    from splatseed.synthetic import Capture
    from splatseed.train.settings import TrainSettings
    from splatseed.view.page import Tile

SHOWN = "auto"
SEED = 0
RATIO = 8.0
"""Points in all over originals, for methods that interpolate."""
TEST_EVERY = 8
"""Photographs held out for testing: no method uses them."""
SAMPLES = 20_000
"""Samples of the surfaces at which coverage is measured."""
PICTURES = ("preview.png", "preview_methods.png", "preview_errors.png")
TABLE, TRAINED_PICTURE = "geometry.csv", "preview_trained.png"
POSES_ALONE = {"random start": "random", f"{SHOWN}, poses alone": f"poses_{SHOWN}"}
"""Arms that know no points, and how their folders end."""
TRAINING = "training"
AHEAD = (SHOWN, TRAINING, "voronoi", "spline")
"""What the second process compiles, in this order; training as early as possible after the
first."""
SMALL = {"num_views": 8, "width": 96, "height": 72}
"""The capture on which it does."""
POLL = 0.5
"""Seconds between its checks whether PyTorch has been installed."""


@dataclass(frozen=True)
class Options:
    """Make a small scene, upsample it by every method, train from it, and show the result."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("demo")
    """The folder to write."""
    views: int = 40
    """Photographs of the synthetic room."""
    train_steps: int = 500
    """Training steps from each of four sets of seeds; 0 for no training."""
    training: Literal["now", "later", "only"] = "now"
    """When to train: now, at the end; later, while PyTorch is being installed; only, in a
    demo folder that was made with later."""
    overwrite: bool = False
    """Replace an output folder that splatseed wrote before."""


def run(arguments: list[str]) -> None:
    """Run the verb with these arguments."""
    options = parse_options(Options, "demo", arguments)
    if options.train_steps < 0:
        raise ParameterError(
            "--train-steps of 0 or more", found=f"{options.train_steps}", fix="Pass 0 not to train."
        )
    if options.training == "only" and read_manifest(options.output).get("command") != "demo":
        raise OutputError(
            f"a demo at {options.output}", found="none", fix="Make it first: splatseed demo."
        )
    parts = [each for each in AHEAD if options.train_steps or each != TRAINING]
    with compiled_ahead([TRAINING] if options.training == "only" else parts) as finish:
        if options.training != "only":
            _make_points(options)
        if options.training == "later":
            with stage_display() as clock:
                clock.begin_compilation()
                finish()
                clock.end_compilation()
            return
        trained = _train(options) if options.train_steps else False
    scene, seeded = (options.output / name for name in ("scene", f"scene_{SHOWN}"))
    another = f"splatseed upsample {quoted(scene)} --method spline --ratio 16 -o OUT"
    commands = [
        ("another method", another),
        ("a longer run", f"splatseed train {quoted(seeded)} --max-steps 3000 -o RUN"),
    ]
    if trained:
        run_folder = options.output / f"run_{SHOWN}"
        commands.append(("the scores again", f"splatseed evaluate {quoted(run_folder)}"))
    print_pairs("next", commands)


def _upsample_by(name: str, scene: Scene, ratio: float = RATIO) -> PointCloud:
    """The scene's points and new ones; methods that choose their number ignore the ratio."""
    looks = hasattr(METHODS[name], "hold_out")
    method = configure(name, hold_out=TEST_EVERY) if looks else configure(name)
    return upsample(scene, method, ratio=None if chooses_number(name) else ratio, seed=SEED)


# Kernels ------------------------------------------------------------------------------------------


@contextmanager
def compiled_ahead(parts: Sequence[str]) -> Iterator[Callable[[], None]]:
    """Have a process compile from the first compilation on; gives a function that waits for it.

    It does not wait for a process that still waits for PyTorch.
    """
    child: Child | None = None

    def start(begins: bool) -> None:
        nonlocal child
        if begins and child is None:
            child = Child(log=Path(os.devnull).open("wb"))  # noqa: SIM115  (the child's to close)
            child.start(compile_ahead, parts)

    def finish() -> None:
        with suppress(Exception):  # what it could not do, we shall do, and report
            if child is not None and (TRAINING not in parts or _has_pytorch()):
                child.wait()

    try:
        with watched(start):
            yield finish
    finally:
        if child is not None:
            child.close()


def compile_ahead(parts: Sequence[str]) -> None:
    """Compile what methods and training need by running a small demo; a second process does.

    Args:
        parts: Keys of ``METHODS``, or ``TRAINING``.
    """
    from splatseed.synthetic import make_capture, write_capture  # noqa: PLC0415  (loads Numba)

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
    from splatseed.view.clouds import preview_pair  # noqa: PLC0415  (loads Numba)

    if part == TRAINING:
        from splatseed.train.settings import TrainSettings  # noqa: PLC0415  (loads with its use)

        settings = TrainSettings(cap_max=2000, max_steps=4)
        _train_arm(_Arm("", folder / "scene", folder / "run"), settings, StageClock())
        return
    cloud = _upsample_by(part, scene, 2.0)
    if part == SHOWN:
        write_scene(scene.replace(points=cloud), folder / "shown")
        preview_pair(scene, cloud, folder / "preview.png", title=part)


def _has_pytorch() -> bool:
    """Whether training's packages are completely installed."""
    invalidate_caches()
    try:
        for package in ("torch", "gsplat", "torchmetrics"):
            version(package)  # from what pip writes last
    except PackageNotFoundError:
        return False
    return True


# Points -------------------------------------------------------------------------------------------


def _make_points(options: Options) -> None:
    """The capture, its points by every method, their errors, and pictures."""
    from splatseed.synthetic import make_capture, write_capture  # noqa: PLC0415  (loads Numba)
    from splatseed.view.clouds import (  # noqa: PLC0415  (likewise)
        preview_errors,
        preview_methods,
        preview_pair,
    )
    from splatseed.views.visibility import choose_camera  # noqa: PLC0415  (loads with its use)

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
            provenance={"method": SHOWN, "seconds": clock.seconds()["upsample"]},
        )
        clock("pictures", 0.0)
        preview_pair(scene, clouds[SHOWN], folder / PICTURES[0], title=SHOWN)
    seconds = sum(clock.seconds().values())
    print_note(f"the first picture is ready after {seconds:.0f} s: {out / PICTURES[0]}")

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
        scores, errors = _measured(capture, scene, clouds)
        with atomic_file(out / TABLE) as path, path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)  # in units of the originals' spacing
            writer.writerow(["method", "error_h", "median_h", "p95_h", "coverage_h", "share_far"])
            for name, score in scores.items():
                writer.writerow([name, *(f"{x:.4f}" for x in astuple(score))])
        clock("pictures", 0.0)
        preview_methods(scene, clouds, out / PICTURES[1])
        clock("pictures", 0.6)
        new = {name: c.select(slice(len(scene.points), None)) for name, c in clouds.items()}
        preview_errors(new, errors, choose_camera(scene), out / PICTURES[2])
        clock("pictures", 1.0)
    _summarise(options, scene, scores, clock.seconds())


def _load(folder: Path) -> Scene:
    scene = load_scene(folder / "scene")
    return scene.replace(depths=find_depths(scene, folder / "scene"))


def _measured(
    capture: Capture, scene: Scene, clouds: Mapping[str, PointCloud]
) -> tuple[dict[str, GeometryScore], dict[str, np.ndarray]]:
    """Scores of the originals alone and of each method's new points, and the latter's errors."""
    from splatseed.seeding.diagnostics import measure, spacing  # noqa: PLC0415  (SciPy)

    originals = scene.points.xyz
    h = spacing(originals)
    samples = capture.sample_visible(SAMPLES, np.random.default_rng(0))
    scores = {"originals": measure(originals, originals, capture.surfaces, samples, h)}
    errors = {}
    for name, cloud in clouds.items():
        new = cloud.xyz[len(originals) :]
        scores[name] = measure(new, cloud.xyz, capture.surfaces, samples, h)
        errors[name] = capture.surfaces.distance(new) / h
    return scores, errors


def _summarise(
    options: Options,
    scene: Scene,
    scores: Mapping[str, GeometryScore],
    seconds: Mapping[str, float],
) -> None:
    numbers = {name: [f"{x:.3f}" for x in astuple(s)[:4]] for name, s in scores.items()}
    print_table(
        f"{len(scene.points):,} points, {RATIO:g}x where the method has a ratio; distances "
        "in units of the originals' spacing, lower is better",
        ("method", "error", "median", "95%", "coverage", "far"),
        [(name, *numbers[name], f"{s.share_far:.2%}") for name, s in scores.items()],
    )
    error = "mean distance of new points to the true surfaces; its median and 95th percentile"
    coverage = "mean distance of the surfaces that cameras see to the nearest point"
    rows = [
        ("error", error),
        ("coverage", coverage),
        ("far", "share of new points over 3 spacings from any original"),
        ("seconds", ", ".join(f"{stage} {time:.1f}" for stage, time in seconds.items())),
        ("scene", f"{options.output / 'scene'} (COLMAP, with images and depths)"),
        *(("pictures" if not i else "", str(options.output / n)) for i, n in enumerate(PICTURES)),
    ]
    print_pairs("splatseed demo", rows)


# Training -----------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Arm:
    """A run: its seeds' name, the folders of its scene and of itself, and its seeds' seconds."""

    label: str
    scene: Path
    output: Path
    seconds: float = 0.0


@dataclass(frozen=True)
class _Trained:
    """A finished run, with its render of the view that is shown, and that view's error map."""

    arm: _Arm
    result: TrainingResult
    tiles: tuple[Tile, ...]
    """The photograph, the render, the errors."""

    @property
    def seconds(self) -> float:
        """Seconds of making the seeds and training from them."""
        return self.arm.seconds + self.result.train_seconds

    def psnr_after(self, seconds: float) -> float | None:
        """The last test PSNR, in dB, within ``seconds`` in all; None before the first.

        The curve's end is of the mean that a run ends with, which one in training has not yet.
        """
        during = self.result.curve[:-1]
        known = [test.psnr for test in during if self.arm.seconds + test.seconds <= seconds]
        return known[-1] if known else None


def _train(options: Options) -> bool:
    """Train from each set of seeds and compare, if the required packages are installed."""
    try:
        require("torch", "gsplat")
    except MissingDependencyError as error:
        print_note(f"not trained: {error.found} installed. {error.fix}")
        return False
    from splatseed.train.settings import TrainSettings  # noqa: PLC0415  (loads with its use)
    from splatseed.view.page import write_grid  # noqa: PLC0415  (likewise)

    folder = options.output
    runs = [f"run_{name}" for name in ("sfm", SHOWN)]
    alone = [f"{kind}_{name}" for name in POSES_ALONE.values() for kind in ("scene", "run")]
    add_files(folder, [*runs, *alone, TRAINED_PICTURE])
    seeded = read_manifest(folder / f"scene_{SHOWN}")
    arms = [
        _Arm("SfM seeds", folder / "scene", folder / runs[0]),
        _Arm(SHOWN, folder / f"scene_{SHOWN}", folder / runs[1], seeded["seconds"]),
    ]
    settings = TrainSettings(
        strategy="default", cap_max=seeded["num_points"], max_steps=options.train_steps, seed=SEED
    )
    with stage_display() as clock:
        arms = [*_seed_poses_alone(folder, clock), *arms]
        trained = [_train_arm(arm, settings, clock) for arm in arms]
        photographs, renders, errors = zip(*(each.tiles for each in trained), strict=True)
        blank = photographs[0]._replace(label="", picture=np.full_like(photographs[0].picture, 255))
        tiles = [photographs[0], *renders, blank, *errors]
        write_grid(tiles, folder / TRAINED_PICTURE, columns=1 + len(arms))
    _summarise_training(options, trained)
    return True


def _seed_poses_alone(folder: Path, clock: StageClock) -> list[_Arm]:
    """Scenes in the demo's folder whose seeds come from poses and photographs, not from points."""
    from splatseed.seeding.poses import random_start  # noqa: PLC0415  (loads with its use)

    scene = load_scene(folder / "scene").replace(points=PointCloud.empty(), tracks=None)
    arms: list[_Arm] = []
    for label, name in POSES_ALONE.items():
        before = sum(clock.seconds().values())
        clock("seed poses alone", len(arms) / len(POSES_ALONE))
        if name == "random":
            points = random_start(scene, np.random.default_rng(SEED))
        else:
            points = _upsample_by(SHOWN, scene)
        seconds = sum(clock.seconds().values()) - before
        path = folder / f"scene_{name}"
        write_scene(scene.replace(points=points), path, provenance={"method": label})
        arms.append(_Arm(label, path, folder / f"run_{name}", seconds))
    return arms


def _train_arm(arm: _Arm, settings: TrainSettings, clock: StageClock) -> _Trained:
    """Train from an arm's seeds, and score."""
    from splatseed.splat.evaluate import evaluate_views  # noqa: PLC0415  (imports PyTorch)
    from splatseed.splat.rendering import FULL_ERROR, as_bytes, error_map  # noqa: PLC0415  (likewise)
    from splatseed.train.run import RunOptions, prepare_run  # noqa: PLC0415  (likewise)
    from splatseed.view.page import Tile  # noqa: PLC0415  (likewise)

    stage = f"train {arm.label}"
    run = prepare_run(
        load_scene(arm.scene), arm.output, settings, RunOptions(overwrite=True), progress=clock
    )
    clock(stage, 0.0)
    if not run.train(lambda step: clock(stage, step / settings.max_steps)):
        raise KeyboardInterrupt
    result = run.finish(evaluate_views, clock)
    shown = run.trainer.test_views[len(run.trainer.test_views) // 2]
    render = np.asarray(run.trainer.render(shown).cpu().numpy(), np.float32)
    score = f"{arm.label}: {result.scores.psnr:.2f} dB over all test views"
    return _Trained(
        arm,
        result,
        (
            Tile("photograph, not trained on", shown.photograph),
            Tile(score, as_bytes(render)),
            Tile(
                f"error: black 0, bright {FULL_ERROR:g} or more",
                error_map(shown.photograph, render),
            ),
        ),
    )


def _summarise_training(options: Options, trained: Sequence[_Trained]) -> None:
    """The runs side by side, and what they do and do not show."""
    least = min(each.seconds for each in trained)
    rows = []
    for each in trained:
        scores, then = each.result.scores, each.psnr_after(least)
        rows.append(
            (
                each.arm.label,
                f"{scores.num_gaussians:,}",
                f"{each.seconds:.1f}",
                f"{scores.psnr:.2f}",
                f"{scores.ssim:.4f}",
                "not begun" if then is None else f"{then:.2f}",
            )
        )
    print_table(
        f"{options.train_steps:,} training steps, "
        f"{len(trained[0].result.scores.per_image)} test views",
        ("seeds", "Gaussians", "seconds", "PSNR, dB", "SSIM", f"dB after {least:.0f} s"),
        rows,
    )
    print_pairs(
        "what this shows",
        [
            ("poses alone", "the first two rows know no points: trainers then start at random"),
            ("fixed", "3DGS's densification, and the most Gaussians"),
            ("seconds", "of training and making the seeds; the last column is during training,"),
            ("", "before the mean that a run ends with is taken"),
            ("limits", "a synthetic room, one run each, no error bars; strategy grow, which"),
            ("", "splatseed train takes for short runs, gains more, and needs seeds less"),
            ("pictures", str(options.output / TRAINED_PICTURE)),
        ],
    )
