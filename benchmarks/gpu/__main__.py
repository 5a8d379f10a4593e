"""splatseed on a GPU, as Markdown to paste into an issue: ten minutes on an ordinary one.

    python -m benchmarks.gpu [SCENE] [--gsplat-examples gsplat/examples]

Compares gsplat on CUDA with our CPU rasteriser on the same inputs, trains the demo's room on both,
and trains a capture (without one, a larger room) on the GPU, beside gsplat's own trainer where its
files are at hand. Each part has a process of its own: one that fails is reported and costs no
other. Everything on stdout is the report; progress is on stderr. Exits with 0 if all agrees, with 1
if something differs or failed, and with 2 without a GPU.
"""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import torch
import tyro
from benchmarks.common.children import call
from benchmarks.common.machine import describe
from benchmarks.common.markdown import table
from benchmarks.gpu.compare_gsplat import ODD_ONES, TOLERANCE
from benchmarks.training.peer_stand_ins import check_examples

from splatseed import load_scene
from splatseed.console import ERR, StageClock, stage_display
from splatseed.errors import ParameterError, SplatseedError
from splatseed.synthetic import make_capture, write_capture

__all__: list[str] = []

STRATEGIES = ("default", "mcmc", "grow")
LINES = 8
"""Of an error, so many last lines are told."""
APART = 0.3
"""Decibels by which two runs of the small room may differ: one varies by up to this much."""


class Work(NamedTuple):
    """A room, and how it is trained.

    Attributes:
        views: Photographs.
        size: Their width and height.
        steps: Training steps.
        cap: Most Gaussians.
    """

    views: int
    size: tuple[int, int]
    steps: int
    cap: int


class Sizes(NamedTuple):
    """How much of each part.

    Attributes:
        crowd: Gaussians of the larger comparisons.
        both: The room that is trained on both devices.
        gpu: The room that is trained on the GPU alone; of a capture, steps and cap.
    """

    crowd: int
    both: Work
    gpu: Work


FULL = Sizes(30_000, Work(24, (320, 240), 600, 6_000), Work(48, (960, 720), 3_000, 200_000))
QUICK = Sizes(2_000, Work(9, (64, 48), 40, 600), Work(9, (96, 72), 40, 1_000))


@dataclass(frozen=True)
class Options:
    """What to run."""

    scene: Annotated[Path | None, tyro.conf.Positional] = None
    """A capture to train on the GPU (default: a larger room like the demo's)."""
    data_factor: int = 1
    """By how much its photographs are made smaller."""
    gsplat_examples: Path | None = None
    """The folder examples of a checkout of gsplat v1.5.3, to train with its own trainer too."""
    quick: bool = False
    """Tiny sizes, to see that it works; neither times nor decibels mean anything then."""


class Report:
    """Runs parts, prints sections, and remembers what went wrong."""

    def __init__(self) -> None:
        self.failures: list[tuple[str, str]] = []
        self._clock = StageClock()

    def run(self, part: str, function: str, **arguments: Any) -> Any:
        """What a function returns in a process of its own; None if it failed."""
        with stage_display(self._clock) as clock:
            clock(part, 0.0)
            try:
                return call(f"benchmarks.gpu.{function}", threads=os.cpu_count() or 1, **arguments)
            except (SplatseedError, OSError) as error:
                last = "\n".join(str(error).strip().splitlines()[-LINES:])
                self.failures.append((part, last))
                return None
            finally:
                clock(part, 1.0)

    def check(self, part: str, problems: Sequence[str]) -> None:
        """Note what a part that ran found wrong."""
        self.failures += [(part, problem) for problem in problems]


def main(options: Options) -> int:
    """Run all parts and print the report.

    Raises:
        InputError: There is no GPU, or what the options name cannot be read.
    """
    if not torch.cuda.is_available():
        raise ParameterError(
            "a GPU", found="none that PyTorch sees", fix="Run this on a machine that has one."
        )
    if options.gsplat_examples:
        check_examples(options.gsplat_examples)
    if options.scene:
        load_scene(options.scene)
    sizes, report = QUICK if options.quick else FULL, Report()
    print(f"### splatseed on a GPU{' (--quick)' if options.quick else ''}\n")
    _print_machine(report)
    _print_comparison(report, sizes)
    with tempfile.TemporaryDirectory() as folder:
        _print_both(report, sizes.both, _room(sizes.both, Path(folder) / "small"))
        scene = options.scene or _room(sizes.gpu, Path(folder) / "large")
        _print_gpu(report, sizes.gpu, scene.resolve(), options)
    for problem in dict.fromkeys(problem for _, problem in report.failures):
        parts = dict.fromkeys(part for part, each in report.failures if each == problem)
        print(f"**{'; '.join(parts)}**\n\n```text\n{problem}\n```\n")
    print("Something differs or failed: see above." if report.failures else "All parts agree.")
    return 1 if report.failures else 0


