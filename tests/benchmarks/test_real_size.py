"""The benchmark of real captures: its stages, its parts of captures, and its tables."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

from splatseed import console
from splatseed.io import load_scene

MODULES = ("real_size", "common.stages")


@pytest.fixture(scope="module")
def captures(room_of, tmp_path_factory):
    """A folder with a capture that goes by the name of a real one."""
    folder = tmp_path_factory.mktemp("captures")
    shutil.copytree(room_of(9, 64, 48).path, folder / "plush")
    return folder


def test_the_stages_of_a_command_are_those_it_reports(bench, captures, monkeypatch, tmp_path):
    monkeypatch.setattr(console, "StageClock", console.StageClock)  # put back afterwards
    words = ["upsample", str(captures / "plush"), "--method", "linear", "-o", str(tmp_path / "out")]
    stages = {each["name"]: each for each in bench.stages.run_command(words)}
    assert next(iter(stages)) == "start"
    assert {"read", "write"} < set(stages)
    assert all(each["seconds"] >= 0 and each["processor"] >= 0 for each in stages.values())
    assert stages["write"]["seconds"] > 0
    assert (tmp_path / "out" / "sparse" / "0" / "points3D.bin").is_file()


def test_a_stage_that_comes_again_is_added_to_itself(bench, monkeypatch):
    times = iter([0.0, 1.0, 3.0, 6.0, 10.0])
    monkeypatch.setattr(bench.stages, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    watch = bench.stages.StageWatch()
    for name in ("read", "read", "match", "read"):
        watch.begin(name)
    found = {each.name: each.seconds for each in watch.stages()}
    assert found == {"start": 1.0, "read": 2.0 + 4.0, "match": 3.0}


def test_processes_that_a_stage_starts_count(bench):
    watch = bench.stages.StageWatch()
    watch.begin("child")
    # Half a second on a core, and 200 MB; it ends within the stage.
    work = "import time; b = bytearray(2 * 10**8)\nwhile time.process_time() < 0.5: pass"
    subprocess.run([sys.executable, "-c", work], check=True)
    watch.begin("own")
    start, child, own = watch.stages()
    assert [each.name for each in (start, child, own)] == ["start", "child", "own"]
    assert child.processor > 0.45
    assert own.processor < 0.2
    assert child.peak > own.peak + 150_000_000


def test_a_part_of_a_capture_has_its_first_photographs(bench, captures, monkeypatch, tmp_path):
    monkeypatch.setattr(bench.real_size, "find_scenes", lambda: captures)
    settings = bench.real_size.Settings(("plush",), first=4, work=tmp_path)
    capture = bench.real_size.prepare("plush", settings)
    whole = sorted(image.name for image in load_scene(captures / "plush").images)
    assert sorted(image.name for image in load_scene(capture.path).images) == whole[:4]
    assert sorted(each.name for each in capture.photographs.iterdir()) == whole[:4]
    assert capture.posed == capture.path  # it has points, so its poses need no refinement


def test_frames_of_an_export_keep_their_companions(bench, tmp_path):
    whole, part = tmp_path / "export", tmp_path / "part"
    whole.mkdir()
    for name in ("frame_00003.jpg", "frame_00003.json", "depth_00003.png", "info.json",
                 "frame_00006.jpg"):  # fmt: skip
        (whole / name).write_text(name)
    bench.real_size._link_frames(whole, ["frame_00003.jpg"], part)
    assert sorted(each.name for each in part.iterdir()) == [
        "depth_00003.png", "frame_00003.jpg", "frame_00003.json", "info.json",
    ]  # fmt: skip


def test_results_are_kept_and_measured_again_one_by_one(
    bench, captures, monkeypatch, tmp_path, capsys
):
    measured = []

    def measure(stage, capture):
        measured.append(stage)
        parts = {"read": 3.0, "stereo": 6.9, "write": 0.1 * len(measured)}
        return {
            "parts": [
                {"name": name, "seconds": each, "processor": 2 * each, "peak": 2_000_000_000}
                for name, each in parts.items()
            ],
            "made": "7 points",
        }

    monkeypatch.setattr(bench.real_size, "find_scenes", lambda: captures)
    monkeypatch.setattr(bench.real_size, "measure", measure)
    for stages in (("dense", "auto"), ("dense",), ()):
        bench.real_size.main(bench.real_size.Settings(("plush",), stages, work=tmp_path))
    assert measured == ["auto", "dense", "dense"]
    assert set(json.loads((tmp_path / "results.json").read_text())) == {"plush/auto", "plush/dense"}
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("| plush")
    ]
    assert rows[-4] == ["plush", "auto", "10.0", "20.0", "2.00", "7 points"]
    assert rows[-3] == ["plush", "dense", "10.2", "20.4", "2.00", "7 points"]
    assert rows[-2] == ["plush", "auto", "read 30%, stereo 69%, others 1%"]


def test_without_the_capture_the_reason_is_printed(bench, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(bench.real_size, "find_scenes", lambda: tmp_path)
    bench.real_size.main(bench.real_size.Settings(("corridor",), work=tmp_path / "work"))
    assert "SKIPPED corridor: expected the capture corridor; found none" in capsys.readouterr().out
