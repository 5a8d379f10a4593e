"""Write the report of a benchmark: conclusions, tables, figures, and an HTML page with all of them.

A report covers the finished runs, and lists missing and failed ones. The page (from
``data/report.html``) needs no network and no other file. A gain is claimed only if it is
significant after adjustment for multiple comparisons.
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
from splatseed.bench.runs import BenchRun, count_runs, read_calls, read_runs
from splatseed.bench.study import Study, studies
from splatseed.bench.tables import Number, Table, to_html, write_table
from splatseed.findings import Finding
from splatseed.io.files import StrPath, read_text
from splatseed.io.staging import atomic_file, output_folder
from splatseed.progress import Progress, silent
from splatseed.text import counted

REPORT, TABLES = "report.html", "tables"
_KIND = "bench report"
_MIN_GAIN = 0.005
"""Minimum gain in dB that does not round to 0.00."""
_EQUAL = 0.01
"""Maximum relative difference of numbers of Gaussians that count as equal."""
_MAX_LISTED = 200
"""Maximum runs in a table of missing or failed runs."""
Part: TypeAlias = Mapping[str, Any] | Table | figures.Plot | str | None


@dataclass(frozen=True)
class Report:
    """The page, numbers of tables and figures, conclusions, and findings on what is missing."""

    path: Path
    tables: int
    figures: int
    summary: tuple[str, ...]
    findings: tuple[Finding, ...]


def write_report(bench: StrPath, progress: Progress = silent) -> Report:
    """Write the report of a benchmark into its folder; replaces an earlier one.

    Raises:
        SceneNotFoundError: There is no benchmark.
    """
    bench = Path(bench)
    runs = read_runs(bench)
    found, page, findings = studies(runs), _Page(), dict[Finding, None]()
    conclusions, summary, several = list[str](), list[Part](), len(found) > 1
    for number, study in enumerate(found, start=1):
        answers, name = conclude(study), f"Set {number}" if several else "All runs"
        settings = f"{name}: {study.description}."
        conclusions += [settings, *answers] if several else answers
        summary += [{"kind": "answer", "texts": answers}, _text(settings, mark="note")]
    if several:
        note = "Runs with different settings or versions are not compared; they form sets."
        summary.insert(0, _text(note, mark="note"))
    page.add("summary", "Summary", *summary)
    for number, study in enumerate(found, start=1):
        drawn = pictures.scene_pictures(bench, study, progress)
        progress("tables and figures", 0.0)
        page.prefix, page.title = ("", "") if number == 1 else (f"set{number}_", f"Set {number}: ")
        for key, title, parts in _study_sections(study, drawn, bench):
            page.add(key, title, *parts)
        page.images |= dict(drawn.clouds.values())
        findings |= dict.fromkeys(drawn.findings)
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
    if any(run.result is None for run in runs):
        text = f"Not all runs are finished; the conclusions may change: {count_runs(runs)}."
        findings = {Finding("unfinished-runs", text): None, **findings}
    return Report(bench / REPORT, written, len(page.images), tuple(conclusions), tuple(findings))


@dataclass
class _Page:
    """The sections of a page, with their tables and figures.

    ``prefix`` and ``title`` precede the names and the headings of later additions.
    """

    prefix: str = ""
    title: str = ""
    sections: list[Mapping[str, Any]] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    images: dict[str, bytes] = field(default_factory=dict)

    def add(self, key: str, title: str, *parts: Part) -> None:
        """Add a section, unless it has no parts."""
        blocks = [self._block(part) for part in parts if part]
        if blocks:
            section = {"key": self.prefix + key, "title": self.title + title, "parts": blocks}
            self.sections.append(section)

    def _block(self, part: Part) -> Part:
        if isinstance(part, str):
            return _text(part)
        if isinstance(part, Table):
            self.tables.append(replace(part, name=self.prefix + part.name))
            return {"kind": "table", "table": self.tables[-1], "html": to_html(part)}
        if isinstance(part, figures.Plot):
            self.images[self.prefix + part.name] = part.png
            return _figure(part.png, part.caption)
        return part

    def html(self, runs: Sequence[BenchRun]) -> str:
        scenes = ", ".join(dict.fromkeys(run.spec.scene.name for run in runs))
        question = "Which seeds help on these scenes, and at what cost?"
        loader = jinja2.PackageLoader("splatseed.bench", "data")
        page = jinja2.Environment(loader=loader, autoescape=True).get_template("report.html")
        title = f"Benchmark of {scenes}" if scenes else "Benchmark without runs"
        subtitle = f"{question} {count_runs(runs)}."
        return page.render(title=title, subtitle=subtitle, sections=self.sections) + "\n"


def unequal_numbers(study: Study) -> str | None:
    """Warn if the arms end with different numbers of Gaussians; else return None."""
    numbers = study.runs.groupby(["scene", "strategy", "seeds"])["gaussians"].mean()
    ends = numbers.groupby("scene").agg(["min", "max"])
    scene = (ends["max"] / ends["min"]).idxmax() if len(ends) else ""
    if not scene or ends["max"][scene] <= ends["min"][scene] * (1 + _EQUAL):
        return None
    hint = "" if study.settings["budget"] else "; the option budgets gives all arms the same limit"
    return (
        f"On {scene} the arms end with {ends['min'][scene]:,.0f} to {ends['max'][scene]:,.0f} "
        f"Gaussians, and a larger number alone can raise PSNR{hint}."
    )


def conclude(study: Study) -> tuple[str, ...]:
    """State the conclusions of a study for a reader who has not seen the tables."""
    base = baseline_of(study)
    others = rivals(study)
    if base is None or not others:
        return (f"There is no comparison yet: it needs runs of {SFM} and of another arm.",)
    best, compared = others[0], {arm.arm: arm for arm in compared_arms(study)}
    at = " under one budget of Gaussians" if study.settings["budget"] else ""
    at = at if unequal_numbers(study) else " with equal numbers of Gaussians"
    equal: ComparedArm | None = None
    first = f"{_place(best)}: "
    if best.gain.mean < _MIN_GAIN:
        first = f"no arm beats {base.label}: {best.arm.label} is closest, "
    conclusions = [f"On {counted(len(best.scenes), 'scene')}{at}, {first}{_against(best, base)}."]
    if compared[base].scenes == best.scenes:
        own, other = (each.means["seeding"] + each.means["training"] for each in
                      (best, compared[base]))  # fmt: skip
        conclusions[0] += (
            f" A run takes {own:.0f} s, seeding included, against {other:.0f} s of {base.label}."
        )
        equal = _best_at_equal_numbers(others, compared[base])
        conclusions += _at_equal_numbers(best, equal, compared[base])
    from_sfm = best.arm.seeds == SFM
    rest = [arm for arm in others if (arm.arm.seeds == SFM) != from_sfm]
    if rest and rest[0] is not equal:
        kind = "Of arms with other seeds" if from_sfm else "Of arms without new points"
        conclusions.append(f"{kind}, {_place(rest[0])}: {_against(rest[0], base)}.")
    lead, time_ratio = best.gains["in_time"], best.gains["seconds"]
    if lead is not None:
        position = f"{abs(lead.mean):.2f} dB {'ahead' if lead.mean > 0 else 'behind'}"
        position = position if abs(lead.mean) >= _MIN_GAIN else "level with it"
        conclusions.append(
            f"When {base.label} ends, seeding included, {best.arm.label} is {position}"
            f"{lead.caveat}."
        )
    if time_ratio is not None:
        share = math.exp(time_ratio.mean)
        time = f"{share:.0%} of" if share < 1 else f"{share:.2f} times"
        conclusions.append(
            f"It reaches the final PSNR of {base.label} in {time} the time of {base.label}, "
            f"seeding included{time_ratio.caveat}."
        )
    elif best.reached < best.runs:
        conclusions.append(
            f"{best.reached} of its {best.runs} runs reach the final PSNR of {base.label}."
        )
    return *conclusions, *_beyond_noise(study)


def _beyond_noise(study: Study) -> Iterator[str]:
    """State how many variants gain on these scenes, by strategy."""
    on = " on these scenes" if len(study.scenes) > 1 else ""
    for strategy in study.strategies:
        verdicts = [gain.verdict for gain in gains(study, strategy).on_these.values()]
        few = verdicts.count("too few to tell")
        if few < len(verdicts):
            yield (
                f"Beyond the noise between repeats{on}, {verdicts.count('better')} of "
                f"{counted(len(verdicts), 'variant')} under {strategy} are better than {SFM}, and "
                f"{verdicts.count('worse')} worse"
                f"{f'; there are too few repeats to tell of {few}' if few else ''}."
            )


def _best_at_equal_numbers(others: Sequence[ComparedArm], base: ComparedArm) -> ComparedArm | None:
    """Return the best arm with no more Gaussians than the baseline, if there is one."""
    limit = base.means["gaussians"] * (1 + _EQUAL)
    return next((arm for arm in others if arm.means["gaussians"] <= limit), None)


def _at_equal_numbers(
    best: ComparedArm, equal: ComparedArm | None, base: ComparedArm
) -> Iterator[str]:
    """State the numbers of Gaussians where the best arm has more, and the best without more."""
    if best is equal:
        return
    label, number = base.arm.label, best.means["gaussians"]
    yield (
        f"{best.arm.label} ends with {number:,.0f} Gaussians, {label} with "
        f"{base.means['gaussians']:,.0f}: the larger number alone can raise PSNR."
    )
    if equal is None:
        budget = f"{base.means['gaussians']:.0f}"
        how = f"; splatseed bench --budgets {budget}, its other options as here, does"
        yield (
            f"No other arm ends with as few Gaussians as {label}, so these runs do not tell what "
            f"equal numbers give{'' if base.arm.strategy.startswith('none') else how}."
        )
    else:
        yield (
            f"Of arms with no more Gaussians than {label}, {_place(equal)}: "
            f"{_against(equal, base.arm)}."
        )


def _place(arm: ComparedArm) -> str:
    """State that an arm, which has the highest mean gain of some, is best if that is certain."""
    return (
        f"{arm.arm.label} {'is best' if arm.gain.verdict == 'better' else 'has the highest mean'}"
    )


def _against(arm: ComparedArm, base: ArmKey) -> str:
    gain, worst = arm.gain, ""
    if len(arm.on_scene) > 1:
        scene, minimum = next(iter(arm.on_scene.items()))
        worst = f"; on {scene}, its worst scene, {_difference(minimum.mean)}{minimum.caveat}"
    if abs(gain.mean) < _MIN_GAIN:
        return f"level with {base.label}{worst}"
    spread = "" if math.isnan(gain.se) else f" (± {gain.se:.2f} over {gain.unit}s)"
    return f"{_difference(gain.mean, spread)} than {base.label}{gain.caveat}{worst}"


def _difference(gain: float, spread: str = "") -> str:
    return f"{abs(gain):.2f} dB{spread} {'less' if gain < 0 else 'more'}"


def _study_sections(
    study: Study, drawn: pictures.ScenePictures, bench: Path
) -> Iterator[tuple[str, str, Sequence[Part]]]:
    """Yield the sections of a study: key, title and parts."""
    base, strategies, tables = baseline_of(study), study.strategies, study_tables
    shown: list[Part] = []
    if views := pictures.compared_views(study, bench):
        median = views.pop(len(views) // 2)  # of an even number the higher
        shown.append(_views(median))
        folded = {"kind": "folded", "title": "The other scenes, in order of gain"}
        shown.append({**folded, "parts": [_views(view) for view in views]})
    shown += [
        _figure(
            pictures.cloud_jpeg(png),
            f"{scene}: the points from which training starts.",
            "image/jpeg",
        )
        for scene, (_, png) in drawn.clouds.items()
    ]
    yield "pictures", "Pictures", [*shown, _text(*map(str, drawn.findings), mark="note")]
    if base is not None:
        title = "At equal cost" if study.settings["budget"] else "All arms"
        yield "cost", title, [
            unequal_numbers(study), tables.arm_table(study), figures.arm_figure(study),
            tables.scene_arm_table(study, base), figures.seconds_figure(study),
            tables.seconds_table(study, base),
        ]  # fmt: skip
    yield "scores", "Scores", [tables.psnr_table(study, s) for s in strategies]
    gained: list[Part] = []
    for s in strategies:
        if gains(study, s).seeds:
            gained += [tables.gain_table(study, s), figures.scene_figure(study, s)]
    yield "gains", "Gains", gained
    yield "curves", "Curves", [figures.curve_figure(study, s) for s in strategies]
    yield "resources", "Time and memory", [tables.cost_table(study, s) for s in strategies]


def _run_parts(runs: Sequence[BenchRun], found: Sequence[Study]) -> Iterator[Part]:
    yield f"{count_runs(runs)}."
    failed = [run for run in runs if run.error]
    missing = [run for run in runs if run.result is None and not run.error]
    for name, title, listed in (
        ("failed", "Failed runs", failed), ("missing", "Missing runs", missing)
    ):  # fmt: skip
        rows = [
            (run.spec.scene.name, run.spec.arm.label, run.spec.arm.strategy,
             f"{run.spec.repeat + 1}", run.error)
            for run in listed[:_MAX_LISTED]
        ]  # fmt: skip
        more = len(listed) - len(rows)
        header = ("scene", "method", "strategy", "repeat", "error")
        notes = (f"And {more:,} more.",) if more else ()
        if rows:
            yield Table(name, f"{title}: {len(listed):,}", header, rows, notes)
    invalid = [name for study in found for name in study.not_finite]
    if invalid:
        yield f"These runs are in no mean, as their PSNR is not finite: {'; '.join(invalid)}."


def _setup_parts(bench: Path, runs: Sequence[BenchRun]) -> Iterator[Part]:
    calls = read_calls(bench)
    commands = dict.fromkeys(str(call.get("command", "")) for call in calls)
    if commands:
        yield "The commands, in order:"
        yield {"kind": "preformatted", "text": "\n".join(commands)}
    devices = dict.fromkeys(run.result.device for run in runs if run.result is not None)
    facts: dict[str, Any] = {"trained on": ", ".join(devices), **(calls[-1] if calls else {})}
    facts.pop("command", None)
    for name, value in facts.items():
        if isinstance(value, Mapping):
            facts[name] = ", ".join(f"{key} {part}" for key, part in value.items())
    rows = [(name, str(value)) for name, value in facts.items() if value]
    if rows:
        yield Table("environment", "Environment", ("item", "value"), rows)
    with suppress(OSError, UnicodeDecodeError):
        plan = read_text(bench / PLAN)
        yield "The plan (for splatseed bench --plan plan.toml):"
        yield {"kind": "preformatted", "text": plan}


def _text(*texts: str, mark: str = "") -> Part:
    """Make paragraphs with a class of the style sheet."""
    return {"kind": "text", "texts": texts, "mark": mark} if texts else None


def _figure(content: bytes, caption: str, kind: str = "image/png") -> Part:
    return {"kind": "figure", "url": _url(content, kind), "caption": caption}


def _url(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{b64encode(content).decode('ascii')}"


def _views(view: pictures.ComparedView) -> Part:
    base, best, _ = view.pictures
    caption = (
        f"{view.scene}, test view {view.name}: {base} on the left, {best} on the right "
        f"({Number(view.gain.mean, signed=True)} dB over all test views of this scene)"
        f"{view.gain.caveat}."
    )
    urls, errors = (
        {name: _url(content, "image/jpeg") for name, content in each.items()}
        for each in (view.pictures, view.errors)
    )
    shape = f"{view.shape:.4f}"
    return {"kind": "views", "shape": shape, "caption": caption, "urls": urls, "errors": errors}
