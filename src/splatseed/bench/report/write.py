"""The report of a benchmark: tables, figures, and a page that holds all of them.

Notation: ``BENCH/report.html``, ``BENCH/tables/NAME.{csv,md,tex}``, ``BENCH/figures/NAME.png``.
Promise: a report can be made at any time, from whatever is done so far, while runs continue; what
is missing or has failed is listed; the page opens without a network; an earlier report is replaced
as a whole.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import numpy as np

from splatseed.bench.analysis.arms.tables import SHOWN, answer_at_equal_cost
from splatseed.bench.analysis.study import Study, studies
from splatseed.bench.analysis.summary import summary
from splatseed.bench.analysis.tables import Table, write_table
from splatseed.bench.planning.records import RunRow
from splatseed.bench.report.html import (
    JPEG,
    Section,
    answer,
    figure,
    folded,
    page,
    paragraphs,
    slider,
)
from splatseed.bench.report.ledger_part import counts, ledger_sections
from splatseed.bench.report.pictures import CLOUDS, FIGURES, Pictures, scene_pictures
from splatseed.bench.report.study_part import StudyReport, study_report
from splatseed.bench.report.views import ComparedView, compared_views, jpeg
from splatseed.bench.running.folder import PLAN
from splatseed.bench.running.ledger import LEDGER, Ledger
from splatseed.io.files import read_text
from splatseed.io.staging import atomic_file, output_folder
from splatseed.progress import Progress, silent

REPORT = "report.html"
TABLES = "tables"
KIND = "bench report"
"""The kind recorded in the manifests of the folders of tables and figures."""
CLOUD_SIDE = 1800


@dataclass(frozen=True)
class Report:
    """What was written.

    Args:
        path: The page.
        tables: How many tables, each in three formats.
        figures: How many figures.
        summary: The answer, a sentence or two each.
        notes: What is missing or could not be shown, one sentence each.
    """

    path: Path
    tables: int
    figures: int
    summary: tuple[str, ...]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class _Part:
    """All that the report has of a study."""

    study: Study
    pictures: Pictures
    report: StudyReport

    @property
    def images(self) -> dict[str, bytes]:
        """PNG by name: figures and clouds."""
        plots = {plot.name: plot.png for plot in self.report.plots}
        return plots | {self.pictures.files[s]: png for s, png in self.pictures.clouds.items()}


def write_report(bench: Path, *, from_scenes: bool = True, progress: Progress = silent) -> Report:
    """Write the report of a benchmark into its folder.

    Args:
        bench: The folder.
        from_scenes: Whether scenes may be opened to describe them and to recompute and draw each
            method's seeds; results cached by an earlier report are used either way.
        progress: Told the stages.

    Raises:
        SceneNotFoundError: There is no ledger.
        SceneFormatError: It is not one that this version knows.
        OutputError: A file cannot be written.
    """
    ledger = Ledger.open(bench / LEDGER, read_only=True)
    rows, sessions = ledger.rows(), ledger.sessions()
    parts = []
    for number, study in enumerate(studies(rows), start=1):
        pictures = scene_pictures(bench, study, from_scenes=from_scenes, progress=progress)
        progress("tables and figures", 0.0)
        prefix, title = ("", "") if number == 1 else (f"set{number}_", f"Set {number}: ")
        parts.append(_Part(study, pictures, study_report(study, pictures.described, prefix, title)))
    progress("page", 0.0)
    said = _said(parts)
    sections = [
        *_summary_sections(parts, said),
        *(section for part in parts for section in _study_sections(part, bench)),
        *ledger_sections(rows, sessions, _plan(bench), [part.study for part in parts]),
    ]
    tables = [table for part in parts for table in part.report.tables]
    images = {name: png for part in parts for name, png in part.images.items()}
    _write_tables(bench / TABLES, tables)
    _write_figures(bench / FIGURES, images, [part.pictures for part in parts])
    with atomic_file(bench / REPORT) as partial:
        partial.write_text(_page(rows, sections), "utf-8", errors="backslashreplace")
    notes = list(dict.fromkeys(note for part in parts for note in part.pictures.notes))
    if any(row.status != "done" for row in rows):
        notes.insert(
            0, f"Not all runs are done, and the rest can change what is said: {counts(rows)}."
        )
    return Report(bench / REPORT, len(tables), len(images), said, tuple(notes))


def _page(rows: Sequence[RunRow], sections: Iterable[Section]) -> str:
    scenes = ", ".join(dict.fromkeys(row.spec.scene for row in rows))
    title = f"Benchmark of {scenes}" if scenes else "Benchmark without runs"
    question = "Does upsampling help on these scenes, by which method, at what cost?"
    return page(title, f"{question} {counts(rows)}.", sections)


def _said(parts: Sequence[_Part]) -> tuple[str, ...]:
    """The answers of all studies, each behind what its runs have in common if there are more."""
    told: list[str] = []
    for number, part in enumerate(parts, start=1):
        if len(parts) > 1:
            told.append(f"Set {number}: {part.study.description}.")
        told += _answers(part.study)
    return tuple(told) or ("No run is done yet.",)


def _answers(study: Study) -> Iterable[str]:
    """What a study says: of all arms together first, then strategy by strategy."""
    yield from answer_at_equal_cost(study)
    for strategy in study.strategies:
        yield from summary(study, strategy)


def _summary_sections(parts: Sequence[_Part], said: Sequence[str]) -> list[Section]:
    """The answer, set by set where runs differ in more than what is compared."""
    blocks = [] if parts else [answer(said)]
    if len(parts) > 1:
        note = "Runs of different settings or versions are never compared: they are in sets."
        blocks.append(paragraphs([note], "note"))
    for number, part in enumerate(parts, start=1):
        name = f"Set {number}" if len(parts) > 1 else "All runs"
        said_of_all = answer_at_equal_cost(part.study)
        blocks += [answer(said_of_all)] if said_of_all else []
        blocks.append(paragraphs([f"{name}: {part.study.description}."], "note"))
        by_strategy = [answer(summary(part.study, each)) for each in part.study.strategies]
        if said_of_all:
            by_strategy = [folded("Strategy by strategy", by_strategy, is_open=False)]
        blocks += by_strategy
    return [Section("summary", "Summary", blocks)]


def _study_sections(part: _Part, bench: Path) -> list[Section]:
    """The study's sections, with its pictures before the guidelines."""
    report = part.report
    blocks = [*_clouds(part), *_views(part, bench), *_notes(part.pictures)]
    pictures = Section(f"{report.prefix}pictures", f"{report.title}Pictures", blocks)
    return [*report.sections[:-1], pictures, report.sections[-1]]


