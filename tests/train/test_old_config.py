"""Runs of earlier versions: their ``config.json`` is read, or refused in one sentence."""

from __future__ import annotations

import json
import shutil
from functools import partial

import pytest
import torch

from splatseed.io import load_scene
from splatseed.train.record import make_config, resumed_settings
from splatseed.train.seeds import usable_seeds
from splatseed.train.settings import TrainSettings

from ..command_line import exit_code

NEWER = ("placing", "seed_sizes", "seed_normals", "seed_colors", "seeding")
"""Settings that version 0.1.0 did not have."""
STEPS = 3


_run = partial(exit_code, "train")


@pytest.fixture
def old_config(room_path):
    """What version 0.1.0 wrote for a run on the scene's own points."""
    scene = load_scene(room_path)
    settings = TrainSettings(strategy="none", max_steps=STEPS, data_factor=2)
    seeds = usable_seeds(scene.points, settings, print)
    config = make_config(scene, seeds, settings, "cpu")
    config["splatseed"] = "0.1.0"
    return {name: value for name, value in config.items() if name not in NEWER}


@pytest.fixture
def old_run(old_config, tmp_path):
    """Its folder, interrupted before the first checkpoint."""
    run = tmp_path / "old"
    run.mkdir()
    (run / "config.json").write_text(json.dumps(old_config))
    manifest = {"command": "train", "files": ["config.json", "checkpoint.pt"]}
    (run / "splatseed.json").write_text(json.dumps(manifest))
    return run


def test_a_setting_that_an_old_run_lacks_is_at_its_default(old_config):
    settings = resumed_settings(old_config, TrainSettings())
    assert settings == TrainSettings(strategy="none", max_steps=STEPS, data_factor=2)


def test_an_old_run_resumes_with_its_own_settings(room_path, old_run):
    assert _run(room_path, "-o", old_run, "--resume") == 0
    metrics = json.loads((old_run / "metrics.json").read_text())
    assert metrics["steps"] == STEPS
    assert metrics["num_gaussians"] == metrics["num_seeds"]  # strategy none


def test_an_old_config_gives_the_options_of_a_new_run(old_run, tmp_path):
    new = tmp_path / "new"
    assert _run("--config", old_run / "config.json", "--seeds", "scene", "-o", new) == 0
    config = json.loads((new / "config.json").read_text())
    assert (config["strategy"], config["max_steps"], config["data_factor"]) == ("none", STEPS, 2)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"strategy": "absgrad"}, "--strategy"),
        ({"max_steps": "3"}, "config.json of the run"),
        ({"strategy": None}, "--strategy"),
        ({"seeds": {"count": 1, "digest": "0"}}, "the scene that the run began with"),
    ],
)
def test_an_old_config_that_cannot_be_followed_is_one_sentence(
    change, told, room_path, old_run, capsys
):
    path = old_run / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    assert _run(room_path, "-o", old_run, "--resume") == 2
    said = capsys.readouterr().err
    assert told in said
    assert said.count("error:") == 1
    assert "Traceback" not in said


def test_a_setting_that_no_longer_exists_is_named(old_run, tmp_path, capsys):
    path = old_run / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"opacity_resets": 1}))
    assert _run("--config", path, "-o", tmp_path / "new") == 2
    assert "'opacity_resets'. Did you mean opacity_reset?" in capsys.readouterr().err


def test_a_checkpoint_of_an_earlier_version_is_refused(room_path, old_run, capsys):
    torch.save({"format": 1, "step": 2}, old_run / "checkpoint.pt")
    kept = shutil.copytree(old_run, old_run.with_name("copy"))
    assert _run(room_path, "-o", old_run, "--resume") == 2
    assert "another kind or version of file" in capsys.readouterr().err
    for path in kept.iterdir():  # nothing was written
        assert (old_run / path.name).read_bytes() == path.read_bytes()
