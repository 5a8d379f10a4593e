"""Studies: sets of finished runs that differ only in their seeds and so can be compared.

Notation: a *variant* is what makes the seeds (method, profile, ratio, parameters), known by its
label, such as ``mls 8x``; a *study* holds runs whose settings are equal in all but the variant, the
strategy, the scene and the repeat. Promise: runs of different settings or versions are never
compared; a run whose PSNR is not finite is set aside and counted, not averaged.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import pandas as pd

from splatseed.bench.plan import SFM, SHARED, RunResult, RunSpec
from splatseed.bench.runs import Run
from splatseed.train.settings import StrategyName
from splatseed.upsample import METHODS

STRATEGIES: tuple[StrategyName, ...] = get_args(StrategyName)


@dataclass(frozen=True)
class Variant:
    """How seeds are made.

    Args:
        method: ``SFM``, or a key of ``splatseed.METHODS``.
        profile: "default" or "paper".
        ratio: Points in all, per original; 0 for any.
        parameters: Differences from the profile, as words such as ``k=12``.
    """

    method: str
    profile: str = "default"
    ratio: float = 1.0
    parameters: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """In a few words, such as ``mls 8x`` or ``mls 8x (paper) k=12``."""
        if self.method == SFM:
            return SFM
        ratio = f" {self.ratio:g}x" if self.ratio else ""
        profile = " (paper)" if self.profile == "paper" else ""
        return " ".join([f"{self.method}{ratio}{profile}", *self.parameters])

    @property
    def family(self) -> str:
        """The label without the ratio: that of variants which differ in nothing else."""
        return replace(self, ratio=0.0).label

    @property
    def order(self) -> tuple[int, str, str, float, tuple[str, ...]]:
        """Sorts variants: the baseline, then the methods in the registry's order."""
        names = [SFM, *METHODS]
        place = names.index(self.method) if self.method in names else len(names)
        return place, self.method, self.profile, self.ratio, self.parameters


@dataclass(frozen=True, eq=False)
class Study:
    """Runs that can be compared.

    Args:
        settings: What they have in common: training settings by name, budget and version.
        runs: A row for each run, with the columns strategy, scene, seeds (the variant's label),
            repeat, key, digest (the scene's), result, and the measures of ``_measures``; NaN where
            something was not measured.
        variants: By label, in order; the baseline first if there is one.
        specs: The runs' specifications, by key.
        not_finite: Finished runs whose PSNR is infinite or NaN, in words.
    """

    settings: Mapping[str, object]
    runs: pd.DataFrame
    variants: Mapping[str, Variant]
    specs: Mapping[str, RunSpec]
    not_finite: tuple[str, ...] = ()

    @cached_property
    def strategies(self) -> tuple[StrategyName, ...]:
        """The strategies that have runs."""
        return tuple(name for name in STRATEGIES if name in set(self.runs["strategy"]))

    @cached_property
    def scenes(self) -> tuple[str, ...]:
        """All scenes, in alphabetical order."""
        return tuple(sorted(set(self.runs["scene"])))

    @property
    def seeded(self) -> tuple[str, ...]:
        """The labels of all variants but the baseline."""
        return tuple(label for label in self.variants if label != SFM)

    def under(self, strategy: StrategyName) -> pd.DataFrame:
        """The runs under a strategy."""
        return self.runs[self.runs["strategy"] == strategy]

    def seeded_under(self, strategy: StrategyName) -> tuple[str, ...]:
        """The labels of the variants but the baseline that were run under a strategy."""
        present = set(self.under(strategy)["seeds"])
        return tuple(label for label in self.seeded if label in present)

    def scenes_under(self, strategy: StrategyName) -> tuple[str, ...]:
        """The scenes that were run under a strategy."""
        return tuple(sorted(set(self.under(strategy)["scene"])))

    def results(self, strategy: StrategyName, scene: str, label: str) -> dict[int, RunResult]:
        """The results of a variant on a scene by repeat; empty where there are none."""
        part = self.under(strategy)
        part = part[(part["scene"] == scene) & (part["seeds"] == label)]
        return dict(sorted(zip(part["repeat"], part["result"], strict=True)))

    @property
    def description(self) -> str:
        """The settings in words."""
        told, factor = self.settings, self.settings["data_factor"]
        size = (
            ", ".join(f"{scene} {_size(each)}" for scene, each in factor.items())
            if isinstance(factor, Mapping)
            else f"photographs {_size(factor)}"
        )
        counts = self.runs.groupby(["strategy", "scene", "seeds"]).size()
        low, high = counts.min(), counts.max()
        repeats = f"{high}" if low == high else f"{low} to {high}"
        words = [
            f"{told['max_steps']:,} steps",
            size,
            f"every {told['test_every']}th view tested",
            f"at most {told['cap_max']:,} Gaussians" if told["cap_max"] else "",
            budget_words(str(told["budget"])) if told["budget"] else "",
            f"spherical harmonics of degree {told['sh_degree']}" if told["sh_degree"] != 3 else "",
            "opacities reset" if told["opacity_reset"] else "",
            *(name.replace("_", " ") for name in SHARED if name.startswith("seed_") and told[name]),
            f"backend {told['backend']}",
            f"splatseed {told['version']}" if told["version"] else "",
            f"{repeats} repeat{'' if high == 1 else 's'}" if len(counts) else "",
        ]
        return ", ".join(word for word in words if word)


