"""How close new points come to known surfaces, and how well they fill them.

Notation: h is the spacing of a case's originals (mean distance to the 6 nearest); error, p95 and
coverage are in units of h and mean what ``splatseed.seeding.geometry_score`` says, sum = error +
coverage. A *case* is a shape, a noise level and a seed; an *arm* is a method with its parameters.
Promise: nothing here depends on the clock; the same code gives the same tables.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import tyro
from benchmarks.common.clouds import sample_unevenly
from benchmarks.common.markdown import table
from benchmarks.upsampling import naive

import splatseed as ss
from splatseed.seeding.geometry_score import GeometryScore, far_share, mean_spacing, measure
from splatseed.synthetic import SHAPES, Surface
from splatseed.synthetic.surfaces import SineSheet, plane, sine_sheet

__all__: list[str] = []

ARMS: dict[str, dict[str, Any]] = {
    "linear": {"method": "linear"},
    "linear, paper": {"method": "linear", "profile": "paper"},
    "triangle": {"method": "triangle"},
    "triangle, paper": {"method": "triangle", "profile": "paper"},
    "mls": {"method": "mls"},
    "mls, k = 10": {"method": "mls", "k": 10},
    "mls, triangle placement": {"method": "mls", "placement": "triangle"},
    "mls, paper": {"method": "mls", "profile": "paper"},
    "spline (lambda 0.01)": {"method": "spline"},
    "spline, triangle placement": {"method": "spline", "placement": "triangle"},
    "spline, paper": {"method": "spline", "profile": "paper"},
    "voronoi": {"method": "voronoi"},
    "voronoi, paper": {"method": "voronoi", "profile": "paper"},
    "random": {"method": "random"},
}
ORIGINALS_ONLY = "originals only"

NOISE_LEVELS = (0.05, 0.2)
"""Standard deviation of each coordinate of the originals, in units of h."""
TEXTURE_PATCH = 1.0
"""Width of dense and sparse patches, in scene units; the shapes measure about 2."""
COVERAGE_SAMPLES = 20_000
TILTS = (0, 30, 60, 90)
TILT_ARMS = ("mls", "mls, paper", "spline (lambda 0.01)", "spline, paper")
TILT_NOISE = 0.1
LITERAL_ARMS = {"mls, paper": naive.mls, "spline, paper": naive.spline}
LITERAL_POINTS = 1_500


@dataclass(frozen=True)
class Settings:
    """How much to measure."""

    points: int = 3_000
    """Originals of each case."""
    ratio: float = 8.0
    """Points in all per original."""
    seeds: int = 3
    """Clouds of each shape and noise level."""


@dataclass(frozen=True, eq=False)
class Case:
    """Noisy, unevenly dense originals of one known surface."""

    shape: str
    seed: int
    surface: Surface
    originals: ss.PointCloud
    samples: np.ndarray
    h: float

    def score(self, options: dict[str, Any] | None, ratio: float) -> GeometryScore:
        """The score of an arm, or of the originals by themselves."""
        if options is None:
            new = every = self.originals.xyz
        else:
            every = ss.upsample(self.originals, ratio=ratio, seed=self.seed, **options).xyz
            new = every[len(self.originals) :]
        return measure(new, every, self.surface, self.samples, self.h)


def make_case(shape: str, surface: Surface, noise: float, num: int, seed: int) -> Case:
    """Draw the originals of a case; ``noise`` in units of their spacing."""
    rng = np.random.default_rng(seed)
    clean = sample_unevenly(surface, num, rng, TEXTURE_PATCH)
    xyz = clean + rng.normal(scale=noise * mean_spacing(clean), size=clean.shape)
    originals = ss.PointCloud(xyz.astype(np.float32), np.full((num, 3), 128, np.uint8))
    samples = surface.sample(COVERAGE_SAMPLES, rng)
    return Case(shape, seed, surface, originals, samples, mean_spacing(originals.xyz))


def make_cases(settings: Settings) -> Iterator[Case]:
    """Every shape at every noise level with every seed."""
    for shape, make in SHAPES.items():
        for noise in NOISE_LEVELS:
            for seed in range(settings.seeds):
                yield make_case(shape, make(), noise, settings.points, seed)


@dataclass(frozen=True)
class Scored:
    """One arm's score in one case."""

    arm: str
    shape: str
    seed: int
    score: GeometryScore

    @property
    def sum(self) -> float:
        """Error and coverage together."""
        return self.score.error + self.score.coverage


def score_all(settings: Settings) -> list[Scored]:
    """Every arm in every case."""
    arms: dict[str, dict[str, Any] | None] = {ORIGINALS_ONLY: None, **ARMS}
    return [
        Scored(arm, case.shape, case.seed, case.score(options, settings.ratio))
        for case in make_cases(settings)
        for arm, options in arms.items()
    ]


