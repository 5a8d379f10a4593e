"""Studies: sets of finished runs that differ only in their seeds and so can be compared.

Notation: a *variant* is what makes the seeds (method, profile, ratio, parameters); a *study* holds
runs whose settings are equal in all but the variant, the strategy, the scene and the repeat; a
*cell* is what one variant gave on one scene under one strategy, by repeat. Promise: runs of
different settings or versions are never compared; a run whose PSNR is not finite is set aside and
counted, not averaged.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import get_args

from splatseed.bench.planning.records import SFM, SHARED, RunResult, RunRow, RunSpec
from splatseed.train.settings import StrategyName
from splatseed.upsample import METHODS

STRATEGIES: tuple[StrategyName, ...] = get_args(StrategyName)

Cell = Mapping[int, RunResult]
"""The results of one variant on one scene under one strategy, by repeat."""


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
    def order(self) -> tuple[int, str, str, float, tuple[str, ...]]:
        """Sorts variants: the baseline, then the methods in the registry's order."""
        names = [SFM, *METHODS]
        place = names.index(self.method) if self.method in names else len(names)
        return place, self.method, self.profile, self.ratio, self.parameters


BASELINE = Variant(SFM)


def variant_of(spec: RunSpec) -> Variant:
    """The variant of a run.

    Args:
        spec: The run's specification.
    """
    if spec.arm.method == SFM:
        return BASELINE
    # A plan asks every method that looks at photographs to hold out the test views.
    usual = [("hold_out", spec.training.test_every), ("cloud.hold_out", spec.training.test_every)]
    told = [each for each in sorted(spec.parameters.items()) if each not in usual]
    words = tuple(f"{name}={value}" for name, value in told)
    return Variant(spec.arm.method, spec.arm.profile, float(spec.arm.ratio), words)


@dataclass(frozen=True)
class Study:
    """Runs that can be compared.

    Args:
        settings: What they have in common: training settings by name, and the version.
        cells: By strategy, scene and variant.
        rows: The runs that the cells are made of, by scene.
        variant_of_key: The variant of each of these runs.
        not_finite: Finished runs whose PSNR is infinite or NaN.
    """

    settings: Mapping[str, object]
    cells: Mapping[tuple[StrategyName, str, Variant], Cell]
    rows: Mapping[str, tuple[RunRow, ...]]
    variant_of_key: Mapping[str, Variant]
    not_finite: tuple[str, ...] = ()

    @cached_property
    def strategies(self) -> tuple[StrategyName, ...]:
        """The strategies that have runs."""
        present = {strategy for strategy, _, _ in self.cells}
        return tuple(name for name in STRATEGIES if name in present)

    @cached_property
    def scenes(self) -> tuple[str, ...]:
        """All scenes, in alphabetical order."""
        return tuple(sorted({scene for _, scene, _ in self.cells}))

    @cached_property
    def variants(self) -> tuple[Variant, ...]:
        """All variants but the baseline, in the order of the methods."""
        present = {variant for _, _, variant in self.cells} - {BASELINE}
        return tuple(sorted(present, key=lambda each: each.order))

    def variants_of(self, strategy: StrategyName) -> tuple[Variant, ...]:
        """Those but the baseline that were run under a strategy."""
        present = {variant for used, _, variant in self.cells if used == strategy}
        return tuple(each for each in self.variants if each in present)

    def scenes_of(self, strategy: StrategyName) -> tuple[str, ...]:
        """Those that were run under a strategy."""
        present = {scene for used, scene, _ in self.cells if used == strategy}
        return tuple(each for each in self.scenes if each in present)

    def cell(self, strategy: StrategyName, scene: str, variant: Variant) -> Cell:
        """The results by repeat; empty where there are none."""
        return self.cells.get((strategy, scene, variant), {})

    def pairs(
        self, strategy: StrategyName, scene: str, variant: Variant
    ) -> tuple[tuple[RunResult, RunResult], ...]:
        """Baseline and variant of each repeat that has both."""
        base, other = (self.cell(strategy, scene, each) for each in (BASELINE, variant))
        return tuple((base[r], other[r]) for r in sorted(base.keys() & other.keys()))

    @property
    def description(self) -> str:
        """The settings in words."""
        told = self.settings
        factor = told["data_factor"]
        size = (
            ", ".join(f"{scene} {_size(each)}" for scene, each in factor.items())
            if isinstance(factor, Mapping)
            else f"photographs {_size(factor)}"
        )
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
            self._repeats,
        ]
        return ", ".join(word for word in words if word)

    def key(self, strategy: StrategyName, scene: str, variant: Variant, repeat: int) -> str | None:
        """The key of a run; None where there is none."""
        for row in self.rows.get(scene, ()):
            spec = row.spec
            if (spec.arm.strategy, self.variant_of_key[spec.key], spec.repeat) == (
                strategy, variant, repeat
            ):  # fmt: skip
                return spec.key
        return None

    @property
    def _repeats(self) -> str:
        """Fewest and most repeats of a cell, in words."""
        counts = sorted({len(cell) for cell in self.cells.values()})
        if not counts:
            return ""
        span = f"{counts[0]}" if len(counts) == 1 else f"{counts[0]} to {counts[-1]}"
        return f"{span} repeat{'' if counts[-1] == 1 else 's'}"


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


