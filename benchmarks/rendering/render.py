"""Speed of the CPU rasteriser: useful pairs a second, stages, threads, AVX2, and a peer in PyTorch.

Notation: a *useful pair* is a pixel with a Gaussian that adds to its colour (``splats.py``); G is
10^9. Promise: every measurement has a process of its own; times are the best of several passes over
one view, stage by stage; ratios are of one run on one machine. Each table is Markdown. See
README.md for what is and is not measured.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from benchmarks.common.children import avx2_environment, call, thread_settings
from benchmarks.common.clocks import Clock
from benchmarks.common.machine import describe, warn_if_busy
from benchmarks.common.markdown import table
from benchmarks.rendering.splats import Workload, make_workload, useful_pairs
from benchmarks.rendering.stopwatch import RENDER_STAGES, Stopwatch, timed
from benchmarks.rendering.torch_rasterizer import rasterize
from torch import Tensor

from splatseed.errors import SplatseedError
from splatseed.rendering import rasterization

__all__: list[str] = []

FORWARD_TARGET, BACKWARD_TARGET = 0.9, 0.45
"""G useful pairs a second and core at 800 x 600 with 200,000 Gaussians, AVX-512."""
AVX2_TARGET = 1.3
SH_DEGREE = 3
VIEW = 3
"""Which of the workload's views is timed."""
STAGES = {
    "forward": ("project", "harmonics", "bin", "blend layout", "blend kernel"),
    "backward": ("project", "harmonics", "blend layout", "blend kernel"),
}
THREADS = (1, 2)
PEER_REPEATS = 3


@dataclass(frozen=True)
class Settings:
    """What to measure."""

    num: int = 200_000
    """Gaussians."""
    size: tuple[int, int] = (800, 600)
    """Width and height in pixels."""
    repeats: int = 15
    """Passes; of each stage the best counts."""
    avx2: bool = True
    """Also without AVX-512, where the processor has it; compiles anew, which takes a minute."""
    peer_num: int = 50_000
    """Gaussians for the peer; 0 leaves it out."""
    peer_size: tuple[int, int] = (400, 300)
    """Width and height for the peer."""
    clock: Clock = "wall"
    """On a machine that is not idle, cpu: the busiest thread's time on a core, stage by stage."""


def measure(path: str, repeats: int, clock: Clock) -> dict[str, Any]:
    """Best seconds by stage, of forward and of backward, and the useful pairs of the view."""
    workload = Workload.load(Path(path))
    inputs, weights = _inputs(workload), _weights(workload)
    _passes(Stopwatch(), rasterization, inputs, weights)
    with timed(RENDER_STAGES, clock) as watch:
        passes = [_passes(watch, rasterization, inputs, weights) for _ in range(repeats)]
    laps = [seconds for seconds, _ in passes]
    best = {name: min(lap[name] for lap in laps) for name in laps[0]}
    return {"seconds": best, "pairs": _pairs(passes[-1][1])}


def measure_peer(path: str, clock: Clock) -> dict[str, Any]:
    """Forward and backward seconds of the peer and of ours, and how far their images are apart."""
    workload = Workload.load(Path(path))
    inputs, weights = _inputs(workload), _weights(workload)
    _passes(Stopwatch(), rasterization, inputs, weights)
    best, images = {}, []
    for name, function in (("peer", rasterize), ("ours", rasterization)):
        passes = [_passes(Stopwatch(clock), function, inputs, weights) for _ in range(PEER_REPEATS)]
        best[name] = {way: min(seconds[way] for seconds, _ in passes) for way in STAGES}
        info = passes[0][1]
        images.append(info["image"])
    gap = float((images[0] - images[1]).abs().max())
    return {**best, "gap": gap, "pairs": _pairs(info)}


def _weights(workload: Workload) -> Tensor:
    """A gradient to send back."""
    view = workload.views[VIEW]
    shape = (1, view.height, view.width, 3)
    return torch.from_numpy(np.random.default_rng(0).normal(size=shape)).float()


