"""Time and memory of one training step on the CPU, where they go, and what starting up costs.

Notation: a step shows one photograph: render, loss, backward, Adam and the bookkeeping of strategy
``default``, with spherical harmonics of degree 3. Promise: it is the trainer's own step that is
timed; the Gaussians are put back before each, so that all have the same work; every measurement has
a process of its own. Each table is Markdown. See README.md for what is and is not measured.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from benchmarks.common.children import call, seconds_of
from benchmarks.common.clocks import Clock
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.common.memory import status_bytes
from benchmarks.common.skipping import or_skip
from benchmarks.rendering.opensplat import seconds_per_step
from benchmarks.rendering.splats import Workload, make_workload, useful_pairs
from benchmarks.rendering.stopwatch import RENDER_STAGES, Place, Stopwatch, timed

from splatseed import load_scene
from splatseed.errors import SplatseedError
from splatseed.photos.loading import load_split
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.rendering import render_view
from splatseed.splat.training_frame import TrainingFrame, training_frame
from splatseed.training.initialization import min_view_depths
from splatseed.training.parameters import make_optimizers, make_parameters
from splatseed.training.seeds import usable_seeds
from splatseed.training.settings import TrainSettings
from splatseed.training.state import TrainState, make_strategy
from splatseed.training.trainer import Trainer, _Loss

__all__: list[str] = []

FIRST_STEP, LAST_STEP = 3001, 3099
"""Steps of a full run with all harmonics in use, and no densification among them."""
THREADS = (1, 2)
SIZES = {(50_000, 400, 300): 30.0, (200_000, 800, 600): 110.0}
"""Gaussians, width and height, and the target in ms on two cores."""
IMPORT_TARGET = 0.3
WARM_UP = 8
STARTS = 7
SMALL = (1_000, 64, 48)
PARTS = {
    "project": ("project", "project backward"),
    "harmonics": ("harmonics", "harmonics backward"),
    "bin": ("bin", ""),
    "blend, kernels": ("blend kernel", "blend kernel backward"),
    "blend, layout": ("blend layout", "blend layout backward"),
    "loss": ("loss", "loss backward"),
    "photograph": ("photograph", ""),
    "Adam": ("Adam", ""),
    "strategy": ("strategy", ""),
    "the rest: PyTorch": ("rest", ""),
}
"""Rows of the breakdown: a stage and its backward."""


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    sizes: tuple[tuple[int, int, int], ...] = tuple(SIZES)
    """Gaussians, width and height of the made room."""
    steps: int = 40
    """Steps timed; the median and the best are shown."""
    scene: Path | None = None
    """The seeds and photographs of this scene instead of the made room."""
    data_factor: int = 1
    """By how much the scene's photographs are made smaller."""
    start_up: bool = True
    """Also the time to import, and to the first step with and without compiled kernels on disk."""
    opensplat: Path | None = None
    """OpenSplat's program, to be timed on the same Gaussians and photographs (Linux)."""
    clock: Clock = "wall"
    """On a machine that is not idle, cpu: the busiest thread's time on a core, stage by stage."""


def measure(path: str, steps: int, clock: Clock) -> dict[str, Any]:
    """Seconds of each stage of each step, bytes at the peak, useful pairs a pixel."""
    trainer = _trainer(Workload.load(Path(path)))
    pairs = _pairs_per_pixel(trainer)
    before = {name: value.detach().clone() for name, value in trainer.state.params.items()}
    for i in range(WARM_UP):
        _step(trainer, i, before, Stopwatch())
    with timed(_stages(trainer), clock) as watch:
        laps = [_step(trainer, WARM_UP + i, before, watch) for i in range(steps)]
    return {"laps": laps, "peak": status_bytes("VmHWM"), "pairs": pairs}


@torch.no_grad()
def _put_back(params: Mapping[str, torch.Tensor], before: Mapping[str, torch.Tensor]) -> None:
    for name, value in params.items():
        value.copy_(before[name])


def _step(
    trainer: Trainer, i: int, before: Mapping[str, torch.Tensor], watch: Stopwatch
) -> dict[str, float]:
    """Take a step from where all steps begin; its seconds by stage, the rest and the whole."""
    _put_back(trainer.state.params, before)
    watch.lap()
    watch.wrap("rest", trainer._advance)(FIRST_STEP + i % (LAST_STEP - FIRST_STEP))  # noqa: SLF001  (there is no public way)
    lap = watch.lap()
    return {**lap, "whole": sum(lap.values())}