def arm_table(results: list[Scored]) -> str:
    """Every arm's means over all cases; +- is the standard error over seeds."""
    header = ["arm", "error", "median", "p95", "coverage", "sum", "far points"]
    return table(header, [_arm_row(arm, _of(results, arm)) for arm in _names(results)])


def _names(results: list[Scored]) -> list[str]:
    return list(dict.fromkeys(result.arm for result in results))


def _of(results: list[Scored], arm: str) -> list[Scored]:
    return [result for result in results if result.arm == arm]


def _arm_row(arm: str, results: list[Scored]) -> list[str]:
    scores = [r.score for r in results]
    error, median, p95, coverage, far = (
        np.mean([getattr(score, name) for score in scores])
        for name in ("error", "median", "p95", "coverage", "share_far")
    )
    by_seed = [np.mean([r.sum for r in results if r.seed == s]) for s in {r.seed for r in results}]
    doubt = f" ± {np.std(by_seed, ddof=1) / len(by_seed) ** 0.5:.3f}" if len(by_seed) > 1 else ""
    numbers = [f"{error:.3f}", f"{median:.3f}", f"{p95:.2f}", f"{coverage:.3f}"]
    return [arm, *numbers, f"{error + coverage:.3f}{doubt}", f"{100 * far:.2f}%"]


def shape_table(results: list[Scored]) -> str:
    """Every arm's sum on each shape."""
    shapes = list(SHAPES)
    rows = [[arm, *_sums(_of(results, arm), shapes)] for arm in _names(results)]
    return table(["sum", *shapes], rows)


def _sums(results: list[Scored], shapes: Iterable[str]) -> list[str]:
    return [f"{np.mean([r.sum for r in results if r.shape == shape]):.3f}" for shape in shapes]


def tilt_table(settings: Settings) -> str:
    """Share of far points, and median error, on sheets that are turned from floor to wall."""
    rows = [
        [f"{name}: {arm}", *(_tilt_cell(ARMS[arm], make(tilt), settings) for tilt in TILTS)]
        for name, make in (("flat", plane), ("wavy", _tilted_waves))
        for arm in TILT_ARMS
    ]
    return table(["far points, median error", *(f"{tilt}°" for tilt in TILTS)], rows)


def _tilted_waves(tilt: float) -> SineSheet:
    """The sine sheet turned about the x axis, along which its waves run."""
    c, s = np.cos(np.radians(tilt)), np.sin(np.radians(tilt))
    frame = np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]])
    return dataclasses.replace(sine_sheet(), corner=-frame[0] - frame[1], frame=frame)


def _tilt_cell(options: dict[str, Any], surface: Surface, settings: Settings) -> str:
    cases = [
        make_case("tilted", surface, TILT_NOISE, settings.points, seed)
        for seed in range(settings.seeds)
    ]
    scores = [case.score(options, settings.ratio) for case in cases]
    far, error = np.mean([(score.share_far, score.median) for score in scores], axis=0)
    return _far_and_error(far, error)


def _far_and_error(far: float, error: float) -> str:
    return f"{100 * far:.1f}%, {error:.2f}"


def literal_table(settings: Settings) -> str:
    """The paper profile beside a literal loop (LAPACK, FITPACK): do they make the same points?"""
    cases = [
        make_case(shape, make(), TILT_NOISE, settings.points, seed=0)
        for shape, make in SHAPES.items()
    ]
    rows = []
    for arm, make_point in LITERAL_ARMS.items():
        profile = (case.score(ARMS[arm], settings.ratio) for case in cases)
        rows.append([arm, *(_far_and_error(s.share_far, s.median) for s in profile)])
        rows.append([f"{arm}, literal", *(_literal_cell(case, make_point) for case in cases)])
    return table(["far points, median error", *SHAPES], rows)


def _literal_cell(case: Case, make_point: Callable[..., tuple[np.ndarray, np.ndarray]]) -> str:
    rng = np.random.default_rng(case.seed)
    originals = naive.Originals(case.originals.xyz.astype(np.float64), case.originals.rgb)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # FITPACK warns of nearly every patch
        new = np.array([make_point(originals, rng)[0] for _ in range(LITERAL_POINTS)])
    error = np.median(case.surface.distance(new)) / case.h
    return _far_and_error(far_share(case.originals.xyz, new), error)


def main(settings: Settings) -> None:
    """Print every table."""
    results = score_all(settings)
    print(f"### Known surfaces\n\n{arm_table(results)}\n")
    print(f"### Error + coverage by shape\n\n{shape_table(results)}\n")
    print(f"### Tilt\n\n{tilt_table(settings)}\n")
    print(f"### The paper profile and the paper's text\n\n{literal_table(settings)}\n")


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
