"""The picture on the README's first screen: a test photograph, 3DGS's densification, and ``grow``.

Both are trained from Structure-from-Motion's points, to the same number of Gaussians, in the same
seconds: ``grow`` trains for ``max_steps``, then ``default`` for as many steps as it makes in the
seconds that ``grow`` took, stereo included. Notation: the *gain* of a view is its PSNR under
``grow`` minus that under ``default``. Promise: the view shown is the one whose gain is the median
over the test views; the window, a third of it wide, is where the two differ most in squared error.

    python -m benchmarks.training.front_page SCENE -o PICTURE.png
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple, cast

import numpy as np
import tyro
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

import splatseed as ss
from splatseed.console import stage_display
from splatseed.evaluate import EvalResult, evaluate_views
from splatseed.train import TrainSettings, prepare_run
from splatseed.train.run import TrainingRun
from splatseed.train.settings import StrategyName
from splatseed.views import View

Window = tuple[slice, slice]

WIDE = 9.0
"""Inches; a hundred pixels each."""
PART = 3
"""The window's sides, as a part of the photograph's."""
TITLES = ("photograph", "3DGS's densification", "splatseed's grow")


@dataclass(frozen=True)
class Options:
    """Train a scene twice at equal seconds, and draw the test view with the median gain."""

    scene: tyro.conf.Positional[Path]
    """A scene with photographs."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))]
    """The PNG to write."""
    rho: float = 0.25
    """Gaussians per pixel of a photograph at the size that is trained."""
    max_steps: int = 1500
    """Steps of grow."""
    data_factor: int = 2
    """By how much photographs are made smaller."""


class Trained(NamedTuple):
    """A finished run, its scores, and its seconds."""

    run: TrainingRun
    scores: EvalResult
    seconds: float


def main() -> None:
    """Train, draw, and print what the picture shows."""
    options = tyro.cli(Options)
    with tempfile.TemporaryDirectory() as folder:
        _train(options, "grow", 1, Path(folder) / "kernels")  # loads them, which takes seconds
        ours = _train(options, "grow", options.max_steps, Path(folder) / "grow")
        # A run's cost per step grows with its Gaussians, so the trial is as long as the other.
        trial = _train(options, "default", options.max_steps, Path(folder) / "trial")
        steps = round(options.max_steps * ours.seconds / trial.seconds)
        base = _train(options, "default", steps, Path(folder) / "default")
    gains = _gains(base, ours)
    at = int(np.argsort(gains)[len(gains) // 2])
    view = ours.run.trainer.test_views[at]
    pictures = [view.photograph, _rendered(base, view), _rendered(ours, view)]
    _draw(pictures, [_words(base, at), _words(ours, at)], options.output)
    print(f"view {view.name}: gain {gains[at]:.2f} dB; all views: {np.sort(gains).round(2)}")
    for each in (base, ours):
        print(_summary(each))


def _train(options: Options, strategy: str, steps: int, folder: Path) -> Trained:
    scene = ss.load_scene(options.scene)
    camera = scene.images[0].camera
    pixels = (camera.width // options.data_factor) * (camera.height // options.data_factor)
    settings = TrainSettings(
        strategy=cast("StrategyName", strategy), max_steps=steps, backend="cpu",
        data_factor=options.data_factor, cap_max=round(options.rho * pixels),
    )  # fmt: skip
    with stage_display() as clock:
        run = prepare_run(scene, folder, settings, progress=clock)
        run.train(lambda step: clock(f"train {strategy}", step / steps))
    if run.state.step < steps:
        raise SystemExit(130)  # interrupted: half a run is not compared
    scores = evaluate_views(run.trainer.render, run.trainer.test_views)
    return Trained(run, scores, run.state.watch.seconds)


def _gains(base: Trained, ours: Trained) -> Float[np.ndarray, " V"]:
    return np.array(
        [b.psnr - a.psnr for a, b in zip(base.scores.per_image, ours.scores.per_image, strict=True)]
    )


def _rendered(trained: Trained, view: View) -> UInt8[np.ndarray, "H W 3"]:
    render = trained.run.trainer.render(view).detach().numpy()
    return np.round(np.clip(render, 0, 1) * 255).astype(np.uint8)


def _words(trained: Trained, at: int) -> str:
    view = trained.scores.per_image[at]
    return f"{view.psnr:.1f} dB, SSIM {view.ssim:.2f}"


def _summary(trained: Trained) -> str:
    run, scores = trained.run, trained.scores
    count = len(run.state.params["means"])
    return (
        f"{run.settings.strategy}: {scores.psnr:.2f} dB, SSIM {scores.ssim:.4f} on all test views; "
        f"{count:,} Gaussians, {run.settings.max_steps:,} steps, {trained.seconds:.1f} s"
    )


def _window(pictures: list[UInt8[np.ndarray, "H W 3"]]) -> Window:
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


def _draw(pictures: list[UInt8[np.ndarray, "H W 3"]], words: list[str], path: Path) -> None:
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
    main()
