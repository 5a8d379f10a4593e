"""The report of a benchmark: the answer, tables and figures, and a page that holds all of them.

Notation: it is ``BENCH/report.html``, ``tables/NAME.{csv,md,tex,html}``, ``figures/NAME.png``.
Promise: a report can be made at any time, from whatever is done so far, while runs continue; what
is missing or has failed is listed; the page needs no network and no other file, every text on it is
escaped, and it shows everything without its few lines of script; an earlier report is replaced as a
whole. A gain is claimed only if it exceeds noise after adjusting for the number of variants.
"""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from string import Template
from typing import Any

from splatseed.bench.comparisons import (
    Arm,
    ComparedArm,
    Gains,
    baseline_of,
    compared_arms,
    gains,
    paired_runs,
    speeds,
)
from splatseed.bench.figures import (
    Plot,
    arm_figure,
    curve_figure,
    ratio_figure,
    scene_figure,
    seconds_figure,
)
from splatseed.bench.guidelines import Descriptors, guideline_table, guidelines, winner_table
from splatseed.bench.pictures import (
    FIGURES,
    ComparedView,
    ScenePictures,
    cloud_jpeg,
    compared_views,
    scene_pictures,
)
from splatseed.bench.plan import SFM
from splatseed.bench.plan_file import PLAN
from splatseed.bench.runs import Run, counts, read_calls, read_runs
from splatseed.bench.statistics import LEVEL, Difference
from splatseed.bench.study import Study, studies
from splatseed.bench.study_tables import (
    EQUAL,
    advice_table,
    arm_table,
    convergence_table,
    cost_table,
    equal_count_table,
    gain_table,
    mean_gain_table,
    psnr_tables,
    quality_table,
    scene_arm_table,
    seconds_table,
    strategy_table,
)
from splatseed.bench.tables import Table, to_html, write_table
from splatseed.io.files import read_text
from splatseed.io.staging import atomic_file, output_folder
from splatseed.literal import counted
from splatseed.progress import Progress, silent
from splatseed.train.settings import StrategyName

REPORT, TABLES = "report.html", "tables"
_KIND = "bench report"
"""The kind recorded in the manifests of the folders of tables and figures."""
_SHOWN = 0.005
"""The least gain in dB that does not read 0.00."""
_LISTED = 200
"""Runs listed in a table; of a large plan that has just begun, nearly all are missing."""
_DOUBTS = {
    "within noise": ", which may be chance",
    "unknown": ", which a single run cannot confirm",
}
"""What follows a difference that is not shown, by verdict."""


@dataclass(frozen=True)
class Report:
    """What was written.

    Args:
        path: The page.
        tables: How many tables, each in four formats.
        figures: How many figures.
        summary: The answer, a sentence or two each.
        notes: What is missing or could not be shown, one sentence each.
    """

    path: Path
    tables: int
    figures: int
    summary: tuple[str, ...]
    notes: tuple[str, ...]


def write_report(bench: Path, progress: Progress = silent) -> Report:
    """Write the report of a benchmark into its folder.

    Scenes are opened to describe them and to draw each method's seeds, unless an earlier report has
    kept that.

    Args:
        bench: The folder.
        progress: Told the stages.

    Raises:
        SceneNotFoundError: There is no benchmark.
        OutputError: A file cannot be written.
    """
    runs = read_runs(bench)
    parts = []
    found = studies(runs)
    for number, study in enumerate(found, start=1):
        pictures = scene_pictures(bench, study, progress)
        progress("tables and figures", 0.0)
        prefix, title = ("", "") if number == 1 else (f"set{number}_", f"Set {number}: ")
        part = _Part(study, pictures, prefix, title)
        part.fill(bench)
        parts.append(part)
    progress("page", 0.0)
    sections = [_summary_section(found), *(each for part in parts for each in part.sections)]
    sections += [_run_section(runs, found), _setup_section(bench, runs)]
    tables = [table for part in parts for table in part.tables]
    with output_folder(bench / TABLES, kind=_KIND, overwrite=True) as partial:
        for table in tables:
            write_table(table, partial)
    images = {plot.name: plot.png for part in parts for plot in part.plots}
    images |= {name: png for part in parts for name, png in part.pictures.clouds.values()}
    with output_folder(bench / FIGURES, kind=_KIND, overwrite=True) as partial:
        for name, png in images.items():
            (partial / f"{name}.png").write_bytes(png)
    with atomic_file(bench / REPORT) as partial:
        partial.write_text(_page(runs, sections), "utf-8", errors="backslashreplace")
    notes = list(dict.fromkeys(note for part in parts for note in part.pictures.notes))
    if any(run.result is None for run in runs):
        notes.insert(0, f"Not all runs are done, and the rest can change what is said: "
                     f"{counts(runs)}.")  # fmt: skip
    said = tuple(_said(found)) or ("No run is done yet.",)
    return Report(bench / REPORT, len(tables), len(images), said, tuple(notes))


