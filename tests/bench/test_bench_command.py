"""``splatseed bench`` from its words to its exit code, with real runs."""

from __future__ import annotations

import dataclasses
import fcntl
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed import synthetic
from splatseed.bench import job
from splatseed.bench.plan_file import plan_text, read_plan
from splatseed.bench.runs import read_calls, read_runs, record_plan
from splatseed.bench.scenes import DEMO, PlannedScene, survey
from splatseed.io import load_scene
from splatseed.synthetic import make_capture

PLANS = Path(__file__).parents[2] / "benchmarks" / "paper"
COMMAND = (sys.executable, "-c", "from splatseed.cli import main; main()", "bench")


@pytest.fixture
def plan_path(small_plan, tmp_path):
    """Writes a plan of the small room; ``plan_path(methods=..., ...)``."""

    def write(*, max_steps=small_plan.training.max_steps, **changes):
        path = tmp_path / "plan.toml"
        training = dataclasses.replace(small_plan.training, max_steps=max_steps)
        path.write_text(plan_text(dataclasses.replace(small_plan, training=training, **changes)))
        return path

    return write


@pytest.fixture
def bench(splatseed):
    """Runs ``splatseed bench WORDS...`` here; its exit code, stdout and stderr."""
    return partial(splatseed, "bench")


@pytest.fixture
def here(monkeypatch, in_process):
    """Runs take place in this process, which spares the import of PyTorch."""
    monkeypatch.setattr(job, "ProcessWorkers", lambda _: in_process)


