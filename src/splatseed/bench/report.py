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
from pathlib import Path
from typing import Any, TypeAlias

import jinja2

from splatseed.bench import figures, pictures, study_tables
from splatseed.bench.comparisons import (
    ArmKey,
    ComparedArm,
    baseline_of,
    compared_arms,
    gains,
    rivals,
)
from splatseed.bench.plan import SFM
from splatseed.bench.plan_file import PLAN
from splatseed.bench.runs import Run, counts, read_calls, read_runs
from splatseed.bench.study import Study, studies
from splatseed.bench.tables import Number, Table, to_html, write_table
from splatseed.io.files import StrPath, read_text
from splatseed.io.staging import atomic_file, output_folder
from splatseed.progress import Progress, silent
from splatseed.text import counted

REPORT, TABLES = "report.html", "tables"
_KIND = "bench report"
_SHOWN = 0.005
"""The least gain in dB that does not read 0.00."""
_EQUAL = 0.01
"""Numbers of Gaussians that differ by no more than this share count as equal."""
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


def write_report(bench: StrPath, progress: Progress = silent) -> Report:
    """Write the report of a benchmark into its folder.

    Raises:
        SceneNotFoundError: There is no benchmark.
        OutputError: A file cannot be written.
    """
    bench = Path(bench)
    runs = read_runs(bench)
    found, page, notes = studies(runs), _Page(), dict[str, None]()
    said, summary, several = list[str](), list[Part](), len(found) > 1
    for number, study in enumerate(found, start=1):
        answers, name = answer(study), f"Set {number}" if several else "All runs"
        of = f"{name}: {study.description}."
        said += [of, *answers] if several else answers
        summary += [{"kind": "answer", "texts": answers}, _text(of, mark="note")]
    if several:
        apart = "Runs of different settings or versions are never compared: they are in sets."
        summary.insert(0, _text(apart, mark="note"))
    page.add("summary", "Summary", *summary)
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
    return Report(bench / REPORT, written, len(page.images), tuple(said), (*told, *notes))


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
        loader = jinja2.PackageLoader("splatseed.bench", "data")
        page = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html")
        title = f"Benchmark of {scenes}" if scenes else "Benchmark without runs"
        told = f"{question} {counts(runs)}."
        return page.render(title=title, subtitle=told, sections=self.sections) + "\n"


def unequal_numbers(study: Study) -> str | None:
    """A warning that the arms end with different numbers of Gaussians; None if they do not."""
    numbers = study.runs.groupby(["scene", "strategy", "seeds"])["gaussians"].mean()
    ends = numbers.groupby("scene").agg(["min", "max"])
    scene = (ends["max"] / ends["min"]).idxmax() if len(ends) else ""
    if not scene or ends["max"][scene] <= ends["min"][scene] * (1 + _EQUAL):
        return None
    hint = "" if study.settings["budget"] else ": --budgets bounds every arm alike"
    return (
        f"On {scene} the arms end with {ends['min'][scene]:,.0f} to {ends['max'][scene]:,.0f} "
        f"Gaussians, and more of them alone can bring a gain{hint}."
    )


def answer(study: Study) -> tuple[str, ...]:
    """The conclusions on a study, for a reader who has not seen the tables."""
    base = baseline_of(study)
    others = rivals(study)
    if base is None or not others:
        return (f"Nothing can be compared yet: runs of {SFM} are missing, or all others.",)
    best = others[0]
    at = " under one budget of Gaussians" if study.settings["budget"] else ""
    at = at if unequal_numbers(study) else " with equal numbers of Gaussians"
    first = f"{best.arm.label} comes out best: "
    if best.gain.mean < _SHOWN:
        first = f"nothing beats {base.label}: {best.arm.label} comes closest, "
    said = [f"On {counted(len(best.scenes), 'scene')}{at}, {first}{_against(best, base)}."]
    means = {e.arm: e.means for e in compared_arms(study) if e.scenes == best.scenes}
    if base in means:
        own, other = (means[arm]["seeding"] + means[arm]["training"] for arm in (best.arm, base))
        said[0] += (
            f" A run takes {own:.0f} s, seeding included, and {other:.0f} s with {base.label}."
        )
    own = best.arm.seeds == SFM
    rest = [each for each in others if (each.arm.seeds == SFM) != own]
    if rest:
        kind = "Of other seeds" if own else "Without new points"
        said.append(f"{kind}, {rest[0].arm.label} does best: {_against(rest[0], base)}.")
    lead, sooner = best.gains["in_time"], best.gains["seconds"]
    if lead is not None:
        place = f"{abs(lead.mean):.2f} dB {'ahead' if lead.mean > 0 else 'behind'}"
        place = place if abs(lead.mean) >= _SHOWN else "level with it"
        said.append(
            f"Once {base.label} is done, seeding included, {best.arm.label} is {place}"
            f"{_DOUBTS.get(lead.verdict, '')}."
        )
    if sooner is not None:
        share = math.exp(sooner.mean)
        time = f"{share:.0%} of the time" if share < 1 else f"{share:.2f} times the time"
        said.append(
            f"It reaches {base.label}'s final PSNR in {time} of {base.label}'s whole run, "
            f"seeding included{_DOUBTS.get(sooner.verdict, '')}."
        )
    elif best.reached < best.runs:
        said.append(f"{best.reached} of its {best.runs} runs reach {base.label}'s final PSNR.")
    for strategy in study.strategies:
        verdicts = [each.verdict for each in gains(study, strategy).on_these.values()]
        if verdicts and set(verdicts) != {"unknown"}:
            said.append(
                f"Beyond the noise of training again, {verdicts.count('better')} of "
                f"{counted(len(verdicts), 'variant')} under {strategy} are better than {SFM}, and "
                f"{verdicts.count('worse')} worse."
            )
    return tuple(said)


