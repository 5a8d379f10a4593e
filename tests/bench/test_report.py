"""Reports of benchmarks whole, partial, failed and empty; figures; and the page in a browser."""

from __future__ import annotations

import dataclasses
import math
import re
import shutil
from html import unescape
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

pytest.importorskip("pandas", reason="reports need pandas")

from splatseed.bench import pictures as pictures_module
from splatseed.bench.figures import arm_figure, curve_figure, scene_figure, seconds_figure
from splatseed.bench.plan import SFM
from splatseed.bench.report import REPORT, write_report
from splatseed.bench.runs import BenchRun, run_folder
from splatseed.bench.scenes import scene_digest
from splatseed.bench.study import studies
from splatseed.bench.versions import splatseed_version
from splatseed.cli import main
from splatseed.errors import OutputError, SceneFormatError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.splat.pictures import write_comparison
from splatseed.synthetic import make_capture, write_capture

from .browser import CHROMIUM, chromium
from .planted import result, runs, spec, write_bench

GONE = {"path": "gone"}


def ids_of(bench):
    ids = re.findall(r' id="([^"]+)"', (bench / REPORT).read_text("utf-8"))
    assert len(set(ids)) == len(ids)
    return set(ids)


def text_of(bench):
    text = (bench / REPORT).read_text("utf-8")
    addresses = re.findall(r' (?:src|href)="([^"]*)"', text)
    assert all(each.startswith(("data:", "#")) for each in addresses)
    assert {each[1:] for each in addresses if each[0] == "#"} <= ids_of(bench)
    return " ".join(unescape(re.sub("<[^>]+>", " ", text)).split())


def draw_blanks(monkeypatch):
    """Figures stay empty where only text and tables are looked at: one takes half a second."""
    blank = BytesIO()
    Image.new("RGB", (9, 9)).save(blank, "PNG")
    save = lambda _, out, **_how: out.write(blank.getvalue())
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", save)


@pytest.fixture
def blank_figures(monkeypatch):
    draw_blanks(monkeypatch)


def test_a_whole_benchmark(tmp_path, blank_figures):
    strategies, scenes = ("default", "default-3dgs"), ("bonsai", "room0")
    planned = runs(scenes=scenes, strategies=strategies, repeats=2, **GONE)
    bench = write_bench(tmp_path / "b", planned)
    report = write_report(bench)
    ids = {"summary", "cost", "scores", "gains", "curves", "resources", "setup"}
    assert ids <= ids_of(bench)
    names = {path.name for path in (bench / "tables").iterdir()}
    wanted = ("psnr_default-3dgs", "psnr_default", "gains_default", "arms", "seconds")
    assert {f"{name}.{kind}" for name in wanted for kind in ("csv", "html")} <= names
    figures = {path.name for path in (bench / "figures").iterdir()}
    assert {"psnr_steps_default.png", "psnr_seconds_arms.png", "gain_arms.png"} <= figures
    assert (report.tables * 2, report.figures) == (len(names) - 1, len(figures) - 1)
    said = text_of(bench)
    assert all(each in said for each in report.summary)
    assert "3 of 4 variants under default are better than sfm, and 1 worse" in said
    assert "splatseed bench --scenes '<A>' 'b c'" in said


ONE = {"scenes": ("fox",), "gains": {(SFM, 1): 0.0, ("mls", 8): 0.5}, "repeats": 2, **GONE}


@pytest.mark.parametrize(
    ("planted", "said"),
    [
        (runs(**ONE), "mean over repeats, for this scene trained again"),
        (runs(**{**ONE, "repeats": 1}), "than sfm + none (1 repeat: too few to tell)"),
        (runs(**{**ONE, "gains": {("mls", 8): 0.1}}), "There is no comparison yet"),
        ([], "0 runs"),
        ([*runs(**ONE), *runs(**ONE, max_steps=2000)], "Set 2: 2,000 steps"),
        ([*runs(**ONE), BenchRun(spec("fox", "mls", 8, repeat=6, **GONE))], "Missing runs: 1"),
        ([*runs(**ONE), BenchRun(spec("fox", "linear", 8, **GONE), error="a <b>cat</b>")],
         "a <b>cat</b>"),  # as text: tags were escaped
    ],
)  # fmt: skip
def test_little_is_enough(tmp_path, planted, said, blank_figures):
    check_report(tmp_path, planted, said)