def _said(found: Sequence[Study]) -> Iterator[str]:
    """The answers of all studies, each behind what its runs have in common if there are more."""
    for number, study in enumerate(found, start=1):
        if len(found) > 1:
            yield f"Set {number}: {study.description}."
        yield from answer_at_equal_cost(study)
        for strategy in study.strategies:
            yield from summary(study, strategy)


def unequal_numbers(study: Study) -> str | None:
    """A warning that the arms end with different numbers of Gaussians; None if they do not."""
    numbers = [each.means["gaussians"] for each in compared_arms(study)]
    if not numbers or max(numbers) <= min(numbers) * (1 + EQUAL):
        return None
    hint = "" if study.settings["budget"] else ": --budgets bounds every arm alike"
    return (
        f"The arms end with {min(numbers):,.0f} to {max(numbers):,.0f} Gaussians, and more of them "
        f"alone can bring a gain{hint}."
    )


def answer_at_equal_cost(study: Study) -> tuple[str, ...]:
    """The conclusions on the arms, for a reader who has not seen the tables."""
    base = baseline_of(study)
    others = [each for each in compared_arms(study) if each.arm != base]
    if base is None or not others:
        return ()
    best = others[0]
    at = " under one budget of Gaussians" if study.settings["budget"] else ""
    at = at if unequal_numbers(study) else " with equal numbers of Gaussians"
    first = f"{best.arm.label} comes out best: "
    if best.gain.mean < _SHOWN:
        first = f"nothing beats {base.label}: {best.arm.label} comes closest, "
    said = [f"On {counted(len(best.scenes), 'scene')}{at}, {first}{_against(best, base)}."]
    own = best.arm.seeds == SFM
    rest = [each for each in others if (each.arm.seeds == SFM) != own]
    if rest:
        kind = "Of other seeds" if own else "Without new points"
        said.append(f"{kind}, {rest[0].arm.label} does best: {_against(rest[0], base)}.")
    lead, sooner = best.gains["in_time"], best.gains["sooner"]
    if lead is not None:
        place = "ahead" if lead.mean >= 0 else "behind"
        said.append(
            f"When {base.label} has finished, seeding counted, {best.arm.label} is "
            f"{abs(lead.mean):.2f} dB {place}{_DOUBTS.get(lead.verdict, '')}."
        )
    if sooner is not None:
        share = math.exp(sooner.mean)
        time = f"{share:.0%} of the time" if share < 1 else f"{share:.2f} times the time"
        said.append(
            f"It reaches {base.label}'s final PSNR after {time} of the whole run of {base.label}, "
            f"seeding counted{_DOUBTS.get(sooner.verdict, '')}."
        )
    elif best.reached < best.runs:
        said.append(f"{best.reached} of its {best.runs} runs reach {base.label}'s final PSNR.")
    return tuple(said)


