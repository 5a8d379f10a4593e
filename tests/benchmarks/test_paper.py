"""The paper's tables hold what the runs say, blank where there is none; planted effects decide."""

from __future__ import annotations

import re
from importlib import import_module

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("pandas", reason="tables need pandas")

from splatseed.bench.runs import BenchRun
from splatseed.bench.tables import Number, Table
from splatseed.errors import SceneFormatError

from ..bench.planted import runs, spec, write_bench
from .conftest import ROOT

POINTS = ("linear", "triangle", "spline", "mls", "voronoi")
GAINS = {("sfm", 1): 0.0, ("random", 4): -0.5, ("random", 16): -0.5}
GAINS |= {(name, ratio): 0.1 for name in POINTS for ratio in (4, 16)}
GAINS |= {("mls", 4): 0.6, ("mls", 16): 0.6}
SCENES = ("bonsai", "treehill", "fern", "fox", "stone_horse", "face", "dorm", "desk")
PAGE = ROOT / "docs" / "results" / "paper.md"


@pytest.fixture
def paper(monkeypatch):
    """A module of ``benchmarks.paper`` by name."""
    monkeypatch.syspath_prepend(ROOT)
    return lambda name: import_module(f"benchmarks.paper.{name}")


def planned(scenes=SCENES, **changes):
    """All runs of the paper's profile, finished; the baseline's profile is the default one."""
    finished = runs(scenes, GAINS, ("default-3dgs",), noise=0.01, **changes)
    return [
        BenchRun(spec(r.spec.scene.name, r.spec.arm.method, r.spec.arm.ratio, repeat=r.spec.repeat,
                 strategy="default-3dgs", profile="default" if r.spec.arm.method == "sfm" else
                 "paper"), r.result)
        for r in finished
    ]  # fmt: skip


def row(text, *cells):
    (line,) = [each for each in text.splitlines() if each.startswith(f"| {' | '.join(cells)} |")]
    return [cell.strip() for cell in line.split("|")[1:-1]]


def test_a_benchmark_that_was_killed_fills_the_page_and_blanks_the_rest(paper, tmp_path):
    all_runs, missing = planned(), ("face", "voronoi", 16.0)
    kept = [
        BenchRun(run.spec)
        if (run.spec.scene.name, run.spec.arm.method, run.spec.arm.ratio) == missing
        else run
        for run in all_runs
    ]  # fmt: skip
    (tmp_path / "paper.md").write_bytes(PAGE.read_bytes())
    options = paper("tables").Options((write_bench(tmp_path / "B", kept),), tmp_path)
    paper("tables").main(options)
    text = (tmp_path / "paper.md").read_text("utf-8")
    face = row(text, "face", "16x")
    mls = [r.result.psnr for r in all_runs if (r.spec.scene.name, r.spec.arm.label) ==
           ("face", "mls 16x (paper)")]  # fmt: skip
    assert face[-1] == ""
    assert face[-2].startswith(f"**{np.mean(mls):.2f} / .800 (+0.")
    theirs = row(text, "bonsai, paper", "16x")
    assert (
        theirs[2]
        == f"{paper('printed').printed_psnr('mipnerf360').loc['bonsai', ('sfm', 1.0)]:.2f}"
    )
    assert row(text, "mean", "4x")[-2].startswith("+0.6")

    ledger = pd.read_csv(tmp_path / "tables" / "paper_runs.csv")
    assert len(ledger) == sum(run.result is not None for run in kept)
    again = (tmp_path / "paper.md").read_bytes()
    paper("tables").main(options)
    assert (tmp_path / "paper.md").read_bytes() == again


def test_further_ways_have_means_alone(paper, tmp_path):
    own = runs(SCENES[:3], GAINS, ("default", "mcmc"), noise=0.01)
    results = paper("gained").read_results([write_bench(tmp_path / "B", own)])
    tables = paper("tables")
    full, means = map(tables.to_markdown, tables.page_tables(results)["table1"])
    assert "/ .800 (+0.6" in row(full, "fern", "16x")[-2]
    assert row(full, "mean", "4x")[-2].startswith("+0.6")
    assert "| fern | 4x |" not in full
    (costs,) = map(tables.to_markdown, tables.page_tables(results)["table3"])
    assert row(costs, "mls", "16x")
    assert "| mls | 4x |" not in costs
    assert row(means, "mcmc, profile default", "4x")[-2].startswith("+0.6")
    assert "fern" not in means


