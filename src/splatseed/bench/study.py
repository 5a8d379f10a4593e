"""Studies: sets of finished runs that can be compared, as only seeds and strategies differ.

A *variant* is a way to make seeds (method, profile, ratio, parameters), named by a label such as
``mls 8x``. Runs with different settings or versions are in different studies. Runs with infinite or
NaN PSNR are listed, but are in no mean.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

import pandas as pd

from splatseed.bench.plan import SFM, SHARED, Arm, RunResult, RunSpec, describe_budget
from splatseed.bench.runs import BenchRun
from splatseed.methods import METHODS
from splatseed.training.settings import StrategyName, TrainSettings

_COLUMNS = ("strategy", "scene", "seeds", "repeat", "spec", "result")
_EXTRA_DIGESTS = {"maps": "depth_digest", "scan": "cloud_digest"}
"""Optional data of a scene, and the field of ``SceneFacts`` with its fingerprint."""
_DEFAULT = TrainSettings()
_SHOWN_SETTINGS = ("exposure", "placing")
"""Settings shown by name and value if they differ from the default."""


@dataclass(frozen=True, eq=False)
class Study:
    """Runs with the same training settings, budget and version.

    ``runs`` has a row per run, with the columns strategy, scene, seeds (the variant's label),
    repeat, spec, result, and those of ``_measures``, NaN if not measured. ``variants`` maps labels
    to an arm, the baseline first. ``not_finite`` describes the runs whose PSNR is not finite.
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
        """The scenes in alphabetical order."""
        return tuple(sorted(set(self.runs["scene"])))

    @property
    def seeded(self) -> tuple[str, ...]:
        """The labels of all variants but the baseline."""
        return tuple(label for label in self.variants if label != SFM)

    def family(self, label: str) -> str:
        """Drop the ratio from a variant's label."""
        arm = self.variants[label]
        return replace(arm, ratio=0.0).label + label.removeprefix(arm.label)

    @cached_property
    def _by_strategy(self) -> dict[str, pd.DataFrame]:
        return dict(tuple(self.runs.groupby("strategy")))

    def under(self, strategy: StrategyName) -> pd.DataFrame:
        """Select the runs of a strategy."""
        return self._by_strategy.get(strategy, self.runs[:0])

    def seeded_under(self, strategy: StrategyName) -> tuple[str, ...]:
        """The labels of a strategy's variants, without the baseline."""
        present = set(self.under(strategy)["seeds"])
        return tuple(label for label in self.seeded if label in present)

    def scenes_under(self, strategy: StrategyName) -> tuple[str, ...]:
        """The scenes of a strategy's runs."""
        return tuple(sorted(set(self.under(strategy)["scene"])))

    def results(self, strategy: StrategyName, scene: str, label: str) -> dict[int, RunResult]:
        """The results of a variant on a scene by repeat."""
        part = self.under(strategy)
        part = part[(part["scene"] == scene) & (part["seeds"] == label)].sort_values("repeat")
        return dict(zip(part["repeat"], part["result"], strict=True))

    def scores(self, strategy: StrategyName, scene: str) -> pd.DataFrame:
        """PSNR of a scene, a row per variant, the baseline first, and a column per repeat."""
        part = self.under(strategy)
        part = part[part["scene"] == scene]  # without duplicates, which pivot_table would average
        scores = part.pivot(index="seeds", columns="repeat", values="psnr")  # noqa: PD010
        return scores.reindex([SFM, *self.seeded_under(strategy)])

    @property
    def description(self) -> str:
        """The settings, for the reader of a report."""
        settings, factors = self.settings, self.settings["data_factor"]
        if not isinstance(factors, Mapping):
            factors = {"photographs": factors}
        sized: dict[str, list[str]] = defaultdict(list)
        for name, factor in factors.items():
            sized[f"1/{factor:g} of their" if factor != 1 else "full"].append(name)
        budget = str(settings["budget"])
        counts = self.runs.groupby(["strategy", "scene", "seeds"]).size()
        low, high = counts.min(), counts.max()
        repeats = f"{high}" if low == high else f"{low} to {high}"
        parts = [
            f"{settings['max_steps']:,} steps",
            *(f"{', '.join(names)} at {size} size" for size, names in sized.items()),
            f"test_every {settings['test_every']}",
            f"Gaussians: at most {settings['cap_max']:,}" if settings["cap_max"] else "",
            f"Gaussians: at most {describe_budget(budget)}" if budget else "",
            f"spherical harmonics of degree {settings['sh_degree']}"
            if settings["sh_degree"] != 3
            else "",
            "opacities reset" if settings["opacity_reset"] else "",
            *(
                name.replace("_", " ")
                for name in SHARED
                if name.startswith("seed_") and settings[name]
            ),
            *(
                f"{name} {settings[name]}"
                for name in _SHOWN_SETTINGS
                if settings[name] != getattr(_DEFAULT, name)
            ),
            f"backend {settings['backend']}",
            f"splatseed {settings['version']}" if settings["version"] else "",
            *sorted(
                {
                    f"{spec.arm.method} {spec.method_version}"
                    for spec in self.runs["spec"]
                    if spec.method_version
                }
            ),
            f"{repeats} repeat{'' if high == 1 else 's'}" if len(counts) else "",
        ]
        return ", ".join(filter(None, parts))


def _variant_order(variant: tuple[str, Arm]) -> tuple[object, ...]:
    """Sort key of variants: the baseline first, then methods in the order of the registry."""
    (label, arm), names = variant, [SFM, *METHODS]
    place = names.index(arm.method) if arm.method in names else len(names)
    return place, arm.method, arm.profile, arm.ratio, label


def studies(runs: Iterable[BenchRun]) -> tuple[Study, ...]:
    """Group finished runs into studies, the one with the most runs first.

    Different scenes may have different ``data_factor``; several for one scene make several studies.
    Scenes with the same name but different content get different labels; the same content under
    several names is one scene. Duplicate runs count once.
    """
    groups: dict[tuple[tuple[str, object], ...], list[BenchRun]] = defaultdict(list)
    for run in runs:
        if run.result is not None:
            groups[tuple(_shared_settings(run.spec).items())].append(run)
    grouped = []
    for key, group in groups.items():
        sizes = {(run.spec.scene.digest, run.spec.training.data_factor) for run in group}
        parts: dict[float, list[BenchRun]] = defaultdict(list)
        for run in group:  # by size if a scene has several
            by_size = len(sizes) > len({digest for digest, _ in sizes})
            parts[run.spec.training.factor if by_size else 0].append(run)
        grouped += [_study(dict(key), part) for part in parts.values()]
    return tuple(sorted(grouped, key=lambda study: -len(study.runs)))


def _shared_settings(spec: RunSpec) -> dict[str, object]:
    settings = {name: getattr(spec.training, name) for name in SHARED if name != "data_factor"}
    if spec.arm.budget:  # its number of Gaussians may differ between scenes
        settings["cap_max"] = None
    return {**settings, "budget": spec.arm.budget, "version": spec.version}


def _study(settings: Mapping[str, object], runs: Sequence[BenchRun]) -> Study:
    names: dict[str, str] = {}
    digests = defaultdict[str, set[str]](set)
    beside = {kind: defaultdict[str, set[str]](set) for kind in _EXTRA_DIGESTS}
    for of in (run.spec.scene for run in runs):
        digests[names.setdefault(of.digest, of.name)].add(of.digest)
        for kind, found in beside.items():
            found[of.digest].add(getattr(of, _EXTRA_DIGESTS[kind]))
    several = [kind for kind in beside if any(len(e - {""}) > 1 for e in beside[kind].values())]
    codes = defaultdict[str, set[str]](set)
    for run in runs:
        codes[run.spec.arm.label].add(run.spec.method_version)
    variants: dict[str, Arm] = {}
    factors: dict[str, float] = {}
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
        label = _label(spec, several, with_version=len(codes[arm.label]) > 1)
        variants.setdefault(label, arm)
        factors[scene] = min(spec.training.factor, factors.get(scene, 10**9))
        values: tuple[object, ...] = (arm.strategy, scene, label, spec.repeat, spec, result)
        rows.append({**dict(zip(_COLUMNS, values, strict=True)), **_measures(result)})
    sizes = set(factors.values())
    factor = sizes.pop() if len(sizes) == 1 else dict(sorted(factors.items()))
    frame = pd.DataFrame(rows, columns=None if rows else _COLUMNS)
    frame = frame.drop_duplicates(list(_COLUMNS[:4]), ignore_index=True)
    ordered = dict(sorted(variants.items(), key=_variant_order))
    return Study({**settings, "data_factor": factor}, frame, ordered, tuple(odd))


def _measures(result: RunResult) -> dict[str, float]:
    """The measures of a run that are compared and averaged; MB are 1,000,000 bytes."""
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


def _label(spec: RunSpec, several: Sequence[str], *, with_version: bool) -> str:
    """Label a variant; adds digests of depth maps or scans if a scene has ``several``.

    ``with_version``: there are runs with several versions of the method.
    """
    if spec.arm.method == SFM:
        return SFM
    # A plan sets these for every method that uses photographs.
    usual = [
        ("test_every", spec.training.test_every),
        ("cloud.test_every", spec.training.test_every),
    ]
    changed = [f"{k}={v}" for k, v in sorted(spec.parameters.items()) if (k, v) not in usual]
    digests = {kind: getattr(spec.scene, _EXTRA_DIGESTS[kind])[:4] for kind in several}
    changed += [f"{kind}={digest}" for kind, digest in digests.items() if digest]
    # Six digits of its fingerprint.
    changed += [f"code={spec.method_version[:-6] or 'unknown'}"] * with_version
    return " ".join([spec.arm.label, *changed])