def _against(each: ComparedArm, base: Arm) -> str:
    """A gain in words."""
    gain = each.gain
    if abs(gain.mean) < _SHOWN:
        return f"level with {base.label}"
    more = "more" if gain.mean > 0 else "less"
    over = "scenes" if len(each.scenes) > 1 else "repeats"
    spread = "" if math.isnan(gain.se) else f" (± {gain.se:.2f} over {over})"
    doubt = _DOUBTS.get(gain.verdict, "")
    if gain.verdict == "within noise" and len(each.scenes) == 1:
        # The noise of all variants together, which other sentences go by, may tell more.
        doubt = f", which these two arms' {each.runs} repeats alone do not confirm"
    return f"{abs(gain.mean):.2f} dB{spread} {more} than {base.label}{doubt}"


def summary(study: Study, strategy: StrategyName) -> tuple[str, ...]:
    """The conclusions on a strategy, a sentence or two each."""
    gained = gains(study, strategy)
    if not gained.seeds:
        return (f"Strategy {strategy}: nothing can be compared with {SFM} yet.",)
    best = max(gained.seeds, key=lambda each: gained.on_these[each].mean)
    told = (_answer(gained, best), _by_scene(gained, best), _elsewhere(gained.on_like[best]),
            _cost(study, strategy, best))  # fmt: skip
    return tuple(each for each in told if each)


def _answer(gained: Gains, best: str) -> str:
    """Whether any variant gains, and which gains most."""
    lead = f"Strategy {gained.strategy}, {counted(len(gained.scenes), 'scene')}:"
    top, of = gained.on_these[best], counted(len(gained.seeds), "variant")
    spread = "" if math.isnan(top.se) else f", ± {top.se:.2f} by the repeats of all variants"
    decibels = f"{top.mean:+.2f} dB{spread}"
    if top.verdict == "unknown":
        return (
            f"{lead} with one run of each nothing is known of the noise, so no gain can be claimed."
            f" The highest is that of {best}, {decibels}."
        )
    those = {kind: [each for each in gained.seeds if gained.on_these[each].verdict == kind]
             for kind in ("better", "worse")}  # fmt: skip
    worse = " and ".join(filter(None, [", ".join(those["worse"][:-1]), *those["worse"][-1:]]))
    loses = f" Beyond noise, {worse} lose{'s' * (len(those['worse']) == 1)}." if worse else ""
    if those["better"]:
        gain = f"yes, {len(those['better'])} of {of} gain more than noise"
        return f"{lead} {gain}, {best} most ({decibels}).{loses}"
    return (
        f"{lead} no gain beyond noise was found among {of}; the highest is that of {best}, "
        f"{decibels}.{loses}"
    )


def _by_scene(gained: Gains, best: str) -> str:
    """On how many scenes the best variant gains and loses."""
    known = [each.verdict for (_, of), each in gained.on_scene.items() if of == best]
    if len(known) < 2 or set(known) == {"unknown"}:
        return ""
    return (
        f"On single scenes {best} is better on {known.count('better')}, worse on "
        f"{known.count('worse')} and within noise on {known.count('within noise')} of {len(known)}."
    )


def _elsewhere(like: Difference) -> str:
    """Whether the gain can be expected on other scenes."""
    if like.verdict == "unknown":
        return "One scene says nothing about others."
    low, high = like.interval()
    span = f"95% interval {low:+.2f} to {high:+.2f} dB"
    if like.verdict == "within noise":
        return f"For scenes like these it is not shown to gain: {span} before adjusting."
    gain = "a gain" if like.mean > 0 else "a loss"
    return f"For scenes like these {gain} is shown too: {span}."