def test_runs_everything_once_and_a_failed_run_ends_nothing_else(here, bench, plan_path, tmp_path):
    folder = tmp_path / "B"
    plan = plan_path(
        methods=("sfm", "linear", "depth"), repeats=1, parameters={"depth": {"min_points": 9999}}
    )
    code, out, err = bench("--plan", plan, "-o", folder)
    assert code == 1
    assert "[3/3] room" in err
    assert re.search(r"room, depth 2x, none, repeat 1 +expected .*9,?999", out)
    assert f"splatseed bench report {folder}" in out
    assert re.search(r"linear 2x +none +\d+\.\d\d +[+-]\d", out)
    sfm, linear, depth = read_runs(folder)
    assert depth.error
    assert linear.result.num_seeds == 2 * sfm.result.num_seeds
    assert {path.name for path in folder.iterdir()} == {
        "covisible", "plan.toml", "planned.json", "runs", "splatseed.json"
    }  # fmt: skip

    results = {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/result.json")}
    code, _, err = bench("-o", folder)  # which tries again what failed
    assert code == 1
    assert "2 done, 1 failed" in err
    assert results == {path: path.stat().st_mtime_ns for path in results}
    calls = read_calls(folder)
    assert [each["command"].split()[:2] for each in calls] == [["splatseed", "bench"]] * 2
    assert {"cpu", "cores", "python", "versions"} <= calls[0].keys()


def test_a_changed_method_in_a_file_is_run_again_and_the_change_is_named(
    here, bench, plan_path, tmp_path
):
    file, folder = tmp_path / "mine.py", tmp_path / "B"
    code = (
        "def shifted(scene, num_new, rng, progress):\n"
        "    rows = rng.integers(0, len(scene.points), num_new)\n"
        "    return scene.points.xyz[rows] + {shift}, scene.points.rgb[rows]\n"
    )
    file.write_text(code.format(shift=0.01))
    words = ("--plan", plan_path(repeats=1), "--methods", "sfm", f"{file}:shifted", "-o", folder)
    run = bench(*words)
    assert (run.code, "The code has changed" in run.err) == (0, False)
    first = {path.parent.name for path in folder.glob("runs/*/result.json")}
    file.write_text(code.format(shift=0.02))
    code_, out, err = bench("-o", folder)  # by the absolute path in plan.toml
    assert code_ == 0
    assert "2 runs, 1 done, 1 pending" in err
    assert re.search(r"The code has changed \(1 run to repeat\): method .*mine.py:shifted is", err)
    second = {path.parent.name for path in folder.glob("runs/*/result.json")}
    assert len(second - first) == 1
    code_, out, err = bench("-o", folder)
    assert "2 runs, 2 done" in err
    assert "The code has changed" not in err
    _, out, _ = bench("report", folder)
    assert "code=" in out
    file.write_text("def other(): ...\n")
    assert "no attribute 'shifted'" in bench("-o", folder).err


@pytest.mark.slow
def test_killed_in_training_it_goes_on(here, bench, plan_path, tmp_path):
    folder = tmp_path / "B"
    words = ("--plan", plan_path(repeats=1, methods=("sfm",), max_steps=300), "-o", folder)
    with subprocess.Popen([*COMMAND, *map(str, words)]) as process:
        until = time.monotonic() + 60
        while not list(folder.glob("runs/.*/*/config.json")):
            assert time.monotonic() < until, "the run did not begin"
            time.sleep(0.05)
        process.kill()
    (run,) = read_runs(folder)
    assert (run.result, run.error) == (None, "")
    (left,) = folder.glob("runs/.*")
    descriptor = os.open(left, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)  # until the run's own process has ended as well
    os.close(descriptor)
    os.utime(left, (0, 0))  # a fresh one may still be somebody's
    assert bench("-o", folder).code == 0
    assert [bool(run.result) for run in read_runs(folder)] == [True]
    assert len(list((folder / "runs").iterdir())) == 1  # nothing half-written is left


def test_a_dry_run_prints_a_plan_and_writes_nothing(bench, plan_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = plan_path(profiles=("default", "paper"), methods=("sfm", "linear", "random"))
    code, out, err = bench("--plan", plan, "--repeats", 7, "--dry-run", "-o", "B")
    assert (code, err) == (0, "")
    assert "# 28 runs; this machine, 1 at a time, on the CPU" in out
    again = tmp_path / "again.toml"
    again.write_text(out)
    assert read_plan(again) == dataclasses.replace(read_plan(plan), repeats=7)
    assert not (tmp_path / "B").exists()


def test_missing_scenes_of_a_plan_are_skipped(bench, own_room, tmp_path):
    data = tmp_path / "360"
    for name, images in (("garden", "images_4"), ("bonsai", "images_2"), ("room", "images_8")):
        shutil.copytree(own_room, data / name)
        (data / name / "images").rename(data / name / images)
    words = ("--plan", PLANS / "mipnerf360.toml", "--data", data)
    code, out, _ = bench(*words, "--dry-run", "--repeats", 1)
    assert code == 0
    left_out = re.findall(r"^# (\w+) is skipped: .*(bicycle|images_2)", out, re.MULTILINE)
    assert left_out == [("bicycle", "bicycle"), ("room", "images_2")]
    assert "# 32 runs" in out  # 2 scenes, and sfm and 5 methods at 3 ratios
    (tmp_path / "plan.toml").write_text(out)
    assert read_plan(tmp_path / "plan.toml").scenes == (
        PlannedScene(str(data / "bonsai"), "bonsai", "images_2"),
        PlannedScene(str(data / "garden"), "garden", "images_4"),
    )


def test_options_make_a_plan_smaller(bench, own_room, tmp_path):
    for name in ("fern", "desk"):
        shutil.copytree(own_room, tmp_path / "data" / name)
    words = (
        "--plan",
        PLANS / "small.toml",
        "--data",
        tmp_path / "data",
        "--scenes",
        "desk",
        "fern",
    )
    code, out, err = bench(*words, "--budgets", "9rho", "--repeats", 1, "--dry-run")
    assert (code, err) == (0, "")
    (tmp_path / "plan.toml").write_text(out)
    plan = read_plan(tmp_path / "plan.toml")
    assert [scene.name for scene in plan.scenes] == ["desk", "fern"]
    assert (plan.ratios, plan.budgets, plan.repeats) == ((4, 8, 16), ("9rho",), 1)
    assert "# 136 runs" in out


def test_photographs_are_left_out_of_a_single_scene(bench, own_room, tmp_path):
    words = ("--max-steps", 3, "--exclude", "view_003*", "--dry-run")
    code, out, _ = bench("--scenes", own_room, *words)
    assert code == 0
    (tmp_path / "plan.toml").write_text(out)
    (scene,) = read_plan(tmp_path / "plan.toml").scenes
    assert scene.exclude == ("view_003*",)
    facts, whole = survey(scene), survey(replace(scene, exclude=()))
    assert facts.num_images == whole.num_images - 1
    assert facts.digest != whole.digest
    assert bench("--scenes", own_room, tmp_path, *words).code == 2


def test_the_synthetic_room_is_made_once(bench, tmp_path, monkeypatch):
    monkeypatch.setattr(synthetic, "make_capture", partial(make_capture, 0, 9, 64, 48))
    facts = survey(PlannedScene(DEMO), demo=tmp_path / "B" / "scenes" / "demo")
    assert (facts.num_images, len(load_scene(facts.path).images)) == (9, 9)
    monkeypatch.setattr(synthetic, "make_capture", lambda: pytest.fail("made again"))
    assert bench("--scenes", DEMO, "--dry-run", "-o", tmp_path / "B").code == 0


def test_a_dry_run_loads_nothing_heavy():
    """It takes a second; to make the room and to import PyTorch took over a minute."""
    code = f"{COMMAND[2]}; print(*sys.modules)"
    words = [sys.executable, "-c", f"import sys; {code}", "bench", "--scenes", DEMO, "--dry-run"]
    run = subprocess.run(words, capture_output=True, text=True, check=True)
    loaded = set(run.stdout.splitlines()[-1].split())
    assert "# 9 runs" in run.stdout
    assert not {"torch", "matplotlib", "splatseed.synthetic"} & loaded


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "-o BENCH"),
        (("-o", "B"), "--scenes"),
        (("-o", "B", "--scenes", "ROOM", "--methods", "cloud"), "--clouds"),
        (("-o", "B", "--scenes", "ROOM", "--address", "auto"), "--executor ray"),
        (("-o", "B", "--scenes", "ROOM", "--methods", "depth", "--depth", "a", "b"), "--depth"),
        (("-o", "ROOM/B", "--scenes", "ROOM"), "apart from the input"),
        (("-o", "B", "--data", "OTHER"), "--plan with --data"),
        (("-o", "B", "--plan", "REPLICA", "--data", "OTHER"), "none of office0"),
        (("-o", "B", "--plan", "REPLICA", "--data", "OTHER", "--scenes", "x"), "--scenes among"),
        (("--dry-run", "--plan", "lpips.toml"), "LPIPS"),
        (("-o", "OTHER", "--scenes", "ROOM"), "splatseed upsample wrote"),
    ],
)
def test_bad_words_are_refused_and_nothing_is_written(
    bench, room_path, tmp_path, monkeypatch, words, said
):
    monkeypatch.chdir(tmp_path)
    record_plan(tmp_path / "OTHER", "upsample", [], [])
    (tmp_path / "lpips.toml").write_text(f"lpips = true\n[[scenes]]\npath = '{room_path}'\n")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    before = sorted(tmp_path.rglob("*"))
    names = {"ROOM": str(room_path), "REPLICA": str(PLANS / "replica.toml")}
    for name, path in names.items():
        words = [word.replace(name, path) for word in words]
    code, out, err = bench(*words)
    assert (code, out) == (2, "")
    assert said.replace("ROOM", str(room_path)) in " ".join(err.split())
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(
    ("words", "ratios", "budgets", "note"),
    [
        (("--ratios", 4, 8), (4, 8), ("0.25rho or 12x",), "--budgets none lifts it"),
        (("--ratio", 16, "--profile", "default"), (16,), ("0.25rho or 23x",), "none lifts it"),
        (("--ratios", 8, "--profiles", "paper"), (8,), (), ""),
        (("--ratios", 8, "--budgets", "none"), (8,), (), ""),
        (("--budgets", "5k"), (), ("5000",), "Methods fill the budget: --ratios 8"),
        (("--budget", "5k", "--ratios", 8), (8,), ("5000",), "at most 5,000 Gaussians on room"),
    ],
)  # fmt: skip
def test_arms_have_equal_numbers_unless_told_otherwise(
    bench, room_path, tmp_path, words, ratios, budgets, note
):
    code, out, err = bench("--scenes", room_path, "--methods", "sfm", "mls", *words, "--dry-run")
    assert (code, err) == (0, "")
    (tmp_path / "plan.toml").write_text(out)
    plan = read_plan(tmp_path / "plan.toml")
    assert (plan.ratios, plan.budgets) == (ratios, budgets)
    assert note in out
    assert ("Gaussians on room" in out) == bool(budgets)


def test_a_plan_that_makes_no_difference_is_told(plan_path, bench, tmp_path):
    for budget, full in (("50", True), ("100k", False)):
        plan = plan_path(methods=("sfm", "mls"), ratios=(), budgets=(budget,))
        run = bench("--plan", plan, "--dry-run")
        assert (run.code, "add none" in run.out) == (0, full)