def _inputs(workload: Workload) -> dict[str, Any]:
    """Arguments of ``rasterization``: what a trainer hands it, as leaves."""
    arrays, view = workload.gaussians.arrays(), workload.views[VIEW]
    tensors = {name: torch.tensor(array) for name, array in arrays.items()}
    tensors["scales"] = torch.exp(tensors["scales"])
    tensors["opacities"] = torch.sigmoid(tensors["opacities"])
    for tensor in tensors.values():
        tensor.requires_grad_()
    colors = (tensors.pop("sh0"), tensors.pop("shN"))
    camera = {"viewmats": view.cam_from_world, "Ks": view.K}
    tensors |= {name: torch.tensor(array)[None].float() for name, array in camera.items()}
    return {
        **tensors, "colors": colors, "width": view.width, "height": view.height,
        "sh_degree": SH_DEGREE, "packed": False,
    }  # fmt: skip


def _passes(
    watch: Stopwatch, function: Callable[..., Any], inputs: dict[str, Any], weights: Tensor
) -> tuple[dict[str, float], dict[str, Any]]:
    """Seconds by stage, of what is left, and of forward and backward; ``info`` with the image."""
    watch.lap()
    image, _, info = watch.wrap("rest", function)(**inputs)
    forward = watch.lap()
    watch.wrap("rest backward", image.backward)(weights)
    backward = watch.lap()
    for tensor in (*inputs.values(), *inputs["colors"]):
        if isinstance(tensor, Tensor):
            tensor.grad = None
    whole = {"forward": sum(forward.values()), "backward": sum(backward.values())}
    return {**forward, **backward, **whole}, {**info, "image": image.detach()}


def _pairs(info: dict[str, Any]) -> int:
    names = ("means2d", "conics", "opacities", "depths", "radii")
    *arrays, radii = (info[name][0].detach().numpy() for name in names)
    return useful_pairs(*arrays, (radii > 0).all(axis=1), info["width"], info["height"])


@dataclass(frozen=True)
class Run:
    """One measured configuration."""

    code: str
    threads: int
    pairs: int
    seconds: Mapping[str, float]

    def rate(self, *stages: str) -> float:
        """G useful pairs a second and core in these stages."""
        return self.pairs / sum(self.seconds[stage] for stage in stages) / self.threads / 1e9

    def milliseconds(self, stage: str, direction: str) -> float:
        """Of a stage, of the whole direction, or of what is left of it after its stages."""
        suffix = "" if direction == "forward" else " backward"
        return 1e3 * self.seconds[direction if stage == "whole" else stage + suffix]


def measured_runs(path: Path, settings: Settings) -> list[Run]:
    """One thread and two, with the processor's best instructions and with AVX2."""
    avx2 = avx2_environment()
    codes: dict[str, dict[str, str]] = {"this machine's" if avx2 is None else "AVX-512": {}}
    runs = []
    with tempfile.TemporaryDirectory() as cache:
        if avx2 is not None and settings.avx2:
            codes["AVX2"] = {**avx2, "NUMBA_CACHE_DIR": cache}
        for code, environment in codes.items():
            for threads in THREADS:
                times = call(
                    "benchmarks.rendering.render:measure", threads=threads, environment=environment,
                    path=str(path), repeats=settings.repeats, clock=settings.clock,
                )  # fmt: skip
                runs.append(Run(code, threads, times["pairs"], times["seconds"]))
    return runs


def print_rates(runs: list[Run], workload: Workload) -> None:
    """Useful pairs a second and core."""
    header = ["code", "threads", f"forward (target {FORWARD_TARGET:g})", "with layout"]
    header += [f"backward (target {BACKWARD_TARGET:g})", "with layout"]
    ways = [way for suffix in ("", " backward") for way in _blending(suffix)]
    rows = [
        [run.code, str(run.threads), *(f"{run.rate(*way):.2f}" for way in ways)] for run in runs
    ]
    print(f"### Blending, G useful pairs a second and core: {_describe(workload, runs[0].pairs)}\n")
    print(f"{table(header, rows)}\n")