def _trainer(workload: Workload) -> Trainer:
    """A run in the middle of its first third, as ``splatseed train`` would have it."""
    settings = TrainSettings(backend="cpu")
    frame = training_frame(workload.views)
    views = [frame.view(view) for view in workload.views]
    gaussians = _in_frame(workload.gaussians, frame)
    lengths = min_view_depths(gaussians.means, views)
    params = make_parameters(gaussians, torch.device("cpu"), lengths)
    optimizers = make_optimizers(params, settings.schedule)
    return Trainer(TrainState(params, optimizers, make_strategy(settings)), settings, views, [])


def _in_frame(gaussians: Gaussians, frame: TrainingFrame) -> Gaussians:
    arrays = gaussians.arrays()
    arrays["means"] = frame.points_from_world(arrays["means"])
    arrays["scales"] = arrays["scales"] + np.float32(np.log(frame.scale))
    return Gaussians(**arrays)


def _stages(trainer: Trainer) -> dict[str, Sequence[Place]]:
    """The rasteriser's, and what else a step does."""
    optimizers, strategy = trainer.state.optimizers.values(), trainer.state.strategy
    return {
        **RENDER_STAGES,
        "loss": [(_Loss, "forward")],
        "loss backward": [(_Loss, "backward")],
        "photograph": [(trainer._photographs, "get")],  # noqa: SLF001  (likewise)
        "Adam": [(each, name) for each in optimizers for name in ("step", "zero_grad")],
        "strategy": [(strategy, "before_backward"), (strategy, "after_step")],
    }


@torch.no_grad()
def _pairs_per_pixel(trainer: Trainer) -> float:
    """Useful pairs a pixel, over all views."""
    pairs = pixels = 0
    for view in trainer.train_views:
        _, info = render_view(trainer.state.params, view, trainer.settings.sh_degree)
        names = ("means2d", "conics", "opacities", "depths", "radii")
        *arrays, radii = (info[name][0].numpy() for name in names)
        pairs += useful_pairs(*arrays, (radii > 0).all(axis=1), view.width, view.height)
        pixels += view.width * view.height
    return pairs / pixels


def first_step(path: str, clock: Clock) -> float:
    """Seconds of the first render, loss and backward of a process, modules being imported."""
    trainer = _trainer(Workload.load(Path(path)))
    watch = Stopwatch(clock)
    watch.wrap("first", trainer.warm_up)()
    return watch.lap()["first"]


@dataclass(frozen=True)
class Run:
    """Steps of one workload on some threads."""

    name: str
    threads: int
    target: float | None
    laps: Sequence[Mapping[str, float]]
    peak: float
    pairs: float

    def median(self, stage: str) -> float:
        """Milliseconds, 0 for no stage."""
        return 1e3 * statistics.median(lap.get(stage, 0.0) for lap in self.laps)

    @property
    def best(self) -> float:
        """Milliseconds of the fastest step."""
        return 1e3 * min(lap["whole"] for lap in self.laps)


def room_workload(size: tuple[int, int, int]) -> tuple[str, Workload]:
    """The made room and its name."""
    num, width, height = size
    return f"{width} x {height}, {num:,}", make_workload(num, width, height)


def scene_workload(settings: Settings) -> tuple[str, Workload]:
    """The seeds and training photographs of a real scene, as a run begins with them."""
    scene = load_scene(settings.scene)
    views, _ = load_split(scene, data_factor=settings.data_factor)
    seeds = usable_seeds(scene.points, TrainSettings(), print)
    size = f"{views[0].width} x {views[0].height}"
    return f"{scene_name(settings)}, {size}, {len(seeds):,}", Workload(
        initial_gaussians(seeds), tuple(views)
    )


def scene_name(settings: Settings) -> str:
    """The folder's name."""
    return "" if settings.scene is None else settings.scene.resolve().name


