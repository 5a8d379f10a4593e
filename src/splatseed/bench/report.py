"""The report of a benchmark: the answer, tables and figures, and a page that holds all of them.

It can be made at any time, from whatever is done so far; what is missing or has failed is listed.
The page (``data/report.html``) needs no network and no other file, every text on it is escaped; an
earlier report is replaced as a whole. A gain is claimed only if it exceeds noise after adjusting.
"""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from statistics import fmean
from typing import Any, TypeAlias

import jinja2

from splatseed.bench import figures, pictures, study_tables
from splatseed.bench.comparisons import (
    ArmKey,
    ComparedArm,
    Gains,
    baseline_of,
    compared_arms,
    gains,
    paired_runs,
    speeds,
)
from splatseed.bench.guidelines import guideline_table, guidelines, winner_table
from splatseed.bench.plan import SFM
from splatseed.bench.plan_file import PLAN
from splatseed.bench.runs import Run, counts, read_calls, read_runs
from splatseed.bench.statistics import LEVEL, Difference
from splatseed.bench.study import Study, studies
from splatseed.bench.tables import Table, to_html, write_table
from splatseed.io.files import read_text
from splatseed.io.staging import atomic_file, output_folder
from splatseed.literal import counted
from splatseed.progress import Progress, silent
from splatseed.train.settings import StrategyName

REPORT, TABLES = "report.html", "tables"
_KIND = "bench report"
_SHOWN = 0.005
"""The least gain in dB that does not read 0.00."""
_LISTED = 200
"""Runs listed in a table; of a large plan that has just begun, nearly all are missing."""
_DOUBTS = {
    "within noise": ", which may be chance",
    "unknown": ", which a single run cannot confirm",
}
"""What follows a difference that is not shown, by verdict."""
Part: TypeAlias = Mapping[str, Any] | Table | figures.Plot | str | None


@dataclass(frozen=True)
class Report:
    """What was written: the page, how many tables and figures; the answer, and what is missing."""

    path: Path
    tables: int
    figures: int
    summary: tuple[str, ...]
    notes: tuple[str, ...]


def write_report(bench: Path, progress: Progress = silent) -> Report:
    """Write the report of a benchmark into its folder.

    Raises:
        SceneNotFoundError: There is no benchmark.
        OutputError: A file cannot be written.
    """
    runs = read_runs(bench)
    found, page, notes = studies(runs), _Page(), dict[str, None]()
    page.add("summary", "Summary", *_summary_parts(found))
    for number, study in enumerate(found, start=1):
        drawn = pictures.scene_pictures(bench, study, progress)
        progress("tables and figures", 0.0)
        page.prefix, page.title = ("", "") if number == 1 else (f"set{number}_", f"Set {number}: ")
        for key, title, parts in _study_sections(study, drawn, bench):
            page.add(key, title, *parts)
        page.images |= dict(drawn.clouds.values())
        notes |= dict.fromkeys(drawn.notes)
    progress("page", 0.0)
    page.prefix = page.title = ""
    written = len(page.tables)
    page.add("runs", "Runs", *_run_parts(runs, found))
    page.add("setup", "How it was run", *_setup_parts(bench, runs))
    with output_folder(bench / TABLES, kind=_KIND, overwrite=True) as partial:
        for table in page.tables[:written]:
            write_table(table, partial)
    with output_folder(bench / pictures.FIGURES, kind=_KIND, overwrite=True) as partial:
        for name, png in page.images.items():
            (partial / f"{name}.png").write_bytes(png)
    with atomic_file(bench / REPORT) as partial:
        partial.write_text(page.html(runs), "utf-8", errors="backslashreplace")
    left = f"Not all runs are done, and the rest can change what is said: {counts(runs)}."
    told = [left] if any(run.result is None for run in runs) else []
    said = tuple(_said(found)) or ("No run is done yet.",)
    return Report(bench / REPORT, written, len(page.images), said, (*told, *notes))