def _blending(suffix: str) -> tuple[tuple[str, ...], tuple[str, ...]]:
    kernel, layout = f"blend kernel{suffix}", f"blend layout{suffix}"
    return (kernel,), (kernel, layout)


def _describe(workload: Workload, pairs: int) -> str:
    view = workload.views[VIEW]
    each = pairs / (view.width * view.height)
    return (
        f"{view.width} x {view.height}, {len(workload.gaussians):,} Gaussians, "
        f"{each:.1f} useful pairs a pixel"
    )


def print_stages(runs: list[Run]) -> None:
    """Milliseconds of every stage, one thread and two; and AVX2 over AVX-512, where both ran."""
    one, two = runs[:2]
    pairs = list(zip(runs[:2], runs[2:], strict=False))
    header = ["stage", "1 thread, ms", "2 threads, ms", "1 over 2"]
    header += [f"AVX2 over it, threads: {old.threads}" for old, _ in pairs]
    rows = []
    for direction, stages in STAGES.items():
        for stage in (*stages, "rest", "whole"):
            times = [run.milliseconds(stage, direction) for run in (one, two)]
            ratios = [times[0] / times[1]]
            ratios += [
                new.milliseconds(stage, direction) / old.milliseconds(stage, direction)
                for old, new in pairs
            ]
            cells = [f"{value:.2f}" for value in (*times, *ratios)]
            rows.append([f"{direction}: {stage}", *cells])
    target = f" (target: AVX2 at most {AVX2_TARGET:g}x slower)" if pairs else ""
    print(f"### Stages, {one.code}{target}\n\n{table(header, rows)}\n")


def print_peer(settings: Settings) -> None:
    """Ours and the plain PyTorch rasteriser on the same scene, on all cores."""
    workload = make_workload(settings.peer_num, *settings.peer_size)
    with tempfile.TemporaryDirectory() as folder:
        workload.save(Path(folder) / "scene.npz")
        measured = call(
            "benchmarks.rendering.render:measure_peer",
            threads=THREADS[-1],
            environment=thread_settings(THREADS[-1], awake=True),  # PyTorch's many small loops
            path=str(Path(folder) / "scene.npz"),
            clock=settings.clock,
        )
    names = {"peer": "PyTorch, tile by tile", "ours": "splatseed"}
    rows = []
    for name, text in names.items():
        times = [f"{1e3 * measured[name][way]:.0f}" for way in ("forward", "backward")]
        rows.append([text, *times, f"{_total(measured['peer']) / _total(measured[name]):.0f}x"])
    print(f"### Peer: {_describe(workload, measured['pairs'])}, {THREADS[-1]} threads\n")
    print(f"{table(['rasteriser', 'forward, ms', 'backward, ms', 'peer over it'], rows)}\n")
    print(f"Their images differ by at most {measured['gap']:.1e}.\n")


def _total(seconds: Mapping[str, float]) -> float:
    return seconds["forward"] + seconds["backward"]


def main(settings: Settings) -> None:
    """Measure and print."""
    print(f"{describe()}; clock: {settings.clock}\n")
    if settings.clock == "wall":
        warn_if_busy()
    workload = make_workload(settings.num, *settings.size)
    with tempfile.TemporaryDirectory() as folder:
        workload.save(Path(folder) / "scene.npz")
        runs = measured_runs(Path(folder) / "scene.npz", settings)
    print_rates(runs, workload)
    print_stages(runs)
    if settings.peer_num:
        print_peer(settings)


if __name__ == "__main__":
    try:
        main(tyro.cli(Settings, description=__doc__))
    except SplatseedError as error:
        raise SystemExit(str(error)) from None
