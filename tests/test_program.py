"""What docs/program.md promises to programs: streams, JSON, logs, locks, plugins, extras."""

from __future__ import annotations

import importlib.util
import json
import logging
import subprocess
import sys
import time
from importlib.metadata import EntryPoint

import numpy as np
import pytest

import splatseed as ss
from splatseed.commands import info
from splatseed.errors import OutputError, PluginError
from splatseed.io.staging import reserved
from splatseed.methods.registry import GROUP

HOLD = """
import sys, time
from pathlib import Path
from splatseed.io.staging import reserved

with reserved(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def cloud(rng, tmp_path):
    """A file of 40 points, one of them twice."""
    xyz = rng.random((40, 3), np.float32)
    xyz[1] = xyz[0]
    path = tmp_path / "cloud.ply"
    ss.PointCloud(xyz, np.full(xyz.shape, 90, np.uint8)).write_ply(path)
    return path


@pytest.fixture
def holder(tmp_path):
    """A process that holds an output, as a verb does while it runs."""
    words = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


@pytest.mark.parametrize(
    "words",
    [
        ("upsample", "CLOUD", "-o", "OUT", "--overwrite"),
        ("train", "CLOUD", "-o", "OUT", "--resume"),
        ("export", "MODEL", "-o", "OUT"),
        ("evaluate", "MODEL", "--renders", "OUT"),
        ("bench", "-o", "OUT"),
    ],
)
def test_an_output_is_written_by_one_process_until_that_is_killed(
    words, holder, cloud, tmp_path, splatseed
):
    names = {"CLOUD": cloud, "OUT": tmp_path / "out"}
    words = [names.get(word, word) for word in words]
    began = time.monotonic()
    run = splatseed(*words)
    assert (run.code, run.out) == (2, "")
    assert run.err.startswith(f"error: expected no other process that writes {tmp_path / 'out'};")
    assert time.monotonic() - began < 30
    holder.kill()
    holder.wait()
    assert (tmp_path / ".out.lock").is_file()  # which blocks nothing
    assert "other process" not in splatseed(*words).err
    assert {path.name for path in tmp_path.iterdir()} <= {"cloud.ply", "out"}


def test_a_function_holds_its_output_too(tmp_path):
    pytest.importorskip("gsplat", reason="trains")
    with reserved(tmp_path / "new" / "run"):
        assert (tmp_path / "new").is_dir()
        with pytest.raises(OutputError, match="no other process"):
            ss.train("scene", tmp_path / "new" / "run")
    assert not list(tmp_path.iterdir())


def test_one_object_holds_what_is_printed(cloud, tmp_path, splatseed):
    words = ("upsample", cloud, "--method", "linear", "--ratio", 2, "-o")
    plain = splatseed(*words, tmp_path / "a")
    run = splatseed(*words, tmp_path / "b", "--json")
    made = json.loads(run.out)
    assert (made["num_points"], made["method"]) == (78, "linear")
    assert made["output"] == str(tmp_path / "b")
    assert "78 (39 original, 39 linear)" in plain.out
    notes = [line.removeprefix("note: ") for line in plain.err.splitlines() if "note: " in line]
    assert [f"{each['text']} {each['fix']}".strip() for each in made["findings"]] == notes
    assert notes
    shown = splatseed("info", cloud)
    facts = json.loads(splatseed("info", cloud, "--json").out)
    assert facts["points"]["num_points"] == 40
    assert facts["points"]["duplicates"] == 1
    for text in (facts["verdict"], facts["advice"], *facts["reasons"], "40"):
        assert text in shown.out
    for each in facts["next"]:
        assert each["command"] in shown.out
    assert (facts["planned"]["max_steps"], facts["planned"]["trainer"]) == (30_000, "splatseed")


def test_what_other_libraries_print_is_no_part_of_it(cloud, splatseed, monkeypatch):
    read = info.load_scene
    monkeypatch.setattr(
        info, "load_scene", lambda *a, **k: (sys.stdout.write("loud"), read(*a, **k))[1]
    )
    run = splatseed("info", cloud, "--json")
    assert json.loads(run.out)["points"]["num_points"] == 40
    assert "loud" in run.err
    assert splatseed("info", cloud).out.startswith("loud")  # and nothing lasts


def test_results_are_apart_from_messages(cloud, tmp_path, splatseed):
    words = ("upsample", cloud, "--method", "linear", "-o")
    quiet = splatseed(*words, tmp_path / "a", "--quiet")
    assert "points out" in quiet.out
    assert "  -> " not in quiet.err
    log = tmp_path / "made.log"
    loud = splatseed(*words, tmp_path / "b", "--verbose", "--log", log)
    assert "  -> linear" in loud.err
    assert "linear: done" in loud.err
    assert "points out" not in loud.err
    text = log.read_text()
    assert "linear: done" in text
    assert f"splatseed upsample {cloud}" in text.splitlines()[0]
    refused = splatseed(*words, tmp_path / "b", "--quiet", "--log", log)
    assert (refused.code, refused.err.count("\n")) == (2, 1)
    added = log.read_text().removeprefix(text)
    assert "Traceback" in added
    assert added.splitlines()[-1].endswith(refused.err.removeprefix("error: ").strip())
    assert "Traceback" in splatseed(*words, tmp_path / "b", "--verbose").err
    assert splatseed(*words, tmp_path / "c", "--verbose", "--quiet").code == 2
    lost = splatseed(*words, tmp_path / "c", "--log", tmp_path / "none" / "log")
    assert (lost.code, lost.err.count("\n")) == (2, 1)


def test_stdout_is_no_output(cloud, tmp_path, splatseed, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in (("upsample", cloud), ("export", cloud), ("train", cloud)):
        run = splatseed(*words, "-o", "-")
        assert (run.code, run.out, "--json" in run.err) == (2, "", True)
    assert [path.name for path in tmp_path.iterdir()] == [cloud.name]


@pytest.mark.parametrize("fails", ["def __post_init__(self)", "def __call__(self, *_)"])
def test_anothers_exception_names_package_and_entry_point(
    fails, cloud, tmp_path, splatseed, monkeypatch
):
    code = f"""
