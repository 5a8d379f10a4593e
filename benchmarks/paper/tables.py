"""The paper's tables in its own layout, from the folders of benchmarks, complete or not.

Notation: a *way* is as in ``gained``; each table of a page stands between its own two marks, and
nothing else of the page is touched. Before table 1 it says what cells mean; one without a finished
run is blank.

    python -m benchmarks.paper.tables BENCH BENCH_DEPTH

It fills ``docs/results/paper.md``, and writes every finished run to ``tables/paper_runs.csv``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeAlias

import pandas as pd
import tyro
from benchmarks.paper.gained import LAYOUT, RANDOM, Results, Way, read_results
from benchmarks.paper.guidelines import at_ratio, verdict_table
from benchmarks.paper.printed import printed_costs, printed_gains, printed_psnr

from splatseed.bench.plan import SFM
from splatseed.bench.statistics import Difference, adjusted, over_scenes
from splatseed.bench.study_tables import verdict_mark
from splatseed.bench.tables import Cell, Number, Row, Table
from splatseed.errors import SceneFormatError, SplatseedError
from splatseed.io.staging import atomic_file

__all__ = ["fill", "page_tables", "run_frame", "to_markdown"]

RESULTS = Path(__file__).parents[2] / "docs" / "results"
MEASURES = {
    "psnr": "PSNR, dB", "ssim": "SSIM", "flip": "FLIP", "lpips": "LPIPS", "num_seeds": "seeds",
    "gaussians": "Gaussians", "seeding": "upsampling, s", "training": "training, s",
    "model": "model, MB",
}  # fmt: skip
SECONDS = ("seeding", "training")
COSTS = (*SECONDS, "gaussians", "model")
PRINTED = {"train_time_s": "paper: training, s", "model_size_mb": "paper: model, MB"}
DIGITS = {**dict(zip(COSTS, (2, 0, 0, 1), strict=True)), **dict.fromkeys(PRINTED, 0)}
"""Of table 3."""
SHOWN = 16.0
"""The ratio of which tables 1 and 2 show every scene, and table 3 the costs; of the others tables 1
and 2 have the means."""
Kinds: TypeAlias = Sequence[tuple[str, float]]
"""Methods with ratios."""


@dataclass(frozen=True)
class Options:
    """Write the paper's tables, and the runs that they are of."""

    benches: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of ``splatseed bench``: of the plans small.toml and depth.toml, and others."""
    output: Annotated[Path, tyro.conf.arg(aliases=("-o",))] = RESULTS
    """The folder of paper.md, whose tables are replaced."""


def main(options: Options) -> None:
    """Read the benchmarks, fill the page, and write the runs."""
    results, page = read_results(options.benches), options.output / "paper.md"
    text = page.read_text("utf-8")
    for name, tables in page_tables(results).items():
        text = fill(text, name, "\n".join(map(to_markdown, tables)))
    runs = options.output / "tables" / "paper_runs.csv"
    runs.parent.mkdir(exist_ok=True)
    with atomic_file(runs) as partial:
        run_frame(results).to_csv(partial, index=False, float_format="%.6g", lineterminator="\n")
    with atomic_file(page) as partial:
        partial.write_text(text, "utf-8")
    done = sum(run.result is not None for run in results.runs)
    print(f"{page}, {runs}: {done} of {len(results.runs)} runs have finished.")


def fill(text: str, name: str, content: str) -> str:
    """The text of a page with other content between the two marks of a name.

    Raises:
        SceneFormatError: The page does not have these marks, once each.
    """
    marks = [f"<!-- {name}:{end} -->" for end in ("begin", "end")]
    between = re.compile(rf"(?<={re.escape(marks[0])}\n).*?(?={re.escape(marks[1])})", re.DOTALL)
    if [text.count(mark) for mark in marks] != [1, 1] or not between.search(text):
        raise SceneFormatError(f"a page with {' and '.join(marks)}", found="none", fix="Add them.")
    return between.sub(lambda _: f"\n{content}\n" if content else "", text)


def to_markdown(table: Table) -> str:
    """A table as Markdown, with the title above and the notes below."""
    shown = table.shown(_escape, "**{}**")
    right = ["---", *(["---:"] * (len(table.header) - 1))]
    lines = [list(shown.columns), right, *shown.itertuples(index=False, name=None)]
    notes = "".join(f"\n{_escape(note)}\n" for note in table.notes)
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return f"**{_escape(table.title)}**\n\n{rows}\n{notes}"


def _escape(text: str) -> str:
    return re.sub(r"([\\|*_`<>])", r"\\\1", text)


def page_tables(results: Results) -> dict[str, list[Table]]:
    """The tables of each part of the page by its name, as far as there are finished runs."""
    finished = [way for way in results.ways() if results.study(way.strategy)]
    first = finished[:1]
    points, deep = (results.scenes(with_depth=each) for each in (False, True))
    kinds = (("mipnerf360", points), ("replica", deep))
    by_photographs = [_by_ratio(results, way, *kinds[0], full=True, only=SHOWN) for way in first]
    by_depth = [
        _by_ratio(results, way, *kinds[1], full=way in first, only=SHOWN) for way in finished
    ]
    return {
        "table1": _with_rows([*by_photographs, _all_means(results, finished[1:], points)]),
        "table2": _with_rows(by_depth),
        "table3": [
            _costs(results, way, key, scenes) for way in first for key, scenes in kinds if scenes
        ],
        "random": list(_ablation(results, finished, points)),
        "guidelines": [verdict_table(results)] if finished else [],
        "conditions": [_conditions(results, finished)] if finished else [],
    }


def _columns(results: Results, scenes: Iterable[str]) -> tuple[str, ...]:
    """The methods that are planned on some scenes, in the paper's order."""
    names = set(scenes)
    planned = {run.spec.arm.method for run in results.runs if run.spec.scene.name in names}
    return tuple(name for name in LAYOUT if name in planned)


