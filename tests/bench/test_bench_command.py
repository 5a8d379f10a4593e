"""``splatseed bench`` from its words to its exit code: real runs in real processes."""

from __future__ import annotations

import dataclasses
import inspect
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from functools import partial

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed import synthetic
from splatseed.bench.planning.plan import PlannedScene
from splatseed.bench.planning.plan_file import plan_text, read_plan
from splatseed.bench.running import folder as folder_module
from splatseed.bench.running.ledger import Ledger
from splatseed.io import load_scene
from splatseed.synthetic import make_capture

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


def _begin(*words):
    return subprocess.Popen(
        [*COMMAND, *map(str, words)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _rows(folder):
    return Ledger.open(folder / "ledger.sqlite", read_only=True).rows()


@pytest.mark.slow
def test_runs_everything_once_and_a_failed_run_ends_nothing_else(bench, plan_path, tmp_path):
    folder = tmp_path / "B"
    plan = plan_path(
        methods=("sfm", "linear", "depth"), repeats=1, parameters={"depth": {"min_points": 9999}}
    )
    code, out, err = bench("--plan", plan, "-o", folder, "--jobs", 2)
    assert (code, err) == (1, "")
    assert len(re.findall(r"^\[\d/3\] room, ", out, re.MULTILINE)) == 3
    assert re.search(r"room, depth 2x, none, repeat 1 +expected .*9,?999", out)
    assert f"splatseed bench report {folder}" in out
    assert re.search(r"linear 2x +none +1 +\d+\.\d\d +[+-]\d", out)
    sfm, linear, depth = _rows(folder)
    assert [row.status for row in (sfm, linear, depth)] == ["done", "done", "failed"]
    assert linear.result.num_seeds == 2 * sfm.result.num_seeds
    assert {path.name for path in folder.iterdir()} == {
        "covisible", "ledger.sqlite", "plan.toml", "runs", "splatseed.json", "twins", "work"
    }  # fmt: skip
    assert not list((folder / "work").iterdir())

    code, out, _ = bench("-o", folder, "--retry-failed")
    assert code == 1
    assert [row.attempts for row in _rows(folder)] == [1, 1, 2]
    assert [row.finished for row in _rows(folder)][:2] == [sfm.finished, linear.finished]
    sessions = Ledger.open(folder / "ledger.sqlite", read_only=True).sessions()
    assert [session["command"].split()[:2] for session in sessions] == [["splatseed", "bench"]] * 2
    assert {"cpu", "cores", "python", "versions"} <= sessions[0].keys()


@pytest.mark.slow
def test_killed_at_any_moment_it_goes_on(plan_path, tmp_path):
    """SIGKILL in the middle of the second run's training."""
    folder = tmp_path / "B"
    plan = plan_path(repeats=1, max_steps=200)
    process = _begin("--plan", plan, "-o", folder)
    assert any(line.startswith("[1/2]") for line in process.stdout)
    until = time.monotonic() + 60
    while not list((folder / "work").glob("*/config.json")):
        assert time.monotonic() < until, "the second run did not begin"
        time.sleep(0.05)
    process.kill()
    process.communicate()
    done, killed = _rows(folder)
    assert [done.status, killed.status] == ["done", "running"]

    again = _begin("-o", folder)
    out, err = again.communicate(timeout=120)
    assert (again.returncode, err) == (0, "")
    assert "2 runs (1 done, 0 failed, 1 to do)" in out
    rows = _rows(folder)
    assert [row.status for row in rows] == ["done"] * 2
    assert [row.attempts for row in rows] == [1, 2]
    assert rows[0] == done


def test_two_processes_share_the_runs_of_one_folder(plan_path, tmp_path):
    folder = tmp_path / "B"
    plan = plan_path(methods=("sfm",), repeats=3)
    both = [_begin("--plan", plan, "-o", folder) for _ in range(2)]
    said = [process.communicate(timeout=240) for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    rows = _rows(folder)
    assert [(row.status, row.attempts) for row in rows] == [("done", 1)] * 3
    lines = [line for out, _ in said for line in out.splitlines() if line.startswith("[")]
    assert len(lines) == 3
    assert len({row.worker for row in rows}) == 2


@pytest.mark.slow
def test_ctrl_c_saves_and_says_how_to_go_on(plan_path, tmp_path):
    folder = tmp_path / "B"
    process = _begin("--plan", plan_path(repeats=1, methods=("sfm",), max_steps=5000), "-o", folder)
    until = time.monotonic() + 60
    while not list((folder / "work").glob("*/curve.csv")):
        assert time.monotonic() < until, "the run did not begin"
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "stopping" in err
    assert "Traceback" not in err
    assert f"splatseed bench -o {folder}" in out
    assert [row.status for row in _rows(folder)] == ["pending"]
    assert list((folder / "work").glob("*/checkpoint.pt"))


def test_a_dry_run_prints_a_plan_and_writes_nothing(bench, plan_path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = plan_path(profiles=("default", "paper"), methods=("sfm", "linear", "random"))
    code, out, err = bench("--plan", plan, "--repeats", 7, "--dry-run", "-o", "B")
    assert (code, err) == (0, "")
    assert "# 28 runs; this machine, 1 at a time, on the CPU" in out
    assert re.search(r"# about .* \(by a rough model.*\), .* kept", out)
    assert "# run once, as both profiles are the same: random" in out
    again = tmp_path / "again.toml"
    again.write_text(out)
    assert read_plan(again) == dataclasses.replace(read_plan(plan), repeats=7)
    assert not (tmp_path / "B").exists()


def test_presets_leave_out_what_is_not_there(bench, own_room, tmp_path):
    data = tmp_path / "360"
    for name, images in (("garden", "images_4"), ("bonsai", "images_2"), ("room", "images_8")):
        shutil.copytree(own_room, data / name)
        (data / name / "images").rename(data / name / images)
    code, out, _ = bench("--preset", "mipnerf360", "--data", data, "--dry-run", "--repeats", 1)
    assert code == 0
    assert "# not there: bicycle, counter, flowers, kitchen, stump, treehill" in out
    assert "# room is left out: expected the folder images_2" in out
    assert "# 32 runs" in out  # 2 scenes, and sfm and 5 methods at 3 ratios
    (tmp_path / "plan.toml").write_text(out)
    plan = read_plan(tmp_path / "plan.toml")
    assert plan.scenes == (
        PlannedScene(str(data / "bonsai"), "bonsai", "images_2"),
        PlannedScene(str(data / "garden"), "garden", "images_4"),
    )
    assert (plan.training.max_steps, plan.training.test_every) == (30_000, 8)
    assert plan.ratios == (4, 8, 16)
    for name in ("garden", "bonsai"):
        shutil.rmtree(data / name)
    code, out, err = bench("--preset", "mipnerf360", "--data", data, "--dry-run")
    assert (code, out) == (2, "")
    assert f"treehill; in room, expected the folder images_2 in {data / 'room'}, found no" in err
    assert err.endswith("folder. Name the folder that holds the preset's scenes with --data.\n")


def test_captures_of_replica_are_left_out_with_what_they_lack(bench, own_room, tmp_path):
    data = tmp_path / "replica"
    shutil.copytree(own_room, data / "room0")
    (data / "office1").mkdir()
    words = ("--preset", "replica", "--data", data, "--dry-run", "--repeats", 1)
    code, out, _ = bench(*words)
    assert code == 0
    assert "# office1 is left out: expected sparse/0, " in out
    assert "# 13 runs" in out  # sfm, and 6 methods at 2 ratios: the room has depth maps
    (own_room / "depths").rename(tmp_path / "maps")
    shutil.rmtree(data / "room0" / "depths")
    code, out, _ = bench(*words)
    assert "# 11 runs" in out
    assert "# without depth maps, and so without the method depth: room0 (--depth DIR)" in out
    (tmp_path / "captures").mkdir()
    (tmp_path / "maps").rename(tmp_path / "captures" / "room0")
    code, out, _ = bench(*words, "--depth", tmp_path / "captures")
    assert "# 13 runs" in out


def test_the_quick_preset_makes_its_own_scene(bench, tmp_path, monkeypatch):
    made = []

    def small_capture():
        made.append(1)
        return make_capture(0, num_views=9, width=64, height=48)

    monkeypatch.setattr(synthetic, "make_capture", small_capture)
    code, out, _ = bench("--preset", "quick", "--dry-run")
    assert code == 0
    assert "# 12 runs" in out
    assert 'path = "demo:"' in out
    path = folder_module.make_demo_scene(tmp_path / "B" / "scenes")
    assert len(load_scene(path).images) == 9
    assert bench("--preset", "quick", "--dry-run", "-o", tmp_path / "B")[0] == 0
    assert len(made) == 1  # the one that is there is taken, and without one none is made


def test_a_dry_run_of_the_quick_preset_loads_nothing_heavy():
    """It takes a second; to make the room and to import PyTorch took over a minute."""
    code = (
        "import sys; from splatseed.cli import main; main(['bench', '--preset', 'quick', "
        "'--dry-run']);"
        "print(*sys.modules)"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = set(run.stdout.splitlines()[-1].split())
    assert "# 12 runs" in run.stdout
    assert not {"torch", "matplotlib", "splatseed.synthetic"} & loaded


def test_what_is_said_of_the_room_before_it_is_made_is_so():
    made = {k: each.default for k, each in inspect.signature(make_capture).parameters.items()}
    said = folder_module.DEMO_FACTS
    assert (said.num_images, said.pixels) == (made["num_views"], made["width"] * made["height"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "-o BENCH"),
        (("-o", "B"), "--scenes DIR..., --preset or --plan"),
        (("-o", "B", "--scenes", "nowhere"), "nowhere"),
        (("-o", "B", "--scenes", "ROOM", "--methods", "magic"), "magic"),
        (("-o", "B", "--scenes", "ROOM", "--ratios", "1"), "ratios above 1"),
        (("-o", "B", "--scenes", "ROOM", "--strategies", "x"), "strategies"),
        (("-o", "B", "--scenes", "ROOM", "--jobs", "0"), "--jobs of 1"),
        (("-o", "B", "--scenes", "ROOM", "--address", "auto"), "--executor ray"),
        (("-o", "B", "--scenes", "ROOM", "ROOM"), "twice"),
        (("-o", "B", "--scenes", "ROOM", "--methods", "depth", "--depth", "a", "b"), "2 folders"),
        (("-o", "ROOM/B", "--scenes", "ROOM"), "apart from the input"),
        (("-o", "FULL", "--scenes", "ROOM"), "did not write"),
        (("-o", "ROOM", "--scenes", "demo:"), "files that splatseed did not write|wrote"),
        (("-o", "B", "--preset", "mipnerf360"), "--data DIR"),
        (("-o", "B", "--preset", "replica", "--data", "FULL"), "none of them"),
        (("-o", "B", "--preset", "replica", "--data", "FULL", "--scenes", "ROOM"), "--scenes"),
        (("-o", "B", "--preset", "quick", "--plan", "x.toml"), "both"),
        (("-o", "B", "--plan", "x.toml"), "x.toml"),
        (("-o", "B", "--data", "FULL"), "--preset with --data"),
        (("-o", "SONGS", "--scenes", "ROOM"), "another program"),
        (("-o", "B", "--scenes", "ROOM", "--lpips"), r"put it into [^ ]*checkpoints\.$"),
        (("--dry-run", "--scenes", "ROOM", "--lpips"), "weights for LPIPS"),
        (("-o", "TUNED", "--scenes", "ROOM"), "found what splatseed tune wrote"),
    ],
)
def test_bad_words_end_in_one_line(bench, room_path, tmp_path, monkeypatch, words, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "FULL").mkdir()
    (tmp_path / "FULL" / "thesis.txt").write_text("keep")
    (tmp_path / "TUNED").mkdir()
    (tmp_path / "TUNED" / "tune.json").write_text("{}")
    (tmp_path / "SONGS").mkdir()
    with sqlite3.connect(tmp_path / "SONGS" / "ledger.sqlite") as db:
        db.execute("CREATE TABLE songs (title TEXT)")
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "FULL"))
    words = [word.replace("ROOM", str(room_path)) for word in words]
    code, out, err = bench(*words)
    assert (code, out) == (2, "")
    assert re.search(said, err), err
    assert err.count("error:") == 1
    assert {path.name for path in tmp_path.iterdir()} == {"FULL", "SONGS", "TUNED"}
    assert [path.name for path in (tmp_path / "SONGS").iterdir()] == ["ledger.sqlite"]


def test_help_does_not_wait_for_pytorch():
    code = (
        "import sys, splatseed.commands.bench.command\n"
        "assert 'torch' not in sys.modules and 'gsplat' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(("budget", "full"), [("50", True), ("100k", False)])
def test_a_budget_that_the_points_fill_is_told(budget, full, plan_path, bench, tmp_path):
    plan = plan_path(methods=("sfm", "mls"), ratios=(), budgets=(budget,))
    run = bench("--plan", plan, "-o", tmp_path / "out", "--dry-run")
    assert run.code == 0, run.err
    assert ("add none" in run.out) == full


@pytest.mark.parametrize("words", [["--dry-run"], []])
def test_a_plan_without_a_run_is_refused(words, plan_path, bench, tmp_path):
    out = tmp_path / "out"
    run = bench("--plan", plan_path(methods=("cloud",)), "-o", out, *words)
    assert run.code == 2
    assert "expected a plan with runs" in run.err
    assert "without a scan" in run.err
    assert not out.exists()
