"""A study's part of the report: its tables, its figures, and their place on the page.

Promise: the page shows exactly the tables and figures that are written to files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

from splatseed.bench.analysis.arms.advice import advice_table, score_advice
from splatseed.bench.analysis.arms.compared import compared_arms
from splatseed.bench.analysis.arms.tables import (
    arm_table,
    scene_arm_table,
    seconds_table,
    unequal_numbers,
)
from splatseed.bench.analysis.comparisons import equal_count_table, ratio_table, strategy_table
from splatseed.bench.analysis.convergence import convergence_table
from splatseed.bench.analysis.costs import cost_table, quality_table
from splatseed.bench.analysis.descriptors import Descriptors
from splatseed.bench.analysis.gains import gains
from splatseed.bench.analysis.guidelines import (
    FEWEST,
    guideline_table,
    guidelines,
    scene_table,
    verdict,
    winner_table,
)
from splatseed.bench.analysis.psnr_tables import gain_table, mean_gain_table, psnr_tables
from splatseed.bench.analysis.study import Study
from splatseed.bench.analysis.tables import Table
from splatseed.bench.report.drawing import Plot
from splatseed.bench.report.equal_cost_figures import arm_figure, seconds_figure
from splatseed.bench.report.figures import (
    curve_figure,
    ratio_figure,
    scene_figure,
    strategy_figure,
)
from splatseed.bench.report.html import Section, figure, paragraphs, table

NO_GAINS = "There is nothing to compare with yet: runs of sfm are missing, or all others."


@dataclass
class StudyReport:
    """What is reported of a study, in the order of the page.

    Args:
        prefix: Before the names of files and links; empty for the first study.
        title: Before the headings.
        tables: All tables.
        plots: All figures.
        sections: Where they stand.
    """

    prefix: str = ""
    title: str = ""
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    sections: list[Section] = field(default_factory=list)

    def add(self, key: str, title: str, parts: Iterable[Table | Plot | str | None]) -> None:
        """Add a section of tables, figures and paragraphs; None is passed over."""
        blocks = [self._block(part) for part in parts if part is not None]
        self.sections.append(Section(self.prefix + key, self.title + title, blocks))

    def _block(self, part: Table | Plot | str) -> str:
        if isinstance(part, str):
            return paragraphs([part])
        if isinstance(part, Table):
            self.tables.append(replace(part, name=self.prefix + part.name))
            return table(self.tables[-1])
        self.plots.append(part._replace(name=self.prefix + part.name))
        return figure(part.png, part.caption)


def study_report(
    study: Study, described: Mapping[str, Descriptors], prefix: str = "", title: str = ""
) -> StudyReport:
    """The tables and figures of a study.

    Args:
        study: The study.
        described: Descriptors of its scenes, as far as they are known.
        prefix: Before the names of files and links.
        title: Before the headings.
    """
    report = StudyReport(prefix, title)
    strategies = study.strategies
    title = "At equal cost" if study.settings["budget"] else "All arms"
    report.add("cost", title, _all_arms(study))
    report.add("scores", "Scores", _scores(study))
    if not study.variants:
        report.add("gains", "Gains", [NO_GAINS])
    else:
        _add_gains(report, study)
    report.add("convergence", "Convergence", _convergence(study))
    report.add("resources", "Time and memory", (cost_table(study, each) for each in strategies))
    report.add("guidelines", "Guidelines", _guidelines(study, described))
    return report


def _all_arms(study: Study) -> Iterable[Table | Plot | str | None]:
    """All arms beside one baseline, whatever their strategy."""
    if len(compared_arms(study)) > 1:
        yield unequal_numbers(study)
        yield arm_table(study)
        yield arm_figure(study)
        yield scene_arm_table(study)
        yield seconds_figure(study)
        yield seconds_table(study)


def _scores(study: Study) -> Iterable[Table]:
    for strategy in study.strategies:
        yield from psnr_tables(study, strategy)
        yield quality_table(study, strategy)


def _add_gains(report: StudyReport, study: Study) -> None:
    parts: list[Table | Plot | str | None] = []
    for strategy in study.strategies:
        parts += [gain_table(study, strategy), scene_figure(study, strategy)]
    report.add("gains", "Gains", [*parts, mean_gain_table(study)])
    report.add(
        "ratios",
        "By ratio, strategy and count",
        [
            ratio_figure(study),
            ratio_table(study) if any(each.ratio for each in study.variants) else None,
            strategy_figure(study),
            strategy_table(study),
            equal_count_table(study),
        ],
    )


def _convergence(study: Study) -> Iterable[Table | Plot | None]:
    for strategy in study.strategies:
        yield curve_figure(study, strategy, "steps")
        yield curve_figure(study, strategy, "seconds")
        if study.variants_of(strategy):
            yield convergence_table(study, strategy)


def _guidelines(study: Study, described: Mapping[str, Descriptors]) -> Iterable[Table | str]:
    for strategy in study.strategies if study.variants else ():
        gained = gains(study, strategy)
        derived = guidelines(gained, described)
        yield f"Strategy {strategy}: {verdict(derived)}"
        yield winner_table(gained, described)
        if derived:
            yield guideline_table(derived, strategy)
    if study.settings["budget"]:
        scores = [score_advice(study, strategy) for strategy in study.strategies]
        yield from (advice_table(each) for each in scores if len(each.scenes) >= FEWEST)
    if described:
        yield scene_table(described)
