"""How long a benchmark will take, and how much disk: an estimate that finished runs refine.

Notation: a training step takes about a + b G + c P seconds for G Gaussians and P pixels; a run
takes its steps, the making of its seeds, and what is *around* them: reading, tests, scores,
pictures. A *factor* is the ratio of actual to modelled time. Promise: before there are finished
runs, the numbers are those of one machine, and the estimate can be off by several times; finished
runs give each part its factors, by scene, strategy and method, and if one of these has not been run
the others stand in for it.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from splatseed.bench.planning.records import SFM, RunResult, RunRow, RunSpec
from splatseed.bench.planning.scenes import SceneFacts
from splatseed.train.schedule import Densification
from splatseed.train.settings import TrainSettings
from splatseed.upsample import METHODS, chooses_number

__all__ = ["Estimator"]

TESTS = 21
"""How often the test views are rendered: during training, and at the end."""
RENDER_SHARE = 0.3
"""Fraction of a step's time that rendering takes."""
LIKELY_RATIO = 3.0
"""Seeds to every original, of methods that look at photographs."""
PICTURES = 3
BYTES_A_PIXEL = 2.0
"""Bytes of a PNG of a photograph, its render and its error, per pixel."""
SMALL_FILES = 60_000
SECONDS_A_VIEW = 0.8
"""Of methods that compare photographs with each other."""
SECONDS_A_POINT = 5e-6
"""Of methods that interpolate, for each point of the scene and each new one."""
LEAST = 0.05
"""Shorter parts, in seconds, are ignored: their factors would be noise."""
DOUBT = 0.3
"""How strongly factors of a scene, strategy or method are shrunk to 1: the more runs, the less."""


@dataclass(frozen=True)
class _Speed:
    """Seconds per step: a, b per Gaussian, c per pixel; and seconds around training."""

    fixed: float
    per_gaussian: float
    per_pixel: float
    around: float

    def step(self, gaussians: float, pixels: float) -> float:
        return self.fixed + self.per_gaussian * gaussians + self.per_pixel * pixels


SPEEDS: Mapping[str, _Speed] = MappingProxyType(
    {
        "cpu": _Speed(6e-3, 0.18e-6, 0.09e-6, 6.0),  # measured: 2 cores with AVX-512, three scenes
        "cuda": _Speed(8e-3, 5e-9, 2e-9, 20.0),  # 30,000 steps at 3 million Gaussians: 13 minutes
    }
)
CORES_MEASURED = 2
GROWTH: Mapping[Densification, float] = MappingProxyType(
    {"none": 1.0, "default": 3.0, "grow": 3.0, "mcmc": 3.0}
)
"""Gaussians at the end of a run, per seed; with default and mcmc, a guess."""

Labels: TypeAlias = Sequence[tuple[str, str]]


class _Factors:
    """Factors by scene, strategy and method: their logarithms add up, fitted by ridge regression.

    Args:
        seen: What a run is labelled by, and its factor.
    """

    def __init__(self, seen: Sequence[tuple[Labels, float]]) -> None:
        self._names = {
            name: i for i, name in enumerate(dict.fromkeys(x for s, _ in seen for x in s))
        }
        if not seen:
            self._level, self._effects = 0.0, np.zeros(0)
            return
        logs = np.log([factor for _, factor in seen])
        self._level = float(np.median(logs))
        design = np.array([[name in set(labels) for name in self._names] for labels, _ in seen])
        normal = design.T @ design + DOUBT * np.eye(len(self._names))
        self._effects = np.linalg.solve(normal, design.T @ (logs - self._level))

    def of(self, labels: Labels) -> float:
        known = [self._effects[self._names[name]] for name in labels if name in self._names]
        return math.exp(self._level + float(sum(known)))