def _by_ratio(
    results: Results,
    way: Way,
    key: str,
    scenes: Sequence[str],
    *,
    full: bool = False,
    only: float | None = None,
) -> Table:
    """Gains by ratio and scene, and in full the scores too; with their means, and the paper's.

    With ``only`` a ratio of which there are runs, the other ratios have their means alone.
    """
    methods, rows = _columns(results, scenes), list[Row]()
    theirs, printed = printed_psnr(key), printed_gains(key)
    ratios = results.ratios(scenes)
    for ratio in ratios:
        shown, kinds = f"{ratio:g}x", [(method, ratio) for method in methods]
        run = {each: [results.gain(way, each, *kind) for kind in kinds] for each in scenes}
        run = {scene: gained for scene, gained in run.items() if any(gained)}
        each_scene = only in (None, ratio) or only not in ratios
        for scene, gained in run.items() if each_scene else ():
            if not full:
                rows.append((scene, shown, *map(_gain_cell, gained)))
                continue
            labels = [SFM, *(results.label(way, *kind) for kind in kinds)]
            scored = [_score(results, way, scene, label) for label in labels]
            rows.append((scene, shown, *_marked(scored, [None, *gained])))
            if scene in theirs.index and any(kind in theirs for kind in kinds):
                own = [Number(theirs.loc[scene].get(kind, math.nan)) for kind in _with_sfm(kinds)]
                more = [
                    replace(e, text=f"({Number(e.value - own[0].value, signed=True)})")
                    for e in own[1:]
                ]
                rows.append((f"{scene}, paper", shown, *_marked([own[0], *more])))
        if not run:
            continue
        blank = ("",) if full else ()
        rows.append(("mean", shown, *blank, *_mean_gains(results, way, scenes, kinds)))
        if any(kind in printed for kind in kinds):
            means = [printed[kind].mean() if kind in printed else math.nan for kind in kinds]
            name = f"mean of the paper's {len(printed)} scenes"
            rows.append((name, shown, *blank, *(Number(each, signed=True) for each in means)))
    header = ("scene", "ratio", *([SFM] if full else []), *methods)
    title = f"{'Scores and gains' if full else 'Gains'} over sfm, {way.label}"
    return Table("gains", title, header, rows)


def _with_rows(tables: Iterable[Table]) -> list[Table]:
    return [table for table in tables if table.rows]


def _all_means(results: Results, ways: Sequence[Way], scenes: Sequence[str]) -> Table:
    """The mean gains of several ways over the same scenes, by ratio."""
    methods, rows = _columns(results, scenes), list[Row]()
    for way in ways:
        for ratio in results.ratios(scenes):
            means = _mean_gains(results, way, scenes, [(method, ratio) for method in methods])
            if any(map(str, means)):
                rows.append((way.label, f"{ratio:g}x", *means))
    return Table("means", "Mean gains over sfm", ("runs", "ratio", *methods), rows)


def _with_sfm(kinds: Kinds) -> Kinds:
    return [(SFM, 1.0), *kinds]


def _score(results: Results, way: Way, scene: str, label: str) -> Number:
    names = ("psnr", "ssim", "lpips")
    means = {name: results.repeats(way, scene, label, name).mean() for name in names}
    others = [f"/ {means[n]:.3f}" for n in ("ssim", "lpips") if not math.isnan(means[n])]
    return Number(means["psnr"], text=" ".join(others).replace("/ 0.", "/ ."))


def _marked(cells: Sequence[Number], gained: Sequence[Difference | None] = ()) -> list[Number]:
    """The cells with their gains behind them, and the highest in bold."""
    most = max((cell.value for cell in cells if not math.isnan(cell.value)), default=math.nan)
    told = [_gain_cell(each) for each in gained] or [""] * len(cells)
    return [
        replace(
            cell,
            text=f"{cell.text} ({gain})" if str(gain) else cell.text,
            mark="" if isinstance(gain, str) else gain.mark,
            bold=cell.value == most,
        )
        for cell, gain in zip(cells, told, strict=True)
    ]


def _gain_cell(gain: Difference | None) -> Cell:
    if gain is None:
        return ""
    return Number(gain.mean, se=gain.se, signed=True, mark=verdict_mark(gain))