def _against(each: ComparedArm, base: ArmKey) -> str:
    gain, worst = each.gain, ""
    if len(each.on_scene) > 1:
        scene, least = next(iter(each.on_scene.items()))
        worst = f"; on {scene}, its worst scene, {_difference(least)}"
    if abs(gain.mean) < _SHOWN:
        return f"level with {base.label}{worst}"
    over = "scenes" if len(each.scenes) > 1 else "repeats"
    spread = "" if math.isnan(gain.se) else f" (± {gain.se:.2f} over {over})"
    doubt = _DOUBTS.get(gain.verdict, "")
    if gain.verdict == "within noise" and len(each.scenes) == 1:
        # The noise of all variants together, which the last sentences go by, may tell more.
        doubt = f", which these two arms' {each.runs} repeats alone do not confirm"
    return f"{_difference(gain.mean, spread)} than {base.label}{doubt}{worst}"


def _difference(gain: float, spread: str = "") -> str:
    return f"{abs(gain):.2f} dB{spread} {'less' if gain < 0 else 'more'}"


def _study_sections(
    study: Study, drawn: pictures.ScenePictures, bench: Path
) -> Iterator[tuple[str, str, Sequence[Part]]]:
    """A study's sections: key, title and parts. The page shows exactly what is written to files."""
    base, each, tables = baseline_of(study), study.strategies, study_tables
    seen: list[Part] = []
    if views := pictures.compared_views(study, bench):
        median = views.pop(len(views) // 2)  # of an even number the higher
        seen.append(_views(median))
        folded = {"kind": "folded", "title": "The other scenes, the lowest gain first"}
        seen.append({**folded, "parts": [_views(view) for view in views]})
    seen += [
        _figure(pictures.cloud_jpeg(png), f"{scene}: what training begins with.", "image/jpeg")
        for scene, (_, png) in drawn.clouds.items()
    ]
    yield "pictures", "Pictures", [*seen, _text(*drawn.notes, mark="note")]
    if base is not None:
        title = "At equal cost" if study.settings["budget"] else "All arms"
        yield "cost", title, [
            unequal_numbers(study), tables.arm_table(study), figures.arm_figure(study),
            tables.scene_arm_table(study, base), figures.seconds_figure(study),
            tables.seconds_table(study, base),
        ]  # fmt: skip
    yield "scores", "Scores", [tables.psnr_table(study, s) for s in each]
    gained: list[Part] = []
    for s in each:
        if gains(study, s).seeds:
            gained += [tables.gain_table(study, s), figures.scene_figure(study, s)]
    yield "gains", "Gains", gained
    yield "curves", "Curves", [figures.curve_figure(study, s) for s in each]
    yield "resources", "Time and memory", [tables.cost_table(study, s) for s in each]


def _run_parts(runs: Sequence[Run], found: Sequence[Study]) -> Iterator[Part]:
    yield f"{counts(runs)}."
    failed = [run for run in runs if run.error]
    missing = [run for run in runs if run.result is None and not run.error]
    for name, title, listed in (
        ("failed", "Failed runs", failed), ("missing", "Runs still missing", missing)
    ):  # fmt: skip
        rows = [
            (run.spec.scene.name, run.spec.arm.label, run.spec.arm.strategy,
             f"{run.spec.repeat + 1}", run.error)
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


def _figure(content: bytes, caption: str, kind: str = "image/png") -> Part:
    return {"kind": "figure", "url": _url(content, kind), "caption": caption}


def _url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(content).decode('ascii')}"


def _views(view: pictures.ComparedView) -> Part:
    """Pictures of one size stacked on each other, with a slider, and the error maps below."""
    base, best, _ = view.pictures
    caption = (
        f"{view.scene}, test view {view.name}: {base} on the left, {best} on the right "
        f"({Number(view.gain, signed=True)} dB over all test views of this scene)."
    )
    urls, errors = (
        {name: _url(content, "image/jpeg") for name, content in each.items()}
        for each in (view.pictures, view.errors)
    )
    shape = f"{view.shape:.4f}"
    return {"kind": "views", "shape": shape, "caption": caption, "urls": urls, "errors": errors}