def _cost(study: Study, strategy: StrategyName, best: str) -> str:
    """What the best variant costs beside the baseline, and how soon it is as good."""
    part = study.under(strategy)
    pairs = paired_runs(study, part[part["seeds"] == best], strategy)

    def times(name: str) -> float:
        """Geometric mean over pairs of runs of how many times the baseline's measure it is."""
        both = zip(pairs[name], pairs[f"{name}_base"], strict=True)
        return math.exp(fmean(math.log(max(a, 1e-9) / max(b, 1e-9)) for a, b in both))

    text = (
        f"{best} costs {pairs['seeding'].mean():.1f} s of upsampling per scene, trains "
        f"{times('training'):.2f} times as long as {SFM} and ends with {times('gaussians'):.2f} "
        "times as many Gaussians."
    )
    speed = speeds(study, strategy).get(best)
    if speed is None:
        return text
    if speed.log_steps is None or speed.log_seconds is None:
        return f"{text} {speed.reached} of {speed.pairs} runs reach {SFM}'s final PSNR."
    both = {"steps": speed.log_steps, "seconds": speed.log_seconds}
    if not any(each.p <= LEVEL for each in both.values()):  # a single pair's NaN counts as unsure
        return f"{text} Whether it reaches {SFM}'s final PSNR sooner cannot be told from noise."
    share = " and ".join(
        f"{math.exp(each.mean):.0%} of the {unit}" + ("" if each.p <= LEVEL else " (may be chance)")
        for unit, each in both.items()
    )
    return f"{text} To reach {SFM}'s final PSNR it takes {share} that {SFM} takes."


@dataclass(frozen=True)
class _Section:
    """A part of the page: its anchor, heading, and HTML; left out without any."""

    key: str
    title: str
    blocks: Sequence[str]


@dataclass
class _Part:
    """A study's part of the report; the page shows exactly what is written to files.

    ``prefix`` is before the names of files and links, ``title`` before headings.
    """

    study: Study
    pictures: ScenePictures
    prefix: str = ""
    title: str = ""
    tables: list[Table] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)
    sections: list[_Section] = field(default_factory=list)

    def fill(self, bench: Path) -> None:
        """Make all tables, figures and sections."""
        study, each = self.study, self.study.strategies
        title = "At equal cost" if study.settings["budget"] else "All arms"
        if len(compared_arms(study)) > 1:
            arms = (arm_table(study), arm_figure(study), scene_arm_table(study))
            timed = (seconds_figure(study), seconds_table(study))
            self._add("cost", title, unequal_numbers(study), *arms, *timed)
        self._add("scores", "Scores", *(
            table for s in each for table in (*psnr_tables(study, s), quality_table(study, s))
        ))  # fmt: skip
        if study.seeded:
            parts = [made for s in each for made in (gain_table(study, s), scene_figure(study, s))]
            self._add("gains", "Gains", *parts, mean_gain_table(study), ratio_figure(study),
                      strategy_table(study), equal_count_table(study))  # fmt: skip
        else:
            self._add("gains", "Gains", "There is nothing to compare with yet: runs of sfm are "
                      "missing, or all others.")  # fmt: skip
        for s in each:
            self._add(f"convergence_{s}", f"Convergence, strategy {s}",
                      curve_figure(study, s, "steps"), curve_figure(study, s, "seconds"),
                      convergence_table(study, s) if study.seeded_under(s) else None)  # fmt: skip
        self._add("resources", "Time and memory", *(cost_table(study, s) for s in each))
        self._add_pictures(bench)
        self._add("guidelines", "Guidelines", *self._guidelines(self.pictures.described))

    def _guidelines(self, described: Mapping[str, Descriptors]) -> Iterator[Table | None]:
        for strategy in self.study.strategies if self.study.seeded else ():
            gained = gains(self.study, strategy)
            yield winner_table(gained, described)
            yield guideline_table(guidelines(self.study, gained, described), strategy)
            if self.study.settings["budget"]:
                yield advice_table(self.study, strategy)

    def _add(self, key: str, title: str, *parts: Table | Plot | str | None) -> None:
        blocks = []
        for part in parts:
            if isinstance(part, str):
                blocks.append(_paragraphs([part]))
            elif isinstance(part, Table):
                self.tables.append(replace(part, name=self.prefix + part.name))
                blocks.append(_table(self.tables[-1]))
            elif part is not None:
                self.plots.append(part._replace(name=self.prefix + part.name))
                blocks.append(_figure(part.png, part.caption))
        self.sections.append(_Section(self.prefix + key, self.title + title, blocks))

    def _add_pictures(self, bench: Path) -> None:
        blocks = [
            _figure(cloud_jpeg(png), f"{scene}: what training begins with.", "image/jpeg")
            for scene, (_, png) in self.pictures.clouds.items()
        ]
        for i, strategy in enumerate(self.study.strategies):
            sliders = [_slider(view) for view in compared_views(self.study, strategy, bench)]
            blocks.append(_folded(f"Test views, strategy {strategy}", sliders, is_open=i == 0))
        blocks.append(_paragraphs(self.pictures.notes, "note"))
        self.sections.append(_Section(f"{self.prefix}pictures", f"{self.title}Pictures", blocks))


