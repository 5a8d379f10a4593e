"""Studies: sets of finished runs that differ only in their seeds and so can be compared.

A *variant* is what makes the seeds (method, profile, ratio, parameters), known by its label, such
as ``mls 8x``. Runs of different settings or versions are never compared; a run whose PSNR is not
finite is set aside and counted, not averaged.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import pandas as pd

from splatseed.bench.plan import SFM, SHARED, Arm, RunResult, RunSpec
from splatseed.bench.runs import Run
from splatseed.methods import METHODS
from splatseed.training.settings import StrategyName, TrainSettings

_COLUMNS = ("strategy", "scene", "seeds", "repeat", "spec", "result")
_BESIDE = {"maps": "depth_digest", "scan": "cloud_digest"}
"""What a scene can have beside its photographs, and its fingerprint in ``SceneFacts``."""
_DEFAULT = TrainSettings()
_NAMED = ("exposure", "placing")
"""Settings that are told by their names, where they are not the default."""


@dataclass(frozen=True, eq=False)
class Study:
    """Runs that can be compared: with the same training settings, budget and version.

    ``runs`` has a row for each, with the columns strategy, scene, seeds (the variant's label),
    repeat, spec, result, and those of ``_measures``, NaN where it was not measured; ``variants``
    one of each variant's arms by its label, in order, the baseline first. ``not_finite``: finished
    runs whose PSNR is infinite or NaN, in words.
    """

    settings: Mapping[str, object]
    runs: pd.DataFrame
    variants: Mapping[str, Arm]
    not_finite: tuple[str, ...] = ()

    @cached_property
    def strategies(self) -> tuple[StrategyName, ...]:
        """The strategies that have runs."""
        return tuple(name for name in get_args(StrategyName) if name in set(self.runs["strategy"]))

    @cached_property
    def scenes(self) -> tuple[str, ...]:
        """All scenes, in alphabetical order."""
        return tuple(sorted(set(self.runs["scene"])))

    @property
    def seeded(self) -> tuple[str, ...]:
        """The labels of all variants but the baseline."""
        return tuple(label for label in self.variants if label != SFM)

    def family(self, label: str) -> str:
        """A variant's label without the ratio: that of variants which differ in nothing else."""
        arm = self.variants[label]
        return replace(arm, ratio=0.0).label + label.removeprefix(arm.label)

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
        part = part[(part["scene"] == scene) & (part["seeds"] == label)].sort_values("repeat")
        return dict(zip(part["repeat"], part["result"], strict=True))

    def scores(self, strategy: StrategyName, scene: str) -> pd.DataFrame:
        """PSNR of a scene, [A, R]: a row per variant, the baseline first, NaN without a run."""
        part = self.under(strategy)
        scores = part[part["scene"] == scene].pivot_table(
            index="seeds", columns="repeat", values="psnr"
        )
        return scores.reindex([SFM, *self.seeded_under(strategy)])

    @property
    def description(self) -> str:
        """The settings in words."""
        told, factors = self.settings, self.settings["data_factor"]
        if not isinstance(factors, Mapping):
            factors = {"photographs": factors}
        sized: dict[str, list[str]] = defaultdict(list)
        for of, each in factors.items():
            sized[f"1/{each} of their" if each != 1 else "full"].append(of)
        budget, is_share = str(told["budget"]), str(told["budget"]).endswith("rho")
        share = f"{budget.removesuffix('rho')} for each pixel of a photograph"
        most = share if is_share else f"{int(budget or 0):,}"
        counts = self.runs.groupby(["strategy", "scene", "seeds"]).size()
        low, high = counts.min(), counts.max()
        repeats = f"{high}" if low == high else f"{low} to {high}"
        words = [
            f"{told['max_steps']:,} steps",
            *(f"{', '.join(names)} at {size} size" for size, names in sized.items()),
            f"one view in {told['test_every']} tested",
            f"Gaussians: at most {told['cap_max']:,}" if told["cap_max"] else "",
            f"Gaussians: at most {most}" if budget else "",
            f"spherical harmonics of degree {told['sh_degree']}" if told["sh_degree"] != 3 else "",
            "opacities reset" if told["opacity_reset"] else "",
            *(name.replace("_", " ") for name in SHARED if name.startswith("seed_") and told[name]),
            *(f"{name} {told[name]}" for name in _NAMED if told[name] != getattr(_DEFAULT, name)),
            f"backend {told['backend']}",
            f"splatseed {told['version']}" if told["version"] else "",
            f"{repeats} repeat{'' if high == 1 else 's'}" if len(counts) else "",
        ]
        return ", ".join(filter(None, words))


def variant_order(variant: tuple[str, Arm]) -> tuple[object, ...]:
    """Sorts variants with their labels: the baseline, then methods in the registry's order."""
    (label, arm), names = variant, [SFM, *METHODS]
    place = names.index(arm.method) if arm.method in names else len(names)
    return place, arm.method, arm.profile, arm.ratio, label


def studies(runs: Iterable[Run]) -> tuple[Study, ...]:
    """The studies in some runs, those that are finished; the one with the most runs first.

    Scenes may differ in size; only where one scene was run at several ``data_factor`` are these
    kept apart. If a scene's name stands for different content, its label says which; content that
    has had several names is one scene, and a run that is there twice counts once.
    """
    groups: dict[tuple[tuple[str, object], ...], list[Run]] = defaultdict(list)
    for run in runs:
        if run.result is not None:
            groups[tuple(_common(run.spec).items())].append(run)
    grouped = []
    for key, group in groups.items():
        sizes = {(run.spec.scene.digest, run.spec.training.data_factor) for run in group}
        parts: dict[int, list[Run]] = defaultdict(list)
        for run in group:  # apart where a scene has several sizes
            alone = len(sizes) > len({digest for digest, _ in sizes})
            parts[run.spec.training.factor if alone else 0].append(run)
        grouped += [_study(dict(key), part) for part in parts.values()]
    return tuple(sorted(grouped, key=lambda study: -len(study.runs)))


def _common(spec: RunSpec) -> dict[str, object]:
    """What all runs of a study share; their size may differ from scene to scene."""
    settings = {name: getattr(spec.training, name) for name in SHARED if name != "data_factor"}
    if spec.arm.budget:  # in Gaussians it may differ from scene to scene
        settings["cap_max"] = None
    return {**settings, "budget": spec.arm.budget, "version": spec.version}


def _study(settings: Mapping[str, object], runs: Sequence[Run]) -> Study:
    names: dict[str, str] = {}
    digests = defaultdict[str, set[str]](set)
    beside = {kind: defaultdict[str, set[str]](set) for kind in _BESIDE}
    for of in (run.spec.scene for run in runs):
        digests[names.setdefault(of.digest, of.name)].add(of.digest)
        for kind, found in beside.items():
            found[of.digest].add(getattr(of, _BESIDE[kind]))
    several = [kind for kind in beside if any(len(e - {""}) > 1 for e in beside[kind].values())]
    variants: dict[str, Arm] = {}
    factors: dict[str, int] = {}
    rows, odd = [], []
    for run in runs:
        spec, result = run.spec, run.result
        assert result is not None  # noqa: S101  (only finished runs are grouped)
        arm, of = spec.arm, spec.scene
        name = names[of.digest]
        scene = f"{name} ({of.digest[:4]})" if len(digests[name]) > 1 else name
        if not math.isfinite(result.psnr):
            odd.append(f"{scene}, {arm.label}, {arm.strategy}, repeat {spec.repeat + 1}")
            continue
        label = _label(spec, several)
        variants.setdefault(label, arm)
        factors[scene] = min(spec.training.factor, factors.get(scene, 10**9))
        told: tuple[object, ...] = (arm.strategy, scene, label, spec.repeat, spec, result)
        rows.append({**dict(zip(_COLUMNS, told, strict=True)), **_measures(result)})
    sizes = set(factors.values())
    factor = sizes.pop() if len(sizes) == 1 else dict(sorted(factors.items()))
    frame = pd.DataFrame(rows, columns=None if rows else _COLUMNS)
    frame = frame.drop_duplicates(list(_COLUMNS[:4]), ignore_index=True)
    ordered = dict(sorted(variants.items(), key=variant_order))
    return Study({**settings, "data_factor": factor}, frame, ordered, tuple(odd))


def _measures(result: RunResult) -> dict[str, float]:
    """What is compared and averaged; MB are 1,000,000 bytes."""
    scores = result.scores
    measures = {
        "psnr": scores.psnr,
        "cc_psnr": scores.cc_psnr,
        "covisible": scores.covisible_psnr,
        "share": scores.covisible_share,
        "ssim": scores.ssim,
        "flip": scores.flip,
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


def _label(spec: RunSpec, several: Sequence[str]) -> str:
    """A variant's label; it tells depth maps or scans apart where a scene has several."""
    if spec.arm.method == SFM:
        return SFM
    # A plan asks every method that looks at photographs to hold out the test views.
    usual = [
        ("test_every", spec.training.test_every),
        ("cloud.test_every", spec.training.test_every),
    ]
    told = [f"{k}={v}" for k, v in sorted(spec.parameters.items()) if (k, v) not in usual]
    digests = {kind: getattr(spec.scene, _BESIDE[kind])[:4] for kind in several}
    told += [f"{kind}={digest}" for kind, digest in digests.items() if digest]
    return " ".join([spec.arm.label, *told])