def _room(work: Work, path: Path) -> Path:
    width, height = work.size
    return write_capture(make_capture(0, num_views=work.views, width=width, height=height), path)


def _print_machine(report: Report) -> None:
    gpu = report.run("machine", "parts:machine")
    print("".join(f"- {name}: {value}\n" for name, value in (gpu or {}).items()), end="")
    print(f"- beside it: {describe()}\n", flush=True)


def _print_comparison(report: Report, sizes: Sizes) -> None:
    """Images, alphas, gradients and contributions of both rasterisers."""
    part = "gsplat on CUDA and our CPU rasteriser"
    results = report.run(part, "compare_gsplat:compare", crowd=sizes.crowd)
    report.check(part, [each["problem"] for each in results or () if each["problem"]])
    rows = [
        [each["case"], "no" if each["problem"] else "yes", *each["worst"]] for each in results or ()
    ]
    header = ["inputs", "agrees", "worst array", "largest difference", "entries beyond"]
    told = f"At most {ODD_ONES:g} of the entries may differ by {TOLERANCE:g} of the largest."
    _print(part, told, table(header, rows))


def _print_both(report: Report, work: Work, scene: Path) -> None:
    """Strategies on CPU and CUDA, at one size."""
    part, rows = "CPU and CUDA, the demo's room", []
    for strategy in STRATEGIES:
        runs = {}
        for backend in ("cpu", "cuda"):
            name = f"{strategy} on {backend}, small"
            runs[backend] = _train(report, name, scene, work, strategy=strategy, backend=backend)
            rows.append([strategy, backend, *_cells(runs[backend])])
        if runs["cpu"] and runs["cuda"]:
            apart = abs(runs["cuda"]["psnr"] - runs["cpu"]["psnr"])
            if apart > APART:
                report.check(part, [f"{strategy}: {apart:.2f} dB apart, more than {APART}"])
    told = f"{work.views} photographs of {work.size[0]} x {work.size[1]}, {work.steps:,} steps."
    _print(part, told, table(["strategy", "device", *COLUMNS], rows))


def _print_gpu(report: Report, work: Work, scene: Path, options: Options) -> None:
    """Strategies on CUDA, and gsplat's own trainer at the same steps and Gaussians."""
    part = f"CUDA, {options.scene.resolve().name if options.scene else 'a larger room'}"
    factor = options.data_factor
    rows = []
    for strategy in (*STRATEGIES, "mcmc-3dgs"):
        run = _train(
            report, strategy, scene, work, strategy=strategy, backend="cuda", data_factor=factor
        )
        rows.append(["splatseed", strategy, *_cells(run)])
    told = f"{work.steps:,} steps, {work.cap:,} Gaussians at most."
    if options.gsplat_examples:
        settings = {"max_steps": work.steps, "cap_max": work.cap, "data_factor": factor}
        examples = str(options.gsplat_examples.resolve())
        run = report.run(
            "gsplat's trainer", "peer:train", scene=str(scene), settings=settings, examples=examples
        )
        rows.append(["gsplat's simple_trainer", "mcmc", *_cells(run)])
    else:
        told += " Without gsplat's simple_trainer, as --gsplat-examples names no folder."
    _print(part, told, table(["trainer", "strategy", *COLUMNS], rows))


def _train(report: Report, part: str, scene: Path, work: Work, **settings: Any) -> Any:
    settings |= {"max_steps": work.steps, "cap_max": work.cap}
    return report.run(part, "parts:train", scene=str(scene), settings=settings)


COLUMNS = ("PSNR, dB", "Gaussians", "ms a step", "before, s", "peak GPU memory, GB")


def _cells(run: dict[str, float] | None) -> Iterator[str]:
    """A run's row, for ``COLUMNS``."""
    if run is None:
        return iter(["failed", *[""] * (len(COLUMNS) - 1)])
    peak = f"{run['bytes'] / 1e9:.2f}" if run["bytes"] else ""
    return iter([
        f"{run['psnr']:.2f}", f"{run['gaussians']:,}", f"{1000 * run['step']:.1f}",
        f"{run['before']:.1f}", peak,
    ])  # fmt: skip


def _print(part: str, told: str, rows: str) -> None:
    print(f"#### {part}\n\n{told}\n\n{rows}\n", flush=True)


if __name__ == "__main__":
    try:
        sys.exit(main(tyro.cli(Options, description=__doc__, prog="python -m benchmarks.gpu")))
    except SplatseedError as error:
        ERR.print(str(error), soft_wrap=True)
        sys.exit(2)
