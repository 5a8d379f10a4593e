"""``splatseed train`` from its words to its exit code."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from splatseed import requirements
from splatseed.commands.train import Options, _next_commands
from splatseed.errors import MissingDependencyError
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.splat.metrics import LPIPS_FILES
from splatseed.train.record import resumed_settings

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


def test_resuming_nothing_is_told(room_path, tmp_path, capsys):
    words = (room_path, "--max-steps", "3", "--long-side", "48", "-o", tmp_path / "run", "--resume")
    assert _run(*words) == 0
    assert f"no run to resume in {tmp_path / 'run'}: a new one" in capsys.readouterr().out


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


def test_a_plain_scene_is_seeded_first_unless_it_is_to_stay(room_path, tmp_path, capsys):
    counts = {}
    for seeds in ("auto", "scene"):
        words = (room_path, "--max-steps", "3", "--data-factor", "2", "-o", tmp_path / seeds)
        assert _run(*words, *(("--seeds", "scene") if seeds == "scene" else ())) == 0
        assert ("Seeds by method auto" in capsys.readouterr().out) == (seeds == "auto")
        counts[seeds] = json.loads((tmp_path / seeds / "metrics.json").read_text())["num_seeds"]
    assert counts["auto"] > counts["scene"]


def test_seeds_that_cannot_be_made_are_told(room_path, tmp_path, capsys):
    seeded = tmp_path / "seeded"
    assert exit_code("upsample", room_path, "--method", "mls", "-o", seeded) == 0
    for scene, strategy, told in (
        (room_path, "none-3dgs", "strategy none-3dgs begins with the scene's points as they are."),
        (seeded, "none", "splatseed upsample made the points, and training begins with them"),
    ):
        words = (scene, "--max-steps", "2", "--data-factor", "2", "--strategy", strategy)
        for i, seeds in enumerate(((), ("--seeds", "auto"))):
            assert _run(*words, *seeds, "-o", tmp_path / f"{strategy}{i}") == 0
            said = capsys.readouterr().out
            assert (f"--seeds auto has no effect: {told}" in said) == bool(seeds)


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
    assert error.count("error:") == 1
    assert not (tmp_path / "run").exists()


def test_lpips_is_offered_only_where_its_weights_are(tmp_path, monkeypatch):
    monkeypatch.setattr("torch.hub.get_dir", lambda: str(tmp_path))
    monkeypatch.setattr("splatseed.splat.metrics.require", lambda *_: None)
    assert _next_commands(Path("my run")) == [("look at it", "splatseed view 'my run'")]
    weights = tmp_path / "checkpoints" / LPIPS_FILES["vgg"]
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


def test_missing_packages_are_named_with_the_command(monkeypatch):
    find_spec = importlib.util.find_spec
    monkeypatch.setattr(
        requirements, "find_spec", lambda name: None if name == "gsplat" else find_spec
    )
    with pytest.raises(MissingDependencyError, match=r"-m pip install .*'gsplat>=1.5.3,<1.6'"):
        requirements.require("torch", "gsplat")


def test_import_and_help_do_not_wait_for_pytorch():
    code = (
        "import sys, splatseed, splatseed.commands.train, splatseed.views.view\n"
        "assert 'torch' not in sys.modules and 'gsplat' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
