"""README's first picture and table: poses without points, on the test views of several captures.

Each capture's points are taken away. The *random start* is what gsplat begins with then, under
3DGS's densification: for ``max_steps``, and again for as many steps as fit into the seconds that
*ours* takes, seeding included. Ours is seeded by ``auto`` from the training photographs alone, and
trained with ``default`` and with ``grow``; once more with ``--refine-poses``, whose triangulated
points guide it. SfM's own points, under ``default``, show what could be had. Captures without, such
as a phone's, are trained at refined poses from a random start and from the triangulated points
alone, too. Rivals that cost nothing are a random start under ``mcmc``, the points that ``splatseed
sfm --poses-from`` triangulates at the poses as given, and other trainers' random starts. All have
the same number of Gaussians at most, ``rho`` per pixel. Seconds are the processor's, on one thread,
and of triangulation by the clock.

Promise: nothing is chosen by hand. The *gain* of a view or a capture is the PSNR of ours with
``grow`` minus that of the random start at equal seconds; the picture shows the capture, and of it
the view, of median gain, and the window, a third of it wide, in which the two differ most in
squared error.

    python -m benchmarks.training.front_page -o PICTURE.png
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple, cast

import numpy as np
import tyro
from benchmarks.common.children import call
from benchmarks.common.clouds import find_scenes
from benchmarks.common.ledger import report
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.training.peer_starts import PEERS, peer_start
from benchmarks.training.seeding_arms import at_given_poses, at_refined_poses
from jaxtyping import UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import splatseed as ss
from splatseed.checkup.poses import random_start
from splatseed.errors import SplatseedError
from splatseed.photos.loading import user_cache_dir
from splatseed.photos.view import View
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.splat.evaluate import EvalResult, evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.run import TrainingRun
from splatseed.training.settings import Seeding, StrategyName

__all__ = ["train_all"]

Window = tuple[slice, slice]

CAPTURES = ("fern", "fox", "treehill", "bonsai", "stone_horse", "face", "dorm", "desk")
WIDE = 9.0
"""Inches; a hundred pixels each."""
PART = 3
"""The window's sides, as a part of the photograph's."""
TITLES = ("photograph", "random start", "splatseed")
ARMS = {
    "random": "random start",
    "random, equal": "random start, as many seconds",
    "auto": "auto",
    "grow": "auto + grow",
    "refined": "--refine-poses, auto + grow",
    "random, refined": "--refine-poses, random start",
    "triangulated": "--refine-poses, its points + grow",
    "random, mcmc": "random start + mcmc",
    "given, default": "triangulated at the poses",
    "given, grow": "triangulated at the poses + grow",
    "nerfstudio": "nerfstudio's random start",
    "brush": "Brush's random start",
    "lichtfeld": "LichtFeld's random start",
    "sfm": "SfM's points",
}
OURS: dict[str, StrategyName] = {"grow": "grow", "auto": "default"}


@dataclass(frozen=True)
class Options:
    """Train captures without their points, print the table, and draw the median one."""

    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """The PNG to write."""
    scenes: tuple[str, ...] = CAPTURES
    """Captures, by their names in the folder of captures."""
    rho: float = 0.25
    """Gaussians per pixel of a photograph at the size that is trained."""
    max_steps: int = 1500
    """Steps of all but the random start at equal seconds."""
    long_side: int = 400
    """Photographs are made smaller by a whole factor, until no side is longer."""
    jobs: int = os.cpu_count() or 1
    """Captures at a time, on one thread each."""
    cache: Path = user_cache_dir().parent / "benchmarks" / "front_page"
    """Where results are kept; a capture that is there is not trained again."""


class Trained(NamedTuple):
    """A finished run, its scores, and its seconds."""

    run: TrainingRun
    scores: EvalResult
    seconds: float

    def told(self) -> dict[str, float]:
        """What the table needs."""
        return {
            "psnr": self.scores.psnr,
            "ssim": self.scores.ssim,
            "gaussians": self.run.count(),
            "steps": self.run.settings.max_steps,
            "seconds": self.seconds,
        }


def main(options: Options) -> None:
    """Train what is not there yet, draw, and print."""
    options.cache.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(options.jobs) as pool:
        results = list(pool.map(lambda name: _result(name, options), options.scenes))
    gains = [_gain(each) for each in results]
    at = int(np.argsort(gains)[len(gains) // 2])
    with np.load(_kept(options.scenes[at], options).with_suffix(".npz")) as kept:
        pictures = [kept[name] for name in ("photograph", "random, equal", "grow")]
        words = [str(each) for each in kept["words"]]
        view = str(kept["view"])
    _draw(pictures, words, options.output)
    print(f"{describe()}\n\nrho {options.rho:g}, {options.max_steps:,} steps; PSNR / SSIM\n")
    rows = [
        [name, *(_cell(each.get(arm)) for arm in ARMS), f"{gain:+.2f}"]
        for name, each, gain in zip(options.scenes, results, gains, strict=True)
    ]
    means = [
        " / ".join(
            f"{statistics.mean(each[arm][score] for each in results):.{digits}f}"
            for score, digits in (("psnr", 2), ("ssim", 3))
        )
        if all(arm in each for each in results)
        else ""
        for arm in ARMS
    ]
    rows.append(["mean", *means, f"{statistics.mean(gains):+.2f}"])
    print(table(["capture", *ARMS.values(), "gain, dB"], rows))
    print(f"\nThe picture: {options.scenes[at]}, {view}.")


def _kept(name: str, options: Options) -> Path:
    part = f"{name}_{options.rho:g}_{options.max_steps}_{options.long_side}"
    return options.cache / f"{part}.json"


def _result(name: str, options: Options) -> dict[str, Any]:
    path = _kept(name, options)
    if not path.is_file():
        report(f"{name} ...")
        told = call(
            "benchmarks.training.front_page:train_all", threads=1,
            scene=str(find_scenes() / name), pictures=str(path.with_suffix(".npz")),
            rho=options.rho, max_steps=options.max_steps, long_side=options.long_side,
        )  # fmt: skip
        path.write_text(json.dumps(told))
        report(f"  {name}: {_gain(told):+.2f} dB")
    return cast("dict[str, Any]", json.loads(path.read_text()))


def _gain(result: dict[str, Any]) -> float:
    return float(result["grow"]["psnr"] - result["random, equal"]["psnr"])


def _cell(told: dict[str, float] | None) -> str:
    if told is None:
        return ""
    return (
        f"{told['psnr']:.2f} / {told['ssim']:.3f} ({told['steps']:,}, {told['seconds']:.0f} s, "
        f"{told['gaussians'] / 1000:.1f}k)"
    )


def train_all(
    scene: str, pictures: str, rho: float, max_steps: int, long_side: int
) -> dict[str, dict[str, float]]:
    """All runs of one capture; the renders of its median view go into ``pictures``, an .npz."""
    whole = ss.load_scene(Path(scene), require_points=False)
    bare = whole.replace(points=PointCloud.empty(), tracks=None)
    dice = bare.replace(points=random_start(bare, np.random.default_rng(0)))
    camera = whole.images[0].camera
    data_factor = max(1, -(-max(camera.width, camera.height) // long_side))
    cap = round(rho * (camera.width // data_factor) * (camera.height // data_factor))

    def train(
        start: Scene, strategy: StrategyName, steps: int = max_steps, seeding: Seeding = "scene"
    ) -> Trained:
        settings = TrainSettings(
            strategy=strategy, max_steps=steps, backend="cpu", data_factor=data_factor,
            cap_max=cap, seeding=seeding,
        )  # fmt: skip
        return _train(start, settings)

    for strategy in OURS.values():
        train(bare, strategy, 4, "auto")  # loads kernels: it takes seconds
    runs = {name: train(bare, of, seeding="auto") for name, of in OURS.items()}
    begun = time.perf_counter()  # it works in a process of its own
    posed = at_refined_poses(bare, 0)
    refining = time.perf_counter() - begun
    at_refined = {"refined": train(posed, "grow", seeding="auto")}
    begun = time.perf_counter()
    start = at_given_poses(bare, 0)
    triangulating = time.perf_counter() - begun
    for strategy in OURS.values():
        trained = train(start, strategy)
        name = f"given, {strategy}"
        runs[name] = trained._replace(seconds=trained.seconds + triangulating)
    for name in PEERS[1:]:
        start = bare.replace(points=peer_start(bare, np.random.default_rng(0), name))
        runs[name] = train(start, "default")
    runs["random, mcmc"] = train(dice, "mcmc")
    if not len(whole.points):  # a device's poses
        start = posed.replace(points=random_start(posed, np.random.default_rng(0)))
        at_refined["random, refined"] = train(start, "default")
        at_refined["triangulated"] = train(posed, "grow")
    runs |= {name: run._replace(seconds=run.seconds + refining) for name, run in at_refined.items()}
    # A run's cost per step grows with its Gaussians, so the trial is as long as the other.
    runs["random"] = train(dice, "default")
    steps = round(max_steps * runs["grow"].seconds / runs["random"].seconds)
    runs["random, equal"] = train(dice, "default", max(steps, max_steps))
    if len(whole.points):
        runs["sfm"] = train(whole, "default")
    _keep_median(runs["random, equal"], runs["grow"], Path(pictures))
    return {name: each.told() for name, each in runs.items()}


def _train(scene: Scene, settings: TrainSettings) -> Trained:
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        run = prepare_run(scene, Path(folder) / "run", settings)
        run.train()
        seconds = time.process_time() - start
    scores = evaluate_views(run.trainer.render, run.trainer.test_views)
    return Trained(run, scores, seconds)


def _keep_median(base: Trained, ours: Trained, path: Path) -> None:
    """Keep the photograph and the two renders of the view of median gain."""
    before, after = ([view.psnr for view in each.scores.per_image] for each in (base, ours))
    gains = np.subtract(after, before)
    at = int(np.argsort(gains)[len(gains) // 2])
    view = ours.run.trainer.test_views[at]
    np.savez_compressed(
        path,
        photograph=view.photograph,
        **{"random, equal": _rendered(base, view), "grow": _rendered(ours, view)},
        words=[_words(base, at), _words(ours, at)],
        view=view.name,
    )


def _rendered(trained: Trained, view: View) -> UInt8[np.ndarray, "H W 3"]:
    render = trained.run.trainer.render(view).detach().numpy()
    return np.round(np.clip(render, 0, 1) * 255).astype(np.uint8)


def _words(trained: Trained, at: int) -> str:
    view = trained.scores.per_image[at]
    return f"{view.psnr:.1f} dB, SSIM {view.ssim:.2f}"


def _window(pictures: Sequence[UInt8[np.ndarray, "H W 3"]]) -> Window:
    """Where the two renders differ most in squared error."""
    truth, base, ours = (np.asarray(each, np.float64) for each in pictures)
    differs = np.abs(((base - truth) ** 2).sum(axis=2) - ((ours - truth) ** 2).sum(axis=2))
    height, width = (side // PART for side in differs.shape)
    sums = np.pad(differs.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
    inside = (
        sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width]
        + sums[:-height, :-width]
    )  # fmt: skip
    top, left = np.unravel_index(np.argmax(inside), inside.shape)
    return slice(int(top), int(top) + height), slice(int(left), int(left) + width)


def _draw(pictures: Sequence[UInt8[np.ndarray, "H W 3"]], words: Sequence[str], path: Path) -> None:
    window = _window(pictures)
    height, width = pictures[0].shape[:2]
    figure = Figure(figsize=(WIDE, 2 * WIDE / 3 * height / width + 0.55), dpi=100)
    axes = figure.subplots(2, 3, gridspec_kw={"wspace": 0.02, "hspace": 0.02})
    figure.subplots_adjust(
        left=0.002, right=0.998, bottom=0.002, top=1 - 0.5 / figure.get_figheight()
    )
    for column, (picture, title) in enumerate(zip(pictures, TITLES, strict=True)):
        below = f"\n{words[column - 1]}" if column else "\n"
        axes[0, column].set_title(title + below, fontsize=12, pad=4)
        axes[0, column].imshow(picture)
        axes[0, column].add_patch(_frame(window))
        axes[1, column].imshow(picture[window], interpolation="nearest")
    for each in axes.flat:
        each.set_axis_off()
    figure.savefig(path)


def _frame(window: Window) -> Rectangle:
    rows, columns = window
    return Rectangle(
        (columns.start, rows.start), columns.stop - columns.start, rows.stop - rows.start,
        fill=False, edgecolor="white", linewidth=1.5,
    )  # fmt: skip


if __name__ == "__main__":
    try:
        main(tyro.cli(Options, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
