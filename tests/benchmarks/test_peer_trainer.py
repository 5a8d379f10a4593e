"""The comparison with gsplat's trainer: views, settings, and what stands in for CUDA."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import pytest
import torch

from splatseed.errors import MissingDependencyError, ParameterError, SceneNotFoundError
from splatseed.photos.loading import load_split
from splatseed.splat.ssim import l1_and_ssim_by_convolution

MODULES = (
    "common.children",
    "training.peer_trainer",
    "training.peer_runs",
    "training.peer_stand_ins",
)


@pytest.fixture(scope="module")
def room(room_of, tmp_path_factory):
    path = tmp_path_factory.mktemp("room") / "room"
    return Path(shutil.copytree(room_of(12, 96, 72).path, path))


def test_validation_views_are_of_the_training_views(bench, room):
    whole = bench.peer_runs.read_scene(room, "test")
    within = bench.peer_runs.read_scene(room, "validation")
    train, test = load_split(whole)
    kept, test_views = load_split(within)
    names = [view.name for view in train]
    assert [view.name for view in test_views] == names[::8]
    assert {view.name for view in (*kept, *test_views)} == set(names)
    assert not {view.name for view in test} & set(names)


def test_ssim_and_its_gradient_are_those_of_convolutions(bench):
    torch.manual_seed(0)
    x, y = torch.rand(1, 3, 20, 31, requires_grad=True), torch.rand(1, 3, 20, 31)
    found = bench.peer_stand_ins.fused_ssim(x, y, padding="valid")
    (2 * found).backward()
    pair = x[0].permute(1, 2, 0), y[0].permute(1, 2, 0)
    _, expected, slopes = l1_and_ssim_by_convolution(*pair, 0.0, 1.0)  # of 1 - SSIM
    torch.testing.assert_close(found, expected, atol=1e-6, rtol=0)
    torch.testing.assert_close(x.grad[0].permute(1, 2, 0), -2 * slopes, atol=1e-7, rtol=1e-4)


def test_both_trainers_get_the_same_settings(bench):
    peer_trainer = bench.peer_trainer
    settings = peer_trainer.Settings(Path(), max_steps=50, cap_max=900, data_factor=3)
    for arm in peer_trainer.ARMS:
        chosen = peer_trainer.train_settings(arm, 4, settings)
        expected = None if "default" in arm else 900
        assert (chosen["cap_max"], chosen["max_steps"], chosen["seed"]) == (expected, 50, 4)
        held = dataclasses.replace(settings, cap_default=True)
        assert peer_trainer.train_settings(arm, 4, held)["cap_max"] == 900


def test_a_run_that_fails_does_not_cost_the_others(bench, monkeypatch, capsys):
    def run_arm(arm, seed, *_):
        if (arm, seed) == ("gsplat-default", 0):
            raise bench.children.ChildError("a run", found="none", fix="Try again.")
        return {"psnr": float(seed)}

    monkeypatch.setattr(bench.peer_trainer, "run_arm", run_arm)
    settings = bench.peer_trainer.Settings(
        Path(), repeats=2, arms=("gsplat-default", "splatseed-default")
    )
    results = bench.peer_trainer.compare(Path(), settings)
    assert results["gsplat-default"] == [{"psnr": 1.0}]
    assert results["splatseed-default"] == [{"psnr": 0.0}, {"psnr": 1.0}]
    assert "SKIPPED gsplat-default, seed 0: expected a run" in capsys.readouterr().out


def test_a_folder_that_is_not_the_peers_is_refused(bench, tmp_path):
    check = bench.peer_stand_ins.check_examples
    with pytest.raises(MissingDependencyError, match=r"--gsplat-examples.*none named.*git clone"):
        check(None)
    with pytest.raises(SceneNotFoundError, match="none at"):
        check(tmp_path / "none")
    with pytest.raises(MissingDependencyError, match="no such file"):
        check(tmp_path)


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"arms": ("gsplat-default", "brush")}, "found brush"),
        ({"repeats": 0}, "--repeats of 1 or more"),
        ({"cap_default": True}, "--cap-max with --cap-default"),
        ({"max_steps": 0}, "max_steps"),
    ],
)
def test_options_that_make_no_sense_are_refused(bench, wrong, says):
    with pytest.raises(ParameterError, match=says):
        bench.peer_trainer.Settings(Path(), **wrong)