class Estimator:
    """Estimates for the runs of a benchmark.

    Args:
        scenes: Facts about the scenes.
        rows: The ledger's rows.
        threads: Threads of each run; for the CPU.
    """

    def __init__(
        self, scenes: Iterable[SceneFacts], rows: Iterable[RunRow], threads: int = CORES_MEASURED
    ) -> None:
        self._scenes = {scene.digest: scene for scene in scenes}
        self._threads = threads
        done = [row for row in rows if row.result and row.spec.scene_digest in self._scenes]
        self.num_measured = len(done)
        self._growth = _measured_growth(done)
        trained = [row for row in done if row.result and not row.result.twin]
        self._training = self._fitted(trained, _train_seconds, self._modelled_training)
        self._seeding = self._fitted(done, _seed_seconds, self._modelled_seeding)
        self._around = self._fitted(trained, _seconds_around, self._modelled_around)

    def seconds(self, spec: RunSpec) -> float:
        """The seconds of a run, from start to end."""
        labels = _labels(spec)
        seeding = self._seeding.of(labels) * self._modelled_seeding(spec, None)
        if self.is_twin(spec):
            return seeding + READING
        training = self._training.of(labels) * self._modelled_training(spec, None)
        return seeding + training + self._around.of(labels) * self._modelled_around(spec, None)

    def is_twin(self, spec: RunSpec) -> bool:
        """Whether a run will reuse the training of one that begins with the same seeds."""
        most, arm = spec.most_seeds, spec.arm
        full = most is not None and self._scenes[spec.scene_digest].num_points >= most
        fills = not arm.ratio and arm.method in FILLING
        return full and fills and spec.training.backend == "cpu"

    def seeds(self, spec: RunSpec) -> int:
        """Gaussians that a run begins with."""
        return int(self._counts(spec)[0])

    def disk(self, spec: RunSpec, *, models: bool) -> float:
        """Bytes that are stored for a run."""
        pictures = PICTURES * 3 * BYTES_A_PIXEL * self._pixels(spec)
        model = self._counts(spec)[1] * _bytes_each(spec.settings) if models else 0.0
        return pictures + model + SMALL_FILES

    def checkpoint(self, spec: RunSpec) -> float:
        """Bytes that a run needs meanwhile: its Gaussians, and two moments of each number."""
        return 3.0 * self._counts(spec)[1] * _bytes_each(spec.settings)

    def _fitted(self, rows: Sequence[RunRow], measured: Measured, modelled: Modelled) -> _Factors:
        seen = []
        for row in rows:
            took, said = measured(row), modelled(row.spec, row.result)
            if took > LEAST and said > 0:
                seen.append((_labels(row.spec), took / said))
        return _Factors(seen)

    def _modelled_training(self, spec: RunSpec, result: RunResult | None) -> float:
        first, last = (
            self._counts(spec) if result is None else (result.num_seeds, result.num_gaussians)
        )
        return self._step(spec, (first + last) / 2) * spec.training.max_steps

    def _modelled_around(self, spec: RunSpec, result: RunResult | None) -> float:
        last = self._counts(spec)[1] if result is None else result.num_gaussians
        tests = -(-self._scenes[spec.scene_digest].num_images // spec.training.test_every)
        return self._speed(spec).around + TESTS * tests * RENDER_SHARE * self._step(spec, last)

    def _modelled_seeding(self, spec: RunSpec, _result: RunResult | None) -> float:
        scene, method = self._scenes[spec.scene_digest], spec.arm.method
        points = scene.num_points
        if method == SFM:
            return SECONDS_A_POINT * points if spec.most_seeds is not None else 0.0
        if method not in METHODS or not chooses_number(method):
            return SECONDS_A_POINT * (points + self._made(spec))
        if self.is_twin(spec) and method == AUTO:  # it looks at no photograph then
            return SECONDS_A_POINT * points
        return SECONDS_A_VIEW * scene.num_images * CORES_MEASURED / self._threads

    def _made(self, spec: RunSpec) -> float:
        """Points in all that a method makes, before they are thinned."""
        points = self._scenes[spec.scene_digest].num_points
        most = spec.most_seeds
        if most is not None and not spec.arm.ratio and spec.arm.method in FILLING - PHOTOGRAPHS:
            return max(points, most)
        return points * (spec.arm.ratio or LIKELY_RATIO)

    def _counts(self, spec: RunSpec) -> tuple[float, float]:
        """Gaussians at the start and at the end."""
        most = spec.settings.cap or float("inf")
        seeds = min(self._made(spec), spec.most_seeds or most)
        strategy = spec.arm.strategy
        if spec.most_seeds is not None and spec.settings.densification != "none":
            return seeds, most
        alike = self._growth.get((strategy, spec.arm.ratio)) or self._growth.get((strategy, None))
        return seeds, min(seeds * (alike or GROWTH[_densification(spec)]), most)

    def _pixels(self, spec: RunSpec) -> float:
        return self._scenes[spec.scene_digest].pixels / spec.training.data_factor**2

    def _speed(self, spec: RunSpec) -> _Speed:
        return SPEEDS["cuda" if spec.training.backend == "cuda" else "cpu"]

    def _step(self, spec: RunSpec, gaussians: float) -> float:
        cores = 1.0 if spec.training.backend == "cuda" else CORES_MEASURED / self._threads
        return cores * self._speed(spec).step(gaussians, self._pixels(spec))


Measured: TypeAlias = Callable[[RunRow], float]
Modelled: TypeAlias = Callable[[RunSpec, RunResult | None], float]

AUTO = "auto"
PHOTOGRAPHS = frozenset({AUTO, "cover"})
FILLING = frozenset({SFM, *PHOTOGRAPHS, "linear", "triangle", "spline", "mls", "voronoi", "random",
                     "depth"})  # fmt: skip
"""Methods that add nothing where the originals fill the budget."""
READING = 3.0
"""Seconds of a run whose training is reused, besides its seeds."""


def _densification(spec: RunSpec) -> Densification:
    return spec.settings.densification


def _labels(spec: RunSpec) -> Labels:
    return (
        ("scene", spec.scene_digest),
        ("strategy", spec.arm.strategy),
        ("method", spec.arm.method),
        ("budget", spec.arm.budget),
    )


def _measured_growth(done: Sequence[RunRow]) -> dict[tuple[str, float | None], float]:
    """Growth by strategy and ratio (few seeds grow more), and by strategy alone."""
    seen: dict[tuple[str, float | None], list[float]] = defaultdict(list)
    for row in done:
        if row.result:
            growth = row.result.num_gaussians / row.result.num_seeds
            for ratio in (row.spec.arm.ratio, None):
                seen[row.spec.arm.strategy, ratio].append(growth)
    return {key: median(values) for key, values in seen.items()}


def _train_seconds(row: RunRow) -> float:
    return row.result.train_seconds if row.result else 0.0


def _seed_seconds(row: RunRow) -> float:
    return row.result.upsample_seconds if row.result else 0.0


def _seconds_around(row: RunRow) -> float:
    """Seconds of a run besides its steps and seeds; little if it was resumed."""
    assert row.result is not None  # noqa: S101  (only finished runs are asked about)
    assert row.started is not None  # noqa: S101  (for mypy: it is known here)
    assert row.finished is not None  # noqa: S101  (for mypy: it is known here)
    return max(row.finished - row.started - row.result.seconds, 0.0)


def _bytes_each(settings: TrainSettings) -> int:
    """Of a Gaussian's numbers: place, scale, rotation, opacity, colours."""
    return 4 * (3 + 3 + 4 + 1 + 3 * (settings.sh_degree + 1) ** 2)