def test_guidelines_are_decided_by_what_was_planted(paper, tmp_path):
    guidelines = paper("guidelines")
    results = paper("gained").read_results([write_bench(tmp_path / "B", planned())])
    (way,) = results.ways()
    told = dict(zip(guidelines.GUIDELINES, guidelines.verdicts(results.gains(way)), strict=True))
    by_text = {each.text: verdict for each, verdict in told.items()}
    assert by_text["MLS is most often best"].startswith("holds: +0.50 ± 0.00 dB, 8 scenes, p < ")
    # Two planar scenes are too few to tell.
    assert by_text["Voronoi suits planar scenes"].startswith("not decided here: -0.1")
    assert by_text["Simple methods at low ratios suffice"].startswith("fails: -0.1")
    assert by_text["Benefits rise to 32x indoors"] == "not decided here: not run"
    assert "mls 8" in paper("tables").to_markdown(guidelines.verdict_table(results))


def test_markdown_escapes_what_would_end_a_cell(paper):
    odd = Number(-0.0001, 2, 0.5, signed=True, mark="~", bold=True)
    table = Table("odd", "a | b", ("scene", "a_b & c"), (("<s|c>_#1", odd),), ("~ means ±",))
    lines = paper("tables").to_markdown(table).splitlines()
    assert len({len(re.findall(r"(?<!\\)\|", line)) for line in lines[2:5]}) == 1
    assert "**0.00 ± 0.50** ~" in lines[4]


def test_noise_and_a_single_scene_decide_nothing(paper):
    guidelines = paper("guidelines")
    rng = np.random.default_rng(0)
    index = pd.MultiIndex.from_product([SCENES, (4.0, 16.0)], names=["scene", "ratio"])
    methods = (*POINTS, "depth", "random")
    gains = pd.DataFrame(rng.normal(0, 0.3, (len(index), 7)), index, columns=list(methods))
    gains["depth"] = np.nan
    assert all("not decided" in each for each in guidelines.verdicts(gains))
    assert all("not decided" in each for each in guidelines.verdicts(gains.loc[["fern"]]))


def test_ways_are_the_papers_own_first_and_then_in_the_plans_order(paper, tmp_path):
    names = ("mcmc", "none", "grow", "default", "default-3dgs")
    own = [run for name in names for run in runs(["fern"], {("sfm", 1): 0, ("mls", 4): 0}, (name,))]
    results = paper("gained").read_results([write_bench(tmp_path / "B", own)])
    assert [way.strategy for way in results.ways()] == ["default-3dgs", *names[:-1]]


@pytest.mark.parametrize("text", ["", "<!-- a:begin -->", "<!-- a:end -->\n<!-- a:begin -->\n"])
def test_a_page_without_marks_is_refused(paper, text):
    with pytest.raises(SceneFormatError, match="a:begin"):
        paper("tables").fill(text, "a", "x")


def test_the_page_has_a_place_for_every_table(paper, tmp_path):
    results = paper("gained").read_results([write_bench(tmp_path / "B", [])])
    text = PAGE.read_text("utf-8")
    for name, tables in paper("tables").page_tables(results).items():
        assert tables == []
        assert f"<!-- {name}:begin -->" in text


def test_the_printed_gains_have_three_means(paper):
    """All variants together, the best variant, the best of each scene; see docs/paper.md."""
    for dataset, *expected in (
        ("mipnerf360", 0.117, 0.202, 0.258),
        ("replica", 0.343, 0.507, 0.646),
    ):
        gains = paper("printed").printed_gains(dataset)
        means = [gains.to_numpy().mean(), gains.mean().max(), gains.max(axis=1).mean()]
        assert means == pytest.approx(expected, abs=5e-4)