@pytest.mark.parametrize(
    ("planted", "said"),
    [
        ([*runs(**ONE), BenchRun(spec("fox", "mls", 8, repeat=7, **GONE), result(math.inf))],
         "fox, mls 8x, none, repeat 8"),
        ([*runs(**ONE), BenchRun(spec("fox", SFM, 1, repeat=8, **GONE), result(25.0, curve=()))],
         "2 to 3 repeats"),
    ],
)  # fmt: skip
def test_runs_without_a_number_or_a_curve_are_drawn_beside_others(tmp_path, planted, said):
    check_report(tmp_path, planted, said)


def check_report(tmp_path, planted, said):
    report = write_report(write_bench(tmp_path / "b", planted))
    assert said in text_of(tmp_path / "b")
    assert report.tables == len(list(tmp_path.glob("b/tables/*.csv")))
    kinds = {finding.kind for finding in report.findings}
    assert ("unfinished-runs" in kinds) == any(run.result is None for run in planted)


def test_others_files_are_not_replaced_and_bad_folders_are_one_error(tmp_path):
    with pytest.raises(SceneNotFoundError, match="a benchmark at"):
        write_report(tmp_path)
    bench = write_bench(tmp_path / "b", [])
    write_report(bench)
    (bench / "tables" / "mine.txt").write_text("mine", "utf-8")
    with pytest.raises(OutputError, match=r"mine\.txt"):
        write_report(bench)
    assert (bench / "tables" / "mine.txt").read_text("utf-8") == "mine"
    write_bench(tmp_path / "c", runs(**ONE))
    next(tmp_path.glob("c/runs/*/result.json")).write_text("{}")
    with pytest.raises(SceneFormatError, match=r"result\.json"):
        write_report(tmp_path / "c")
    (bench / "planned.json").write_text('{"calls": [], "runs": [{}]}')
    with pytest.raises(SceneFormatError, match=r"planned\.json"):
        write_report(bench)


def test_the_commands_say_what_they_found(tmp_path, capsys, blank_figures):
    bench = write_bench(tmp_path / "b", runs(**ONE))
    main(["bench", "report", str(bench)])
    output = " ".join(capsys.readouterr().out.split())
    assert "On 1 scene, mls 8x + none has the highest mean" in output
    assert str(bench / REPORT) in output
    with pytest.raises(SystemExit) as stop:
        main(["bench", "report", str(tmp_path / "nowhere")])
    assert stop.value.code == 2


def count_of(plot, color):
    """How many pixels of a figure have a colour."""
    pixels = np.asarray(Image.open(BytesIO(plot.png)).convert("RGB")).astype(int)
    return int((np.abs(pixels - np.array(color)).max(axis=2) < 12).sum())


@pytest.mark.parametrize("draw", [
    lambda study: curve_figure(study, "none"), lambda study: scene_figure(study, "none"),
    arm_figure, seconds_figure,
])  # fmt: skip
def test_what_is_there_is_drawn_and_nothing_else(draw):
    some = {(SFM, 1): 0.0, ("linear", 4): 0.1, ("linear", 8): 0.1}
    for gains_, drawn in (({**some, ("mls", 8): 0.4}, True), (some, False)):
        planned = runs(scenes=("fox",), gains=gains_, strategies=("default", "none"))
        (study,) = studies(planned)
        assert (count_of(draw(study), (0xD5, 0x5E, 0x00)) > 20) == drawn  # the colour of mls
    alone = runs(scenes=("fox",), gains={(SFM, 1): 0.0})
    bare = [dataclasses.replace(r, result=dataclasses.replace(r.result, curve=())) for r in alone]
    assert draw(*studies(bare)) is None


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    """A made-up scene in files, with its fingerprint."""
    made = make_capture(num_views=4, width=64, height=48)
    path = write_capture(made, tmp_path_factory.mktemp("scenes") / "room")
    scene = load_scene(path)
    return path, scene_digest(scene)


def with_capture(bench, path, digest, *gains, **changes):
    """A benchmark of runs on the capture, with the pictures that runs keep."""
    gains = {(SFM, 1): 0.0, **dict(gains)}
    own = {"digest": digest, "path": str(path), "version": splatseed_version(), **changes}
    finished = runs(scenes=("../a room",), gains=gains, repeats=2, **own)
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 255, (30, 40, 3), np.uint8)
    for run in finished:
        folder = run_folder(bench, run.spec) / "renders"
        folder.mkdir(parents=True)
        for name in ("view0.png", "view1.png"):
            noise = 40 * rng.standard_normal(truth.shape)
            render = np.clip(truth + noise, 0, 255).astype(np.float32) / 255
            write_comparison(
                folder / name, truth, render, np.abs(render - truth / 255).mean(axis=2)
            )
    return write_bench(bench, finished)


