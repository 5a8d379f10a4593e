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
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from splatseed.bench.planning.records import CLOUD, SFM, RunResult, RunRow, RunSpec, plain
from splatseed.bench.planning.scenes import SceneFacts
from splatseed.train.schedule import Densification
from splatseed.train.settings import TrainSettings
from splatseed.upsample import METHODS, chooses_number

TESTS = 21
"""How often the test views are rendered: during training, and at the end."""
RENDER_SHARE = 0.3
"""Fraction of a step's time that rendering takes."""
LIKELY_RATIO = 3.0
"""Seeds per original, for methods that look at photographs."""
PICTURES = 3
BYTES_A_PIXEL = 2.0
"""Bytes of a PNG of a photograph, its render and its error, per pixel."""
SMALL_FILES = 60_000
SECONDS_A_VIEW = 0.8
"""Seconds per view of methods that compare photographs with each other."""
SECONDS_A_POINT = 5e-6
"""Seconds of methods that interpolate, per point of the scene and per new one."""
LEAST = 0.05
"""Seconds below which a part counts for nothing, and its factor would be noise."""
SWEEPS = 3
"""Sweeps of the median polish: enough for two kinds of names."""


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

Names: TypeAlias = tuple[str, ...]


class _Factors:
    """Factors by the names of a run, such as its scene and strategy, by median polish.

    The logarithm of a factor is a level, and an effect of each name: the median of what is left of
    the runs that have it. A slow run or two change neither.

    Args:
        seen: The names of each run, as many for each, and its factor.
        level: Whether a run of names that are not known has the level of all; else the model's.
    """

    def __init__(self, seen: Sequence[tuple[Names, float]], *, level: bool = True) -> None:
        logs = np.log([factor for _, factor in seen])
        self._level = float(np.median(logs)) if level and seen else 0.0
        self._effects: dict[str, float] = defaultdict(float)
        rest = logs - self._level
        for _ in range(SWEEPS):
            for kind in range(len(seen[0][0]) if seen else 0):
                for name in {names[kind] for names, _ in seen}:
                    which = [names[kind] == name for names, _ in seen]
                    effect = float(np.median(rest[which]))
                    self._effects[name] += effect
                    rest[which] -= effect

    def knows(self, name: str) -> bool:
        return name in self._effects

    def of(self, names: Names) -> float:
        return math.exp(self._level + sum(self._effects.get(name, 0.0) for name in names))


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
        self._known = {
            (kind, *shared)
            for row in done
            for kind, shared in [
                ("seeds", _shared(row.spec) if _makes(row.spec) else ()),
                ("depths", _shared(row.spec)[::2] if self._compares(row.spec) else ()),
            ]
        }
        self._growth = _measured_growth(done)
        trained = [row for row in done if row.result and not row.result.twin]
        self._seeding = _Factors(self._seeding_factors(done), level=False)
        self._training = _Factors(self._training_factors(trained))
        alone = [row for row in trained if not _shares(row.spec)]
        self._around = _Factors(self._around_factors(alone or trained))

    def _seeding_factors(self, rows: Sequence[RunRow]) -> list[tuple[Names, float]]:
        """The factors of making seeds, by names."""
        return [
            (_by_method(row.spec), took / said)
            for row in rows
            for took, said in [(_seed_seconds(row), self._modelled_seeding(row.spec))]
            if took > LEAST and said > 0
        ]

    def _training_factors(self, rows: Sequence[RunRow]) -> list[tuple[Names, float]]:
        """The factors of the steps, by names."""
        return [
            (_by_strategy(row.spec), took / said)
            for row in rows
            for took, said in [(self._stepping(row), self._modelled_training(*_of(row)))]
        ]

    def _around_factors(self, rows: Sequence[RunRow]) -> list[tuple[Names, float]]:
        """The factors of what is around the steps, by names."""
        return [
            (_by_scene(row.spec), took / said)
            for row in rows
            for took, said in [(_seconds_around(row), self._modelled_around(*_of(row)))]
            if took > LEAST
        ]

    def seconds(self, spec: RunSpec) -> float:
        """Of a run, from its start to its end."""
        seeding = self._seeding.of(_by_method(spec)) * self._modelled_seeding(spec)
        if self.is_twin(spec):
            return seeding + READING
        training = self._training.of(_by_strategy(spec)) * self._modelled_training(spec)
        around = self._around.of(_by_scene(spec)) * self._modelled_around(spec)
        return seeding + training + self._looking(spec) + around

    def of_all(self, specs: Iterable[RunSpec]) -> dict[str, float]:
        """Seconds of several runs by their keys; what they share takes time in the first alone.

        Args:
            specs: In the order in which they are run.
        """
        known, seconds = set(self._known), {}
        for spec in specs:
            shared = _shared(spec)
            seconds[spec.key] = self.seconds(spec)
            if ("seeds", *shared) in known:
                seconds[spec.key] -= self._seeding.of(_by_method(spec)) * self._modelled_seeding(
                    spec
                )
            if self._compares(spec):
                if ("depths", *shared[::2]) in known:
                    seconds[spec.key] -= self._looking(spec)
                known.add(("depths", *shared[::2]))
            if _makes(spec):
                known.add(("seeds", *shared))
        return seconds

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

    def _modelled_training(self, spec: RunSpec, result: RunResult | None = None) -> float:
        first, last = (
            self._counts(spec) if result is None else (result.num_seeds, result.num_gaussians)
        )
        return self._step(spec, (first + last) / 2) * spec.training.max_steps

    def _stepping(self, row: RunRow) -> float:
        """Seconds of a finished run's steps, without looking for depth, as far as that is known."""
        took = _train_seconds(row)
        return max(took - self._looking(row.spec), LEAST_STEPPING * took)

    def _looking(self, spec: RunSpec) -> float:
        """Seconds of training that go into looking for depth, which growth does."""
        if not self._compares(spec):
            return 0.0
        known = next((name for name in COMPARING if self._seeding.knows(name)), AUTO)
        return self._seeding.of((known,)) * self._comparing(spec)

    def _compares(self, spec: RunSpec) -> bool:
        """Whether training looks for depth in the photographs, which seeding has not paid for."""
        looks = spec.settings.densification == "grow" and spec.settings.placing == "stereo"
        return looks and not self.is_twin(spec) and plain(spec.arm.method) != AUTO

    def _modelled_around(self, spec: RunSpec, result: RunResult | None = None) -> float:
        last = self._counts(spec)[1] if result is None else result.num_gaussians
        tests = -(-self._scenes[spec.scene_digest].num_images // spec.training.test_every)
        return self._speed(spec).around + TESTS * tests * RENDER_SHARE * self._step(spec, last)

    def _modelled_seeding(self, spec: RunSpec) -> float:
        scene, method = self._scenes[spec.scene_digest], plain(spec.arm.method)
        points = scene.num_points
        if method == SFM:
            return SECONDS_A_POINT * points if spec.most_seeds is not None else 0.0
        if method not in METHODS or not chooses_number(method):
            return SECONDS_A_POINT * (points + self._made(spec))
        if self.is_twin(spec) and method == AUTO:  # it looks at no photograph then
            return SECONDS_A_POINT * points
        return self._comparing(spec) * (COVERING if method in {COVER, CLOUD} else 1.0)

    def _comparing(self, spec: RunSpec) -> float:
        """Seconds of comparing a scene's photographs with each other."""
        images = self._scenes[spec.scene_digest].num_images
        return SECONDS_A_VIEW * images * CORES_MEASURED / self._threads

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
        return self._scenes[spec.scene_digest].pixels_at(spec.training.data_factor)

    def _speed(self, spec: RunSpec) -> _Speed:
        return SPEEDS["cuda" if spec.training.backend == "cuda" else "cpu"]

    def _step(self, spec: RunSpec, gaussians: float) -> float:
        cores = 1.0 if spec.training.backend == "cuda" else CORES_MEASURED / self._threads
        return cores * self._speed(spec).step(gaussians, self._pixels(spec))


AUTO, COVER = "auto", "cover"
PHOTOGRAPHS = frozenset({AUTO, COVER})
COMPARING = ("stereo", AUTO)
"""Methods whose time tells how long comparing photographs takes."""
LEAST_STEPPING = 0.3
"""Least share of training's time that the steps take."""
COVERING = 0.1
"""What looking for gaps takes, as a share of comparing photographs."""
FILLING = frozenset({SFM, *PHOTOGRAPHS, "linear", "triangle", "spline", "mls", "voronoi", "random",
                     "depth"})  # fmt: skip
"""Methods that add nothing where the originals fill the budget."""
READING = 3.0
"""Seconds that a run takes besides its seeds if its training is reused."""


def _densification(spec: RunSpec) -> Densification:
    return spec.settings.densification


def _makes(spec: RunSpec) -> bool:
    """Whether a run's method looks at photographs, so that what it makes is kept for others."""
    method = plain(spec.arm.method)
    return method in METHODS and chooses_number(method)


def _shares(spec: RunSpec) -> bool:
    """Whether a run may have taken less time than it counts."""
    return _makes(spec) or spec.settings.densification == "grow"


def _shared(spec: RunSpec) -> tuple[object, ...]:
    """What runs with the same seeds share; without the method, what runs with the same depth do."""
    return spec.scene_digest, spec.arm.method, spec.repeat


def _by_strategy(spec: RunSpec) -> Names:
    return spec.scene_digest, spec.arm.strategy


def _by_method(spec: RunSpec) -> Names:
    return (spec.arm.method,)


def _by_scene(spec: RunSpec) -> Names:
    return (spec.scene_digest,)


def _of(row: RunRow) -> tuple[RunSpec, RunResult | None]:
    return row.spec, row.result


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
    """Bytes of a Gaussian: place, scale, rotation, opacity, colours."""
    return 4 * (3 + 3 + 4 + 1 + 3 * (settings.sh_degree + 1) ** 2)