def _clouds(part: _Part) -> Iterable[str]:
    from PIL import Image  # noqa: PLC0415  (slow to import)

    for scene, png in part.pictures.clouds.items():
        with Image.open(BytesIO(png)) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        yield figure(jpeg(pixels, CLOUD_SIDE), f"{scene}: what training begins with.", kind=JPEG)


def _views(part: _Part, bench: Path) -> Iterable[str]:
    for i, strategy in enumerate(part.study.strategies):
        views = compared_views(part.study, strategy, bench)
        blocks = [slider(_view_title(view), view.pictures, view.shape) for view in views]
        yield folded(f"Test views, strategy {strategy}", blocks, is_open=i == 0)


def _view_title(view: ComparedView) -> str:
    chosen = "the best on this scene"
    if view.gain < SHOWN:
        lost = "level with sfm" if view.gain > -SHOWN else "though it loses"
        chosen = f"the best of the others on this scene, {lost}"
    return (
        f"{view.scene}, test view {view.name}: {view.best.label}, {chosen} "
        f"({view.gain:+.2f} dB over all its test views). Error maps: black is none, the brightest "
        "0.25 or more."
    )


def _notes(pictures: Pictures) -> list[str]:
    return [paragraphs(pictures.notes, "note")] if pictures.notes else []


def _plan(bench: Path) -> str:
    with suppress(OSError, UnicodeDecodeError):
        return read_text(bench / PLAN)
    return ""


def _write_tables(folder: Path, tables: Iterable[Table]) -> None:
    with output_folder(folder, kind=KIND, overwrite=True) as partial:
        for table in tables:
            write_table(table, partial)


def _write_figures(folder: Path, images: Mapping[str, bytes], pictures: Sequence[Pictures]) -> None:
    keys = {name: key for each in pictures for name, key in each.keys.items()}
    with output_folder(folder, kind=KIND, overwrite=True) as partial:
        for name, png in images.items():
            (partial / f"{name}.png").write_bytes(png)
        (partial / CLOUDS).write_text(json.dumps(keys, indent=2) + "\n", "utf-8")