GOOD = (("linear", 2), 0.2), (("mls", 3), 0.5)


@pytest.fixture(scope="module")
def reported(tmp_path_factory, capture):
    """A benchmark with pictures, not to be written to, and what was said of its report."""
    bench = with_capture(tmp_path_factory.mktemp("bench") / "b", *capture, *GOOD)
    return bench, write_report(bench)


def test_seeds_and_views_are_shown_and_not_made_again(tmp_path, reported, monkeypatch):
    made, report = reported
    bench = shutil.copytree(made, tmp_path / "b")
    first = (bench / REPORT).read_bytes()
    assert not report.findings
    assert len(list((bench / "figures").glob("clouds_.._a_room_*.png"))) == 1
    # The middle one of the views, with its error maps.
    shown = r"test view view1: sfm \+ none on the left, mls 3x \+ none on the right \(\+0\.\d\d dB"
    assert re.search(shown, text_of(bench))
    assert "FLIP of sfm + none FLIP of mls 3x + none" in text_of(bench)
    monkeypatch.setattr(pictures_module, "open_unchanged", pytest.fail)
    write_report(bench)
    assert (bench / REPORT).read_bytes() == first
    for picture in bench.glob("runs/*/renders/view1.png"):
        picture.write_bytes(b"damaged")
    draw_blanks(monkeypatch)
    write_report(bench)
    assert "test view view1" not in text_of(bench)


def test_points_of_code_that_has_changed_are_not_drawn_by_the_present_code(
    tmp_path, capture, blank_figures
):
    path, digest = capture
    bench = with_capture(tmp_path / "b", path, digest, (("mls", 3), 0.1), version="0.1.0+0a0a0a")
    (finding,) = write_report(bench).findings
    assert finding.text == "../a room: no picture of points by earlier code: mls 3x"
    assert not list((bench / "figures").glob("clouds_*.png"))


def test_a_changed_scene_costs_its_pictures_alone_and_losers_are_not_called_the_best(
    tmp_path, capture
):
    path, digest = capture
    bench = with_capture(tmp_path / "b", path, digest[::-1], (("mls", 3), -0.1), noise=0.0)
    (finding,) = write_report(bench).findings
    assert (finding.kind, finding.subjects) == ("missing-picture", ("../a room",))
    assert "expected the files of" in finding.text
    said = text_of(bench)
    assert "view1: sfm + none on the left, mls 3x + none on the right (-0.10 dB" in said


@pytest.fixture(scope="module")
def opened(tmp_path_factory, reported):
    """A report in a browser."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (Debian: apt-get install chromium)")
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page, reported[0] / REPORT


@pytest.mark.parametrize("width", [1200, 320])
def test_the_page_opens_alone_and_fits(opened, width):
    page, path = opened
    page.open(path, width)
    assert [url for url in page.requests if not url.startswith("data:")] == [
        path.resolve().as_uri()
    ]
    assert not page.errors
    assert page.run("document.documentElement.scrollWidth") == width
    assert page.run("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    inside = "[...document.images].every(i => i.getBoundingClientRect().right <= innerWidth)"
    assert page.run(inside)  # scrolled sideways, half of a figure would be missed
    # No text runs out of its own block, except where the block scrolls.
    wide = "[...document.querySelectorAll('h1,h2,h3,p,figcaption,summary')]"
    assert page.run(f"{wide}.filter(e => e.scrollWidth > e.clientWidth + 1).length") == 0


def test_any_two_pictures_can_be_compared(opened):
    page, path = opened
    page.open(path, 1200)
    at = "document.querySelector('.stage').style.getPropertyValue('--at')"
    assert page.run(at) == "50%"
    page.run("document.querySelector('.compare').scrollIntoView({behavior: 'instant'})")
    left, top, width, height = page.run(
        "(r => [r.left, r.top, r.width, r.height])"
        "(document.querySelector('.stage').getBoundingClientRect())"
    )
    page.drag(left + 0.25 * width, top + 0.5 * height)
    assert page.run(at) == "25%"
    shown = (
        "['left', 'right'].map(c =>"
        " document.querySelector('.stage').querySelector('.' + c)?.alt.split(',')[0])"
    )
    assert page.run(shown) == ["sfm + none", "mls 3x + none"]
    choose = (
        "(s => { s.selectedIndex = %d; s.dispatchEvent(new Event('change')); })"
        "(document.querySelectorAll('.compare select')[%d])"
    )
    page.run(choose % (2, 0))
    assert page.run(shown) == ["photograph", "mls 3x + none"]
    page.run(choose % (2, 1))
    assert page.run(shown) == [None, "photograph"]