def _summary_section(found: Sequence[Study]) -> _Section:
    """The answer, set by set where runs differ in more than what is compared."""
    blocks = [] if found else [_answer_block(["No run is done yet."])]
    if len(found) > 1:
        note = "Runs of different settings or versions are never compared: they are in sets."
        blocks.append(_paragraphs([note], "note"))
    for number, study in enumerate(found, start=1):
        name = f"Set {number}" if len(found) > 1 else "All runs"
        of_all = answer_at_equal_cost(study)
        blocks += [_answer_block(of_all)] if of_all else []
        blocks.append(_paragraphs([f"{name}: {study.description}."], "note"))
        by_strategy = [_answer_block(summary(study, each)) for each in study.strategies]
        if of_all:
            by_strategy = [_folded("Strategy by strategy", by_strategy, is_open=False)]
        blocks += by_strategy
    return _Section("summary", "Summary", blocks)


def _run_section(runs: Sequence[Run], found: Sequence[Study]) -> _Section:
    blocks = [_paragraphs([f"{counts(runs)}."])]
    kinds: tuple[tuple[str, str, Callable[[Run], bool]], ...] = (
        ("failed", "Failed runs", lambda run: bool(run.error)),
        ("missing", "Runs still missing", lambda run: run.result is None and not run.error),
    )
    for name, title, is_one in kinds:
        listed = [run for run in runs if is_one(run)]
        rows = [
            (run.spec.scene, run.spec.arm.label, run.spec.arm.strategy, f"{run.spec.repeat}",
             run.error)
            for run in listed[:_LISTED]
        ]  # fmt: skip
        if rows:
            more = len(listed) - len(rows)
            header = ("scene", "method", "strategy", "repeat", "error")
            notes = (f"And {more:,} more.",) if more else ()
            blocks.append(_table(Table(name, f"{title}: {len(listed):,}", header, rows, notes)))
    odd = [name for study in found for name in study.not_finite]
    if odd:
        said = f"PSNR is not finite, so that these runs are in no mean: {'; '.join(odd)}."
        blocks.append(_paragraphs([said]))
    return _Section("runs", "Runs", blocks)


def _setup_section(bench: Path, runs: Sequence[Run]) -> _Section:
    calls, blocks = read_calls(bench), []
    commands = dict.fromkeys(str(each.get("command", "")) for each in calls)
    if commands:
        blocks += [_paragraphs(["The commands, in order:"]), _preformatted("\n".join(commands))]
    devices = dict.fromkeys(run.result.device for run in runs if run.result is not None)
    facts: dict[str, Any] = {"trained on": ", ".join(devices)}
    facts |= {name: value for name, value in (calls[-1] if calls else {}).items()
              if name != "command"}  # fmt: skip
    rows = [(name, _fact(value)) for name, value in facts.items() if value]
    if rows:
        blocks.append(_table(Table("environment", "Environment", ("what", "found"), rows)))
    with suppress(OSError, UnicodeDecodeError):
        said = "The plan; save it as plan.toml and run splatseed bench --plan plan.toml:"
        blocks += [_paragraphs([said]), _preformatted(read_text(bench / PLAN))]
    return _Section("setup", "How it was run", blocks)


def _fact(value: object) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {each}" for key, each in value.items())
    return str(value)


