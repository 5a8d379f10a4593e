"""How long a benchmark will take, and how much disk: an estimate, which its own runs make better.

Notation: a step of training takes about a + b G + c P seconds for G Gaussians and P pixels.
Promise: before there are runs that tell, a, b and c are those of one machine, so that the estimate
can be off by several times; with finished runs in the ledger their median takes the place of these.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from statistics import median
from types import MappingProxyType

from splatseed.bench.planning.records import RunResult, RunRow, RunSpec
from splatseed.bench.planning.scenes import SceneFacts
from splatseed.train.schedule import Densification
from splatseed.train.settings import TrainSettings

__all__ = ["Estimator"]

TESTS = 21
"""How often the test views are rendered: on the way, and at the end."""
RENDER_SHARE = 0.3
"""Of a step's time, what rendering takes."""
LIKELY_RATIO = 3.0
"""Seeds to every original, of methods that look at photographs."""
PICTURES = 3
BYTES_A_PIXEL = 2.0
"""Of a PNG of a photograph, its render and its error."""
SMALL_FILES = 60_000


@dataclass(frozen=True)
class _Speed:
    """Seconds of a step: a, b of each Gaussian, c of each pixel; and seconds around training."""

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


class Estimator:
    """Estimates for the runs of a benchmark.

    Args:
        scenes: What is known of their scenes.
        rows: What the ledger has.
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
        paces = [self._pace_of(row.spec, row.result) for row in done]
        self._pace = median(paces) if paces else 1.0
        self._around = median(map(_seconds_around, done)) if done else None

    def seconds(self, spec: RunSpec) -> float:
        """Of a run, from its start to its end."""
        seeds, final = self._counts(spec)
        step = self._pace * self._step(spec, (seeds + final) / 2)
        if self._around is not None:
            return step * spec.training.max_steps + self._around
        tests = -(-self._scenes[spec.scene_digest].num_images // spec.training.test_every)
        around = self._speed(spec).around + TESTS * tests * RENDER_SHARE * step
        return step * spec.training.max_steps + around

    def seeds(self, spec: RunSpec) -> int:
        """Gaussians that a run begins with."""
        return int(self._counts(spec)[0])

    def disk(self, spec: RunSpec, *, models: bool) -> float:
        """Bytes that are kept of a run."""
        pictures = PICTURES * 3 * BYTES_A_PIXEL * self._pixels(spec)
        model = self._counts(spec)[1] * _bytes_each(spec.settings) if models else 0.0
        return pictures + model + SMALL_FILES

    def checkpoint(self, spec: RunSpec) -> float:
        """Bytes that a run needs while it goes on: its Gaussians, and two moments of each number."""
        return 3.0 * self._counts(spec)[1] * _bytes_each(spec.settings)

    def _counts(self, spec: RunSpec) -> tuple[float, float]:
        """Gaussians at the start and at the end."""
        most = spec.settings.cap or float("inf")
        ratio = spec.arm.ratio or LIKELY_RATIO
        seeds = min(self._scenes[spec.scene_digest].num_points * ratio, most)
        strategy = spec.arm.strategy
        alike = self._growth.get((strategy, spec.arm.ratio)) or self._growth.get((strategy, None))
        return seeds, min(seeds * (alike or GROWTH[spec.settings.densification]), most)

    def _pixels(self, spec: RunSpec) -> float:
        return self._scenes[spec.scene_digest].pixels / spec.training.data_factor**2

    def _speed(self, spec: RunSpec) -> _Speed:
        return SPEEDS["cuda" if spec.training.backend == "cuda" else "cpu"]

    def _step(self, spec: RunSpec, gaussians: float) -> float:
        cores = 1.0 if spec.training.backend == "cuda" else CORES_MEASURED / self._threads
        return cores * self._speed(spec).step(gaussians, self._pixels(spec))

    def _pace_of(self, spec: RunSpec, result: RunResult | None) -> float:
        """How many times as long as the model says a finished run took."""
        assert result is not None  # noqa: S101  (only finished runs are asked about)
        modelled = self._step(spec, (result.num_seeds + result.num_gaussians) / 2)
        return result.train_seconds / spec.training.max_steps / modelled


def _measured_growth(done: Sequence[RunRow]) -> dict[tuple[str, float | None], float]:
    """Growth by strategy and ratio (few seeds grow more), and by strategy alone."""
    seen: dict[tuple[str, float | None], list[float]] = defaultdict(list)
    for row in done:
        if row.result:
            growth = row.result.num_gaussians / row.result.num_seeds
            for ratio in (row.spec.arm.ratio, None):
                seen[row.spec.arm.strategy, ratio].append(growth)
    return {key: median(values) for key, values in seen.items()}


def _seconds_around(row: RunRow) -> float:
    """What a run took beside its steps; little if it was begun before and went on."""
    assert row.result is not None  # noqa: S101  (only finished runs are asked about)
    assert row.started is not None  # noqa: S101  (for mypy: it is known here)
    assert row.finished is not None  # noqa: S101  (for mypy: it is known here)
    return max(row.finished - row.started - row.result.train_seconds, 0.0)


def _bytes_each(settings: TrainSettings) -> int:
    """Of a Gaussian's numbers: place, scale, rotation, opacity, colours."""
    return 4 * (3 + 3 + 4 + 1 + 3 * (settings.sh_degree + 1) ** 2)
