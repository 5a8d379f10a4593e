"""``splatseed train`` from its words to its exit code."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseed.commands.train import Options, _next_commands
from splatseed.io import load_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.splat.metrics import LPIPS_FILE
from splatseed.train.folder import RunFolder
from splatseed.train.record import make_config, resumed_settings
from splatseed.train.seeds import usable_seeds
from splatseed.train.settings import TrainSettings

from ..command_line import exit_code

_run = partial(exit_code, "train")


@pytest.mark.slow
def test_trains_and_says_what_and_where(room_path, tmp_path, capsys):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "10", "--data-factor", "2", "-o", run)
    assert _run(*words) == 0
    said = capsys.readouterr()
    assert "test PSNR" in said.out
    assert f"splatseed view {run}" in said.out
    assert not said.err
    metrics = json.loads((run / "metrics.json").read_text())
    assert {"psnr", "ssim", "per_image", "train_seconds", "tests"} <= metrics.keys()
    assert metrics["tests"][-1]["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    assert _run(*words) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_budget_is_gaussians_per_pixel_as_trained(room_path, tmp_path):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "40", "--data-factor", "2", "--strategy", "grow", "-o", run)
    assert _run(*words, "--budget", "0.25rho") == 0
    assert json.loads((run / "config.json").read_text())["cap_max"] == 48 * 36 // 4
    assert json.loads((run / "metrics.json").read_text())["num_gaussians"] <= 48 * 36 // 4


def test_without_a_strategy_the_length_of_the_run_says_which(room_path, tmp_path, capsys):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "3", "--long-side", "48", "-o", run)
    assert _run(*words) == 0
    said = capsys.readouterr().out
    assert "-> strategy grow (auto)," in said
    assert f"At most {48 * 36:,} Gaussians" in said
    config = json.loads((run / "config.json").read_text())
    assert (config["strategy"], config["cap_max"]) == ("auto", 48 * 36)
    for strategy in ("none", "default"):
        assert _run(*words, "--strategy", strategy, "--overwrite") == 0
        config = json.loads((run / "config.json").read_text())
        assert (config["strategy"], config["cap_max"]) == (strategy, None)
        # Where nothing is named, a run goes on as it began.
        asked = Options(room_path, run, resume=True).settings
        assert resumed_settings(config, replace(asked, max_steps=3, data_factor=2)) == replace(
            asked, strategy=strategy, seeding="auto", max_steps=3, data_factor=2
        )


def test_a_plain_scene_is_seeded_first_unless_it_is_to_stay(room_path, tmp_path):
    counts = {}
    for seeds in ("auto", "scene"):
        words = (room_path, "--max-steps", "3", "--data-factor", "2", "-o", tmp_path / seeds)
        # Where there is no run to resume, one begins.
        assert _run(*words, *(("--seeds", "scene", "--resume") if seeds == "scene" else ())) == 0
        counts[seeds] = json.loads((tmp_path / seeds / "metrics.json").read_text())["num_seeds"]
    assert counts["auto"] > counts["scene"]


def test_interrupted_it_saves_and_says_how_to_go_on(room_path, tmp_path):
    """A process of its own, interrupted by a signal once it trains."""
    run = tmp_path / "run"
    code = (
        "import os, signal, sys\n"
        "from splatseed.cli import main\n"
        "from splatseed.train.trainer import Trainer\n"
        "advance = Trainer._advance\n"
        "def step(self, number):\n"
        "    if number == 3: os.kill(os.getpid(), signal.SIGINT)\n"
        "    return advance(self, number)\n"
        "Trainer._advance = step\n"
        "main(sys.argv[1:])\n"
    )
    words = ["train", str(room_path), "--max-steps", "9", "--data-factor", "2", "-o", str(run)]
    stopped = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False
    )
    assert stopped.returncode == 130, stopped.stderr
    assert "--resume" in stopped.stderr
    assert "Traceback" not in stopped.stderr
    assert (run / "checkpoint.pt").is_file()
    assert _run(room_path, "-o", run, "--resume") == 0
    assert json.loads((run / "metrics.json").read_text())["steps"] == 9


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--max-steps", "0"), "--max-steps"),
        (("--strategy", "magic"), "strategy"),
        (("--data-factor", "50"), "data-factor"),
        (("--data-factor", "2", "--long-side", "48"), "--long-side or --data-factor"),
        (("--long-side", "0"), "--long-side of 1 or more"),
    ],
)
def test_bad_words_end_in_one_line(room_path, tmp_path, capsys, words, said):
    assert _run(room_path, "-o", tmp_path / "run", *words) == 2
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert not (tmp_path / "run").exists()


def test_lpips_is_offered_only_where_its_weights_are(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.hub.get_dir", lambda: str(tmp_path))
    monkeypatch.setattr("splatseed.splat.metrics.require", lambda *_: None)
    assert _next_commands(Path("my run")) == [("look at it", "splatseed view 'my run'")]
    weights = tmp_path / "checkpoints" / LPIPS_FILE
    weights.parent.mkdir()
    weights.touch()
    assert _next_commands(Path("r"))[1] == ("score again, with LPIPS", "splatseed evaluate r")


def test_a_cloud_alone_cannot_be_trained(tmp_path, capsys):
    write_ply(
        tmp_path / "room.ply", PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8))
    )
    for output in (tmp_path / "run", tmp_path):  # beside the cloud there is nothing wrong
        assert _run(tmp_path / "room.ply", "-o", output) == 2
        error = capsys.readouterr().err
        assert f"found points alone ({tmp_path / 'room.ply'})" in error
        assert "apart from the input" not in error
    assert [each.name for each in tmp_path.iterdir()] == ["room.ply"]


def test_import_and_help_do_not_wait_for_pytorch():
    code = (
        "import sys, splatseed, splatseed.commands.train, splatseed.views.view\n"
        "assert 'torch' not in sys.modules and 'gsplat' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.fixture(scope="module")
def begun(room_path, tmp_path_factory):
    """A run that was killed before its first checkpoint, by a version without some settings."""
    run = tmp_path_factory.mktemp("old") / "run"
    settings = TrainSettings(strategy="none", max_steps=3, data_factor=2)
    scene = load_scene(room_path)
    config = make_config(scene, usable_seeds(scene.points, settings, print), settings, "cpu")
    for name in ("placing", "seed_sizes", "seed_normals", "seed_colors", "seeding"):
        del config[name]
    RunFolder(run).begin(config)
    return run


def test_a_run_of_an_older_version_resumes_with_its_own_settings(room_path, begun, tmp_path):
    run = shutil.copytree(begun, tmp_path / "run")
    assert _run(room_path, "-o", run, "--resume") == 0
    metrics = json.loads((run / "metrics.json").read_text())
    assert metrics["steps"] == 3
    assert metrics["num_gaussians"] == metrics["num_seeds"]  # strategy none


def test_a_config_gives_the_options_of_a_new_run(begun, tmp_path, capsys):
    new = tmp_path / "new"
    path = shutil.copy(begun / "config.json", tmp_path)
    assert _run("--config", path, "--seeds", "scene", "-o", new) == 0
    config = json.loads((new / "config.json").read_text())
    assert (config["strategy"], config["max_steps"], config["data_factor"]) == ("none", 3, 2)
    Path(path).write_text(json.dumps(config | {"opacity_resets": 1}))
    assert _run("--config", path, "-o", tmp_path / "other") == 2
    assert "opacity_resets" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"strategy": "absgrad"}, "--strategy"),
        ({"max_steps": "3"}, "config.json"),
        ({"strategy": None}, "--strategy"),
        ({"seeds": {"count": 1, "digest": "0"}}, "the scene that the run began with"),
        (None, "checkpoint.pt"),
    ],
)
def test_a_run_that_cannot_be_followed_is_one_sentence_and_stays(
    change, told, room_path, begun, tmp_path, capsys
):
    run = shutil.copytree(begun, tmp_path / "run")
    if change is None:
        torch.save({"format": 1, "step": 2}, run / "checkpoint.pt")
    else:
        config = json.loads((run / "config.json").read_text())
        (run / "config.json").write_text(json.dumps(config | change))
    before = {path: path.read_bytes() for path in run.iterdir()}
    assert _run(room_path, "-o", run, "--resume") == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("error:") == 1
    assert {path: path.read_bytes() for path in run.iterdir()} == before