def _mean_gains(results: Results, way: Way, scenes: Sequence[str], kinds: Kinds) -> list[Cell]:
    """The mean gain over scenes of some methods and ratios, tested together."""
    frame = results.gains(way)
    own = [at_ratio(frame[method], ratio).reindex(scenes).dropna() for method, ratio in kinds]
    return list(map(_gain_cell, adjusted([over_scenes(e) if len(e) else None for e in own])))


def _costs(results: Results, way: Way, key: str, scenes: Sequence[str]) -> Table:
    """Seconds, Gaussians and size by method, and what a ratio (SHOWN if run) multiplies them by."""
    ratios = [r for r in results.ratios(scenes) if all(r in results.ratios([s]) for s in scenes)]
    ratios = [SHOWN] if SHOWN in ratios else ratios
    kinds = _with_sfm([(m, r) for r in ratios for m in _columns(results, scenes)])
    labels = [results.label(way, *kind) for kind in kinds]
    means = {
        name: pd.DataFrame(
            # Of seconds the least: other work on the machine only adds to them.
            [[found.min() if name in SECONDS else found.mean() for label in labels
              for found in [results.repeats(way, scene, label, name)]] for scene in scenes],
            index=scenes, columns=pd.MultiIndex.from_tuples(kinds),
        ).dropna().mean()
        for name in COSTS
    }  # fmt: skip
    printed = printed_costs(key).reindex(kinds)
    means |= {name: printed[name] for name in PRINTED}
    rows = list[Row]()
    for ratio in (1.0, *ratios):
        own = [kind for kind in kinds if kind[1] == ratio]
        for kind in own:
            cells = (Number(means[name][kind], digits) for name, digits in DIGITS.items())
            rows.append((kind[0], f"{ratio:g}x", *cells))
        if ratio > 1:
            times = {n: means[n][own].mean() / means[n][SFM, 1.0] for n in DIGITS if n != "seeding"}
            shown = (Number(times.get(name, math.nan), text="x") for name in DIGITS)
            rows.append(("mean, of sfm's", f"{ratio:g}x", *shown))
    done = [
        scene
        for scene in scenes
        if not any(results.repeats(way, scene, label, "model").empty for label in labels)
    ]
    note = f"Means over the scenes that have all of these runs: {', '.join(done) or 'none yet'}."
    header = ("method", "ratio", *(MEASURES[name] for name in COSTS), *PRINTED.values())
    return Table("costs", f"Time and size, {way.label}", header, rows, (note,))


def _ablation(results: Results, ways: Sequence[Way], scenes: Sequence[str]) -> Iterator[Table]:
    """What random points gain, by scene, ratio and strategy."""
    ratios = {arm.ratio for arm in results.arms if arm.method == RANDOM}
    kinds = [(RANDOM, ratio) for ratio in sorted(ratios)]
    by_strategy = {way.strategy: way for way in ways}.values()  # random has one profile
    rows = [
        (scene, *(_gain_cell(results.gain(w, scene, *kind)) for w in by_strategy for kind in kinds))
        for scene in scenes
    ]
    means = (_mean_gains(results, way, scenes, kinds) for way in by_strategy)
    rows.append(("mean", *(cell for each in means for cell in each)))
    header = ("scene", *(f"{r:g}x, {w.strategy}" for w in by_strategy for _, r in kinds))
    if kinds and rows[:-1]:
        yield Table("random", "Random points: gain over sfm", header, rows)


def _conditions(results: Results, ways: Sequence[Way]) -> Table:
    """How the runs were made, by strategy."""
    rows = list[Row]()
    for strategy in dict.fromkeys(way.strategy for way in ways):
        study = results.study(strategy)
        assert study is not None  # noqa: S101  (of finished ways only)
        left_out = sum(s is not study and strategy in s.strategies for s in results.found)
        devices = ", ".join(sorted({each.device for each in study.under(strategy)["result"]}))
        more = f"; {left_out} sets of other settings are left out" if left_out else ""
        rows.append((strategy, f"{study.description}{more}", devices))
    return Table("conditions", "Conditions", ("strategy", "settings", "device"), rows)


def run_frame(results: Results) -> pd.DataFrame:
    """A row for each finished run: scene, arm, repeat and settings, then what was measured."""
    frames = []
    for study in results.found:
        arms = [(spec.arm, spec) for spec in study.runs["spec"]]
        told = {
            "method": [arm.method for arm, _ in arms],
            "profile": [arm.profile for arm, _ in arms],
            "ratio": [arm.ratio for arm, _ in arms],
            "budget": [arm.budget for arm, _ in arms],
            "steps": [spec.training.max_steps for _, spec in arms],
            "data factor": [spec.training.data_factor for _, spec in arms],
            "version": [spec.version for _, spec in arms],
        }
        own = study.runs[["scene", "strategy", "repeat"]].assign(**told)
        frames.append(pd.concat([own, study.runs[list(MEASURES)].rename(columns=MEASURES)], axis=1))
    every = pd.concat(frames) if frames else pd.DataFrame(columns=["scene"])
    return every.sort_values(list(every.columns[:10]), ignore_index=True)


if __name__ == "__main__":
    try:
        main(tyro.cli(Options))
    except SplatseedError as error:
        raise SystemExit(f"error: {error}") from None