def studies(rows: Iterable[RunRow]) -> tuple[Study, ...]:
    """The studies in a ledger's rows; the one with the most runs first.

    Scenes may differ in size; only where one scene was run at several ``data_factor`` are these
    kept apart. If a scene's name stands for different content, its label says which.

    Args:
        rows: As the ledger has them; those not done are passed over.
    """
    groups: dict[tuple[tuple[str, object], ...], list[RunRow]] = defaultdict(list)
    for row in rows:
        if row.status == "done" and row.result is not None:
            groups[tuple(_common(row.spec).items())].append(row)
    grouped = [
        _study(dict(key), part) for key, group in groups.items() for part in _by_factor(group)
    ]
    return tuple(sorted(grouped, key=lambda study: -sum(map(len, study.cells.values()))))


def _common(spec: RunSpec) -> dict[str, object]:
    """What all runs of a study share; their size may differ from scene to scene."""
    settings = {name: getattr(spec.training, name) for name in SHARED if name != "data_factor"}
    if spec.arm.budget:  # in Gaussians it may differ from scene to scene
        settings["cap_max"] = None
    return {**settings, "budget": spec.arm.budget, "version": spec.version}


def _by_factor(rows: Sequence[RunRow]) -> list[list[RunRow]]:
    """The rows as one group, or one per ``data_factor`` where a scene has several."""
    factors: dict[str, set[int]] = defaultdict(set)
    groups: dict[int, list[RunRow]] = defaultdict(list)
    for row in rows:
        factors[row.spec.scene_digest].add(row.spec.training.data_factor)
        groups[row.spec.training.data_factor].append(row)
    several = any(len(each) > 1 for each in factors.values())
    return list(groups.values()) if several else [list(rows)]


def _study(settings: Mapping[str, object], rows: Sequence[RunRow]) -> Study:
    name, variant = _scene_labels(rows), _depth_variants(rows)
    cells: dict[tuple[StrategyName, str, Variant], dict[int, RunResult]] = defaultdict(dict)
    scenes: dict[str, list[RunRow]] = defaultdict(list)
    odd = []
    for row in rows:
        scene, result = name[row.spec.scene, row.spec.scene_digest], row.result
        if result is None or not math.isfinite(result.psnr):
            odd.append(f"{scene}, {row.spec.arm.label}, {row.spec.arm.strategy}, {row.spec.repeat}")
            continue
        cells[row.spec.arm.strategy, scene, variant[row.spec.key]][row.spec.repeat] = result
        scenes[scene].append(row)
    by_factor = {
        scene: {row.spec.training.data_factor for row in part} for scene, part in scenes.items()
    }
    factors = {scene: min(each) for scene, each in sorted(by_factor.items())}
    common = set(factors.values())
    told = {**settings, "data_factor": common.pop() if len(common) == 1 else factors}
    by_scene = {k: tuple(v) for k, v in scenes.items()}
    return Study(told, dict(cells), by_scene, variant, tuple(odd))


def _scene_labels(rows: Sequence[RunRow]) -> dict[tuple[str, str], str]:
    """Labels for scenes of a name and digest."""
    digests: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        digests[row.spec.scene].add(row.spec.scene_digest)
    return {
        (name, digest): name if len(known) == 1 else f"{name} ({digest[:4]})"
        for name, known in digests.items()
        for digest in known
    }


def _depth_variants(rows: Sequence[RunRow]) -> dict[str, Variant]:
    """The variant of each run's key; distinguished by depth maps if a scene has several sets."""
    maps: dict[str, set[str]] = defaultdict(set)
    for row in rows:
        maps[row.spec.scene_digest].add(row.spec.depth_digest)
    several = any(len(each - {""}) > 1 for each in maps.values())
    variants = {}
    for row in rows:
        variant, digest = variant_of(row.spec), row.spec.depth_digest
        if several and digest and variant != BASELINE:
            variant = replace(variant, parameters=(*variant.parameters, f"maps={digest[:4]}"))
        variants[row.spec.key] = variant
    return variants