def measured_runs(
    name: str, workload: Workload, target: float | None, settings: Settings
) -> list[Run]:
    """One thread and two."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.npz"
        workload.save(path)
        return [
            Run(name, threads, target, **call(
                "benchmarks.rendering.train_step:measure", threads=threads, path=str(path),
                steps=settings.steps,
 clock=settings.clock
            ))
            for threads in THREADS
        ]  # fmt: skip


def print_steps(runs: Sequence[Run]) -> None:
    """Time and memory of the whole step."""
    header = ["view, Gaussians", "pairs a pixel", "threads", "best ms", "median ms", "target ms"]
    rows = [
        [
            run.name, f"{run.pairs:.1f}", str(run.threads), f"{run.best:.1f}",
            f"{run.median('whole'):.1f}",
            f"{run.target:g}" if run.target and run.threads == THREADS[-1] else "",
            f"{run.peak / 2**20:.0f}",
        ]
        for run in runs
    ]  # fmt: skip
    print(f"### A training step\n\n{table([*header, 'peak MiB'], rows)}\n")


def print_parts(runs: Sequence[Run]) -> None:
    """Where the time goes: forward + backward, medians over the steps."""
    header = ["ms (backward)", *(f"{run.name}: {run.threads}" for run in runs)]
    rows = [[part, *(_part(run, *stages) for run in runs)] for part, stages in PARTS.items()]
    rows.append(["whole", *(f"{run.median('whole'):.1f}" for run in runs)])
    print(f"### Parts of a step, on 1 and 2 threads\n\n{table(header, rows)}\n")


def _part(run: Run, forward: str, backward: str) -> str:
    both = run.median(forward) + run.median(backward)
    return f"{both:.1f} ({run.median(backward):.1f})" if backward else f"{both:.1f}"


def print_start_up(clock: Clock) -> None:
    """Import, and the first step with a cold and a warm cache of compiled kernels."""
    text = "import splatseed, less an interpreter that does nothing"
    rows = [[text, f"{import_seconds(clock):.2f}", f"{IMPORT_TARGET:g}"]]
    with tempfile.TemporaryDirectory() as folder:
        path, cache = Path(folder) / "scene.npz", {"NUMBA_CACHE_DIR": str(Path(folder) / "cache")}
        make_workload(*SMALL).save(path)
        for name in ("nothing on disk, so compiling", "compiled kernels on disk"):
            seconds = call(
                "benchmarks.rendering.train_step:first_step", threads=THREADS[-1],
                environment=cache,
                path=str(path), clock=clock,
            )  # fmt: skip
            rows.append([f"first step of a process, {name}", f"{seconds:.2f}", ""])
    print(f"### Starting up\n\n{table(['', 's', 'target s'], rows)}\n")


def import_seconds(clock: Clock) -> float:
    """Best seconds to ``import splatseed``, less those of an interpreter that does nothing.

    Raises:
        subprocess.CalledProcessError: It imports PyTorch.
    """
    probe = "import sys, splatseed; sys.exit('torch' in sys.modules)"
    imports, nothing = (
        min(seconds_of([sys.executable, "-c", code], clock) for _ in range(STARTS))
        for code in (probe, "pass")
    )
    return imports - nothing


def print_opensplat(
    program: Path, workloads: Sequence[tuple[str, Workload]], runs: Sequence[Run], clock: Clock
) -> None:
    """The same Gaussians and photographs through OpenSplat."""
    rows = []
    for name, workload in workloads:
        for run in (run for run in runs if run.name == name):
            theirs = 1e3 * seconds_per_step(program, workload, run.threads, clock)
            ours = run.median("whole")
            rows.append(
                [name, str(run.threads), f"{theirs:.0f}", f"{ours:.1f}", f"{theirs / ours:.1f}x"]
            )
    header = [
        "view, Gaussians",
        "threads",
        "OpenSplat, ms per step",
        "ours, median ms",
        "OpenSplat/ours",
    ]
    print(f"### Peer: OpenSplat\n\n{table(header, rows)}\n")


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}, torch {torch.__version__}; clock: {settings.clock}\n")
    if settings.clock == "wall":
        warn_if_busy()
    if settings.scene is None:
        workloads = [(*room_workload(size), SIZES.get(size)) for size in settings.sizes]
    else:
        workloads = [(*scene_workload(settings), None)]
    runs = [
        run for name, work, target in workloads
        for run in measured_runs(name, work, target, settings)
    ]  # fmt: skip
    print_steps(runs)
    print_parts(runs)
    if settings.start_up:
        print_start_up(settings.clock)
    if settings.opensplat is not None:
        program, made = settings.opensplat, [(name, work) for name, work, _ in workloads]
        or_skip("OpenSplat", lambda: print_opensplat(program, made, runs, settings.clock))


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