def _page(runs: Sequence[Run], sections: Iterable[_Section]) -> str:
    shown = [section for section in sections if any(section.blocks)]
    scenes = ", ".join(dict.fromkeys(run.spec.scene for run in runs))
    question = "Does upsampling help on these scenes, by which method, at what cost?"
    resources = files("splatseed.bench") / "data"
    body = "".join(
        f'<section id="{escape(s.key)}"><h2>{escape(s.title)}</h2>{"".join(s.blocks)}</section>'
        for s in shown
    )
    return Template((resources / "report.html").read_text("utf-8")).substitute(
        title=escape(f"Benchmark of {scenes}" if scenes else "Benchmark without runs"),
        subtitle=escape(f"{question} {counts(runs)}."),
        links="".join(f'<a href="#{escape(s.key)}">{escape(s.title)}</a>' for s in shown),
        body=body,
        style=(resources / "report.css").read_text("utf-8"),
        script=(resources / "report.js").read_text("utf-8"),
    )


def _paragraphs(texts: Iterable[str], kind: str = "") -> str:
    """Paragraphs of plain text, of a class in the style sheet."""
    mark = f' class="{escape(kind)}"' if kind else ""
    return "".join(f"<p{mark}>{escape(text)}</p>" for text in texts)


def _answer_block(sentences: Sequence[str]) -> str:
    """The sentences of an answer, the first of them the answer itself."""
    lead, rest = _paragraphs(sentences[:1], "lead"), _paragraphs(sentences[1:])
    return f'<div class="answer">{lead}{rest}</div>'


def _preformatted(text: str) -> str:
    """Text as it is, such as a command, that scrolls where it is wide."""
    return f'<pre tabindex="0">{escape(text)}</pre>'


def _table(content: Table) -> str:
    """A table that scrolls sideways where it is wide, with its notes folded below."""
    inner = f'<div class="scroll" tabindex="0">{to_html(content)}</div>'
    if not content.rows:
        inner = _paragraphs(["None.", *content.notes[:1]])
    notes = _paragraphs(content.notes)
    folded = f"<details><summary>How to read this</summary>{notes}</details>" if notes else ""
    title = f"<h3>{escape(content.title)}</h3>"
    return f'<div class="table" id="table-{escape(content.name)}">{title}{inner}{folded}</div>'


def _image(content: bytes, alt: str, kind: str) -> str:
    data = f"data:{kind};base64,{b64encode(content).decode('ascii')}"
    return f'<img src="{data}" alt="{escape(alt)}">'


def _figure(content: bytes, caption: str, kind: str = "image/png") -> str:
    """A picture with its caption, that scrolls where it is wider than the page."""
    return (
        f'<figure><div class="scroll paper" tabindex="0">{_image(content, caption, kind)}</div>'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def _folded(title: str, blocks: Sequence[str], *, is_open: bool) -> str:
    """Blocks under a title that opens and closes; nothing without blocks."""
    if not blocks:
        return ""
    summary = f"<summary>{escape(title)}</summary>"
    return f'<details class="fold"{" open" * is_open}>{summary}{"".join(blocks)}</details>'


def _slider(view: ComparedView) -> str:
    """Pictures of one size stacked on each other, with a slider between any two of them."""
    chosen = "the best on this scene"
    if view.gain < _SHOWN:
        lost = "level with sfm" if view.gain > -_SHOWN else "though it loses"
        chosen = f"the best of the others on this scene, {lost}"
    title = (
        f"{view.scene}, test view {view.name}: {view.best}, {chosen} ({view.gain:+.2f} dB over all "
        "its test views). Error maps: black is none, the brightest 0.25 or more."
    )
    images = "".join(
        _image(content, f"{name}, {title}", "image/jpeg") for name, content in view.pictures.items()
    )
    choices = "".join(f"<option>{escape(name)}</option>" for name in view.pictures)
    return (
        f'<figure class="compare" style="--shape: {view.shape:.4f}">'
        f"<figcaption>{escape(title)}</figcaption>"
        f'<div class="stage">{images}</div>'
        '<input type="range" min="0" max="100" value="50" aria-label="where the two meet">'
        f'<div class="choices"><label>left <select data-side="left">{choices}</select></label>'
        f'<label>right <select data-side="right">{choices}</select></label></div></figure>'
    )