from dataclasses import dataclass

@dataclass(frozen=True)
class Wrong:
    {fails}:
        raise ZeroDivisionError("by\\nnothing")
"""
    (tmp_path / "wrong_method.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "wrong_method", None)
    monkeypatch.delitem(sys.modules, "wrong_method")
    entry = EntryPoint("wrong", "wrong_method:Wrong", GROUP)
    monkeypatch.setitem(ss.METHODS._plugins, "wrong", entry)
    run = splatseed("upsample", cloud, "--method", "wrong", "-o", tmp_path / "out")
    assert (run.code, "Traceback" in run.err) == (2, False)
    assert "method 'wrong', wrong_method:Wrong of the package" in run.err
    assert "ZeroDivisionError: by nothing" in run.err
    assert f"{tmp_path / 'wrong_method.py'}, line 7" in run.err
    scene = ss.load_scene(cloud)
    with pytest.raises(PluginError) as caught:
        ss.upsample(scene, "wrong")
    assert isinstance(caught.value.__cause__, ZeroDivisionError)


def test_all_that_a_command_needs_is_named_before_it_begins(tmp_path, splatseed, monkeypatch):
    absent = {"torch", "pycolmap", "viser"}
    find = importlib.util.find_spec
    monkeypatch.setattr(
        "splatseed.requirements.find_spec", lambda name: None if name in absent else find(name)
    )
    run = splatseed("train", "nowhere", "-o", tmp_path / "run", "--refine-poses", "--view")
    assert (run.code, run.err.count("\n")) == (2, 1)
    assert "found no torch, no viser, no pycolmap." in run.err
    assert "(extra train and view and sfm)" in run.err
    assert "--extra-index-url https://download.pytorch.org/whl/cpu." in run.err


def test_functions_log_what_they_find(cloud, caplog):
    scene = ss.load_scene(cloud)
    with caplog.at_level(logging.INFO, "splatseed"):
        ss.upsample(scene)
    (record,) = caplog.records
    assert (record.name, record.levelname) == ("splatseed", "INFO")
    assert record.finding.kind == "fallback-method"
    assert record.getMessage() == str(record.finding)
    caplog.clear()
    ss.upsample(scene, note=lambda _: None)
    assert not caplog.records