def budget_words(budget: str) -> str:
    """A budget in words.

    Example:
        >>> budget_words("0.25rho")
        'at most 0.25 Gaussians per pixel of a photograph'
    """
    if budget.endswith("rho"):
        return f"at most {budget.removesuffix('rho')} Gaussians per pixel of a photograph"
    return f"at most {int(budget):,} Gaussians"


def _size(factor: object) -> str:
    return "at full size" if factor == 1 else f"at 1/{factor} of their size"


def studies(runs: Iterable[Run]) -> tuple[Study, ...]:
    """The studies in some runs; the one with the most runs first.

    Scenes may differ in size; only where one scene was run at several ``data_factor`` are these
    kept apart. If a scene's name stands for different content, its label says which.

    Args:
        runs: Those not finished are passed over.
    """
    groups: dict[tuple[tuple[str, object], ...], list[Run]] = defaultdict(list)
    for run in runs:
        if run.result is not None:
            groups[tuple(_common(run.spec).items())].append(run)
    grouped = [
        _study(dict(key), part) for key, group in groups.items() for part in _by_factor(group)
    ]
    return tuple(sorted(grouped, key=lambda study: -len(study.runs)))


def _common(spec: RunSpec) -> dict[str, object]:
    """What all runs of a study share; their size may differ from scene to scene."""
    settings = {name: getattr(spec.training, name) for name in SHARED if name != "data_factor"}
    if spec.arm.budget:  # in Gaussians it may differ from scene to scene
        settings["cap_max"] = None
    return {**settings, "budget": spec.arm.budget, "version": spec.version}


def _by_factor(runs: Sequence[Run]) -> list[list[Run]]:
    """The runs as one group, or one per ``data_factor`` where a scene has several."""
    factors: dict[str, set[int]] = defaultdict(set)
    groups: dict[int, list[Run]] = defaultdict(list)
    for run in runs:
        factors[run.spec.scene_digest].add(run.spec.training.data_factor)
        groups[run.spec.training.data_factor].append(run)
    several = any(len(each) > 1 for each in factors.values())
    return list(groups.values()) if several else [list(runs)]


def _study(settings: Mapping[str, object], runs: Sequence[Run]) -> Study:
    digests, maps = defaultdict(set), defaultdict(set)
    for run in runs:
        digests[run.spec.scene].add(run.spec.scene_digest)
        maps[run.spec.scene_digest].add(run.spec.depth_digest)
    several_maps = any(len(each - {""}) > 1 for each in maps.values())
    variants: dict[str, Variant] = {}
    factors: dict[str, int] = {}
    rows, odd = [], []
    for run in runs:
        spec, result = run.spec, run.result
        assert result is not None  # noqa: S101  (only finished runs are grouped)
        told = len(digests[spec.scene]) > 1
        scene = f"{spec.scene} ({spec.scene_digest[:4]})" if told else spec.scene
        if not math.isfinite(result.psnr):
            odd.append(f"{scene}, {spec.arm.label}, {spec.arm.strategy}, {spec.repeat}")
            continue
        variant = _variant(spec, with_maps=several_maps)
        variants[variant.label] = variant
        factors[scene] = min(spec.training.data_factor, factors.get(scene, 10**9))
        rows.append(
            {
                "strategy": spec.arm.strategy,
                "scene": scene,
                "seeds": variant.label,
                "repeat": spec.repeat,
                "key": spec.key,
                "digest": spec.scene_digest,
                "result": result,
                **_measures(result),
            }
        )
    same_size = len(set(factors.values())) == 1
    factor = next(iter(factors.values())) if same_size else dict(sorted(factors.items()))
    ordered = sorted(variants.values(), key=lambda each: each.order)
    columns = None if rows else ["strategy", "scene", "seeds", "repeat", "key", "digest", "result"]
    return Study(
        {**settings, "data_factor": factor},
        pd.DataFrame(rows, columns=columns),
        {each.label: each for each in ordered},
        {run.spec.key: run.spec for run in runs},
        tuple(odd),
    )


def _measures(result: RunResult) -> dict[str, float]:
    """What is compared and averaged; MB are 1,000,000 bytes."""
    scores = result.scores
    measures = {
        "psnr": scores.psnr,
        "covisible": scores.covisible_psnr,
        "share": scores.covisible_share,
        "ssim": scores.ssim,
        "lpips": scores.lpips,
        "num_seeds": result.num_seeds,
        "seeding": result.upsample_seconds,
        "training": result.train_seconds,
        "memory": result.peak_bytes and result.peak_bytes / 1e6,
        "gpu_memory": result.peak_gpu_bytes and result.peak_gpu_bytes / 1e6,
        "gaussians": result.num_gaussians,
        "model": (scores.model_bytes or 0) / 1e6,
        "render": 1e3 * scores.render_seconds,
    }
    return {name: math.nan if value is None else float(value) for name, value in measures.items()}


def _variant(spec: RunSpec, *, with_maps: bool) -> Variant:
    """The variant of a run; told by its depth maps if a scene has several sets of them."""
    if spec.arm.method == SFM:
        return Variant(SFM)
    # A plan asks every method that looks at photographs to hold out the test views.
    usual = [("hold_out", spec.training.test_every), ("cloud.hold_out", spec.training.test_every)]
    told = [each for each in sorted(spec.parameters.items()) if each not in usual]
    words = [f"{name}={value}" for name, value in told]
    if with_maps and spec.depth_digest:
        words.append(f"maps={spec.depth_digest[:4]}")
    return Variant(spec.arm.method, spec.arm.profile, spec.arm.ratio, tuple(words))
