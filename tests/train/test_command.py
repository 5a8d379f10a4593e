"""``splatseed train`` from its words to its exit code."""

from __future__ import annotations

import json
import os
import shutil
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from splatseed.commands.train import Options
from splatseed.io import load_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.train.folder import RunFolder
from splatseed.train.run import make_config, resumed
from splatseed.train.seeds import usable_seeds
from splatseed.train.settings import TrainSettings
from splatseed.train.trainer import Trainer

from ..command_line import exit_code

_run = partial(exit_code, "train")
SHORT = ("--max-steps", "3", "--data-factor", "2")


def _json(path):
    return json.loads(path.read_text())


@pytest.mark.slow
def test_trains_and_says_what_and_where(room_path, tmp_path, capsys):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "10", "--data-factor", "2", "-o", run)
    assert _run(*words) == 0
    said = capsys.readouterr()
    assert "test PSNR" in said.out
    assert f"splatseed view {run}" in said.out
    assert not said.err
    metrics = _json(run / "metrics.json")
    assert {"psnr", "ssim", "per_image", "train_seconds", "tests"} <= metrics.keys()
    assert metrics["tests"][-1]["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    assert _run(*words) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_a_budget_is_gaussians_per_pixel_as_trained(room_path, tmp_path):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "40", "--data-factor", "2", "--strategy", "grow", "-o", run)
    assert _run(*words, "--budget", "0.25rho") == 0
    assert _json(run / "config.json")["cap_max"] == 48 * 36 // 4
    assert _json(run / "metrics.json")["num_gaussians"] <= 48 * 36 // 4


def test_without_a_strategy_the_length_of_the_run_says_which(room_path, tmp_path, capsys):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "3", "--long-side", "48", "-o", run)
    assert _run(*words) == 0
    said = capsys.readouterr().out
    assert "-> strategy grow (auto)," in said
    assert f"At most {48 * 36:,} Gaussians" in said
    config = _json(run / "config.json")
    assert (config["strategy"], config["cap_max"], config["seeding"]) == ("auto", 48 * 36, "auto")
    for strategy in ("none", "default"):
        assert _run(*words, "--strategy", strategy, "--overwrite") == 0
        config = _json(run / "config.json")
        assert (config["strategy"], config["cap_max"]) == (strategy, None)
        # Where nothing is named, a run goes on as it began.
        asked = Options(room_path, run, resume=True).settings
        again = replace(asked, max_steps=3, data_factor=2)
        begun = replace(again, strategy=strategy, seeding="auto")
        assert resumed(config, again, refine_poses=False) == (begun, False)


def test_interrupted_it_saves_and_says_how_to_go_on(room_path, tmp_path, capsys, monkeypatch):
    run, advance = tmp_path / "run", Trainer._advance

    def step(self, number):
        if number == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return advance(self, number)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_advance", step)
        assert _run(room_path, "--max-steps", "9", "--data-factor", "2", "-o", run) == 130
    assert f"-o {run} --resume" in capsys.readouterr().err
    assert (run / "checkpoint.pt").is_file()
    assert _run(room_path, "-o", run, "--resume") == 0
    assert _json(run / "metrics.json")["steps"] == 9


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
    assert said in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_a_cloud_alone_cannot_be_trained(tmp_path, capsys):
    cloud = tmp_path / "room.ply"
    write_ply(cloud, PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8)))
    for output in (tmp_path / "run", tmp_path):  # beside the cloud there is nothing wrong
        assert _run(cloud, "-o", output) == 2
        assert f"found points alone ({cloud})" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["room.ply"]


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
    metrics = _json(run / "metrics.json")
    assert metrics["steps"] == 3
    assert metrics["num_gaussians"] == metrics["num_seeds"]  # strategy none


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
        config = _json(run / "config.json")
        (run / "config.json").write_text(json.dumps(config | change))
    before = {path: path.read_bytes() for path in run.iterdir()}
    assert _run(room_path, "-o", run, "--resume") == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("error:") == 1
    assert {path: path.read_bytes() for path in run.iterdir()} == before
