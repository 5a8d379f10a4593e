"""``splatseed train`` from its words to its exit code."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.ply import write_ply
from splatseed.pointcloud import PointCloud
from splatseed.training.config import make_config, resumed_settings
from splatseed.training.folder import RunFolder
from splatseed.training.seeds import seeds_facts, usable_seeds
from splatseed.training.settings import TrainSettings
from splatseed.training.trainer import Trainer

from ..command_line import exit_code

_run = partial(exit_code, "train")
SHORT = ("--max-steps", "3", "--data-factor", "2")


def _json(path):
    return json.loads(path.read_text())


def test_trains_by_the_best_strategy_and_says_what_and_where(room_path, tmp_path, capsys):
    run = tmp_path / "run"
    words = (room_path, "--max-steps", "3", "--long-side", "40", "--test-every", "8", "-o", run)
    assert _run(*words) == 0
    said = capsys.readouterr()
    size = "rho of 40 x 30 pixels"  # 96 x 72, divided by 2.4
    for words_said in ("-> strategy grow (auto),", f"At most {40 * 30:,} Gaussians: 1{size}"):
        assert words_said in said.err
    for words_said in ("test PSNR", f"splatseed view {run}"):
        assert words_said in said.out
    config, metrics = _json(run / "config.json"), _json(run / "metrics.json")
    assert (config["strategy"], config["cap_max"]) == ("auto", 40 * 30)
    assert config["seeding"] == "advised"
    assert {"psnr", "ssim", "per_image", "train_seconds", "tests"} <= metrics.keys()
    assert metrics["tests"][-1]["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    assert exit_code("evaluate", run) == 0
    assert re.search(r"data factor +2\.4\n", capsys.readouterr().out)
    assert _run(*words) == 2
    assert "--overwrite" in capsys.readouterr().err
    quarter = 40 * 30 // 4
    for strategy, budget, cap in (
        ("default", (), None),
        ("none", ("--budget", "0.25rho"), quarter),
    ):
        assert _run(*words, "--strategy", strategy, *budget, "--overwrite") == 0
        config = _json(run / "config.json")
        assert (config["strategy"], config["cap_max"]) == (strategy, cap)
        assert (f"{cap} Gaussians: 0.25{size}" in capsys.readouterr().err) == bool(budget)
    # Where nothing is named, a run goes on as it began.
    asked = TrainSettings()
    again = replace(asked, max_steps=3, data_factor=2.4)
    begun = replace(again, strategy="none", seeding="advised", cap_max=quarter)
    assert resumed_settings(config, again, refine_poses=False) == (begun, False)
    with pytest.raises(ParameterError, match="max_steps=3"):
        resumed_settings(config, asked, {"max_steps"}, refine_poses=False)


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


def test_a_cloud_alone_cannot_be_trained(tmp_path, capsys):
    cloud = tmp_path / "room.ply"
    write_ply(cloud, PointCloud(np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8)))
    for output in (tmp_path / "run", tmp_path):  # beside the cloud there is nothing wrong
        assert _run(cloud, "-o", output) == 2
        assert f"found points alone ({cloud})" in capsys.readouterr().err
    assert [each.name for each in tmp_path.iterdir()] == ["room.ply"]


@pytest.fixture(scope="module")
def begun(room_path, tmp_path_factory):
    """A run that was killed before its first checkpoint."""
    run = tmp_path_factory.mktemp("begun") / "run"
    settings = TrainSettings(strategy="none", max_steps=3, data_factor=2)
    scene = load_scene(room_path)
    seeds = seeds_facts(usable_seeds(scene.points, settings, print))
    config = make_config(scene, seeds, settings, "cpu")
    RunFolder(run).create(config)
    return run


def test_a_killed_run_resumes_with_its_own_settings(room_path, begun, tmp_path):
    run = shutil.copytree(begun, tmp_path / "run")
    assert _run(room_path, "-o", run, "--resume") == 0
    metrics = _json(run / "metrics.json")
    assert metrics["steps"] == 3
    assert metrics["num_gaussians"] == metrics["num_seeds"]  # strategy none


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"splatseed": "0.1"}, "one of version 0.1"),
        ({"strategy": "absgrad"}, "--strategy"),
        ({"max_steps": "3"}, "config.json"),
        ({"seeds": {"count": 1, "digest": "0"}}, "the scene of the run"),
        ({"photographs": "0"}, "photographs or poses"),
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


def test_large_photographs_are_smaller_by_default_and_stay_so(
    room_path, tmp_path, capsys, monkeypatch
):
    """The run, its resumption and its scores are at the size that the default chose at first."""
    run, advance = tmp_path / "run", Trainer._advance

    def step(self, number):
        if number == 1:
            os.kill(os.getpid(), signal.SIGINT)
        return advance(self, number)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_advance", step)
        for module in ("training.settings", "photos.sizes"):
            patch.setattr(f"splatseed.{module}.TRAINED_SIDE", 48)
        assert _run(room_path, "--max-steps", "3", "--strategy", "none", "-o", run) == 130
    assert (
        "96 x 72 pixels are used at 48 x 36, as the default is 48 a side" in capsys.readouterr().err
    )
    assert _json(run / "config.json")["data_factor"] == 2
    assert _run(room_path, "-o", run, "--resume") == 0  # with a default that changes nothing
    assert "48 x 36" in capsys.readouterr().err
    assert _run(room_path, "--data-factor", "1", "-o", run, "--resume") == 2