@dataclass
class _Page:
    """The sections of a page, and the tables and figures that it shows.

    ``prefix`` is before the names of what is added next, ``title`` before its headings.
    """

    prefix: str = ""
    title: str = ""
    sections: list[Mapping[str, Any]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    images: dict[str, bytes] = field(default_factory=dict)

    def add(self, key: str, title: str, *parts: Part) -> None:
        """Add a section, unless it has no parts."""
        shown = [self._shown(part) for part in parts if part]
        if shown:
            section = {"key": self.prefix + key, "title": self.title + title, "parts": shown}
            self.sections.append(section)

    def _shown(self, part: Part) -> Part:
        if isinstance(part, str):
            return _text(part)
        if isinstance(part, Table):
            self.tables.append(replace(part, name=self.prefix + part.name))
            return {"kind": "table", "table": self.tables[-1], "html": to_html(part)}
        if isinstance(part, figures.Plot):
            self.images[self.prefix + part.name] = part.png
            return _figure(part.png, part.caption)
        return part

    def html(self, runs: Sequence[Run]) -> str:
        scenes = ", ".join(dict.fromkeys(run.spec.scene.name for run in runs))
        question = "Does upsampling help on these scenes, by which method, at what cost?"
        data = files("splatseed.bench") / "data"
        page, style, script = (
            (data / f"report.{kind}").read_text("utf-8") for kind in ("html", "css", "js")
        )
        return (
            jinja2.Environment(autoescape=True, keep_trailing_newline=True)
            .from_string(page)
            .render(
                title=f"Benchmark of {scenes}" if scenes else "Benchmark without runs",
                subtitle=f"{question} {counts(runs)}.",
                sections=self.sections,
                style=style,
                script=script,
            )
        )


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
    if not numbers or max(numbers) <= min(numbers) * (1 + study_tables.EQUAL):
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


def _against(each: ComparedArm, base: ArmKey) -> str:
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
    known = [each.verdict for (_, of), each in gained.on_scene.items() if of == best]
    if len(known) < 2 or set(known) == {"unknown"}:
        return ""
    return (
        f"On single scenes {best} is better on {known.count('better')}, worse on "
        f"{known.count('worse')} and within noise on {known.count('within noise')} of {len(known)}."
    )


def _elsewhere(like: Difference) -> str:
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
    known = speeds(study, strategy)
    if best not in known.index:
        return text
    speed = known.loc[best]
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


def _study_sections(
    study: Study, drawn: pictures.ScenePictures, bench: Path
) -> Iterator[tuple[str, str, Sequence[Part]]]:
    """A study's sections: key, title and parts. The page shows exactly what is written to files."""
    each, tables = study.strategies, study_tables
    base = baseline_of(study)
    if base is not None and len(compared_arms(study)) > 1:
        title = "At equal cost" if study.settings["budget"] else "All arms"
        yield "cost", title, [
            unequal_numbers(study), tables.arm_table(study), figures.arm_figure(study),
            tables.scene_arm_table(study, base), figures.seconds_figure(study),
            tables.seconds_table(study, base),
        ]  # fmt: skip
    scores: list[Part] = []
    for s in each:
        scores += [*tables.psnr_tables(study, s), tables.quality_table(study, s)]
    yield "scores", "Scores", scores
    gained: list[Part] = []
    for s in each if study.seeded else ():
        gained += [tables.gain_table(study, s), figures.scene_figure(study, s)]
    nothing = "There is nothing to compare with yet: runs of sfm are missing, or all others."
    yield "gains", "Gains", [
        *gained, tables.mean_gain_table(study), figures.ratio_figure(study),
        tables.strategy_table(study), tables.equal_count_table(study),
    ] if gained else [nothing]  # fmt: skip
    for s in each:
        yield f"convergence_{s}", f"Convergence, strategy {s}", [
            figures.curve_figure(study, s, "steps"), figures.curve_figure(study, s, "seconds"),
            tables.convergence_table(study, s) if study.seeded_under(s) else None,
        ]  # fmt: skip
    yield "resources", "Time and memory", [tables.cost_table(study, s) for s in each]
    yield "pictures", "Pictures", [
        *(_figure(pictures.cloud_jpeg(png), f"{scene}: what training begins with.", "image/jpeg")
          for scene, (_, png) in drawn.clouds.items()),
        *(_folded(f"Test views, strategy {s}",
                  [_views(view) for view in pictures.compared_views(study, s, bench)],
                  is_open=i == 0) for i, s in enumerate(each)),
        _text(*drawn.notes, mark="note"),
    ]  # fmt: skip
    guided: list[Part] = []
    for s in each if study.seeded else ():
        known = gains(study, s)
        derived = guidelines(study, known, drawn.described)
        guided += [winner_table(known, drawn.described), guideline_table(derived, s)]
        guided.append(tables.advice_table(study, s) if study.settings["budget"] else None)
    yield "guidelines", "Guidelines", guided


def _summary_parts(found: Sequence[Study]) -> Iterator[Part]:
    """The answer, set by set where runs differ in more than what is compared."""
    if not found:
        yield _answer_block(["No run is done yet."])
    if len(found) > 1:
        said = "Runs of different settings or versions are never compared: they are in sets."
        yield _text(said, mark="note")
    for number, study in enumerate(found, start=1):
        name = f"Set {number}" if len(found) > 1 else "All runs"
        of_all = answer_at_equal_cost(study)
        yield _answer_block(of_all)
        yield _text(f"{name}: {study.description}.", mark="note")
        by_strategy = [_answer_block(summary(study, each)) for each in study.strategies]
        if of_all:
            yield _folded("Strategy by strategy", by_strategy, is_open=False)
        else:
            yield from by_strategy


def _run_parts(runs: Sequence[Run], found: Sequence[Study]) -> Iterator[Part]:
    yield f"{counts(runs)}."
    failed = [run for run in runs if run.error]
    missing = [run for run in runs if run.result is None and not run.error]
    for name, title, listed in (
        ("failed", "Failed runs", failed), ("missing", "Runs still missing", missing)
    ):  # fmt: skip
        rows = [
            (run.spec.scene.name, run.spec.arm.label, run.spec.arm.strategy, f"{run.spec.repeat}",
             run.error)
            for run in listed[:_LISTED]
        ]  # fmt: skip
        more = len(listed) - len(rows)
        header = ("scene", "method", "strategy", "repeat", "error")
        notes = (f"And {more:,} more.",) if more else ()
        if rows:
            yield Table(name, f"{title}: {len(listed):,}", header, rows, notes)
    odd = [name for study in found for name in study.not_finite]
    if odd:
        yield f"PSNR is not finite, so that these runs are in no mean: {'; '.join(odd)}."


def _setup_parts(bench: Path, runs: Sequence[Run]) -> Iterator[Part]:
    calls = read_calls(bench)
    commands = dict.fromkeys(str(each.get("command", "")) for each in calls)
    if commands:
        yield "The commands, in order:"
        yield {"kind": "preformatted", "text": "\n".join(commands)}
    devices = dict.fromkeys(run.result.device for run in runs if run.result is not None)
    facts: dict[str, Any] = {"trained on": ", ".join(devices), **(calls[-1] if calls else {})}
    facts.pop("command", None)
    for name, value in facts.items():
        if isinstance(value, Mapping):
            facts[name] = ", ".join(f"{key} {each}" for key, each in value.items())
    rows = [(name, str(value)) for name, value in facts.items() if value]
    if rows:
        yield Table("environment", "Environment", ("what", "found"), rows)
    with suppress(OSError, UnicodeDecodeError):
        plan = read_text(bench / PLAN)
        yield "The plan; save it as plan.toml and run splatseed bench --plan plan.toml:"
        yield {"kind": "preformatted", "text": plan}


def _text(*texts: str, mark: str = "") -> Part:
    """Paragraphs, of a class in the style sheet."""
    return {"kind": "text", "texts": texts, "mark": mark} if texts else None


def _answer_block(sentences: Sequence[str]) -> Part:
    return {"kind": "answer", "texts": sentences} if sentences else None


def _folded(title: str, parts: Sequence[Part], *, is_open: bool) -> Part:
    return {"kind": "folded", "title": title, "parts": parts, "open": is_open} if parts else None


def _figure(content: bytes, caption: str, kind: str = "image/png") -> Part:
    return {"kind": "figure", "url": _url(content, kind), "caption": caption}


def _url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(content).decode('ascii')}"


def _views(view: pictures.ComparedView) -> Part:
    """Pictures of one size stacked on each other, with a slider between any two of them."""
    chosen = "the best on this scene"
    if view.gain < _SHOWN:
        lost = "level with sfm" if view.gain > -_SHOWN else "though it loses"
        chosen = f"the best of the others on this scene, {lost}"
    caption = (
        f"{view.scene}, test view {view.name}: {view.best}, {chosen} ({view.gain:+.2f} dB over all "
        "its test views). Error maps: black is none, the brightest 0.25 or more."
    )
    urls = {name: _url(content, "image/jpeg") for name, content in view.pictures.items()}
    return {"kind": "views", "shape": f"{view.shape:.4f}", "caption": caption, "urls": urls}
