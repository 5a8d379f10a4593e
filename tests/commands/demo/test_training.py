"""``splatseed demo`` goes the whole way, and says what its numbers do not show."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image

from splatseed import load_scene
from splatseed.commands.demo import command as demo
from splatseed.errors import MissingDependencyError
from splatseed.scores import CurvePoint, TrainingResult

WORDS = ("demo", "--views", "4")


def test_the_demo_trains_from_each_set_of_seeds(splatseed, tmp_path):
    pytest.importorskip("gsplat", reason="training needs PyTorch and gsplat's strategies")
    out = tmp_path / "demo"
    run = splatseed(*WORDS, "-o", out, "--train-steps", "44")
    assert run.code == 0, run
    seeded = json.loads((out / "scene_auto/splatseed.json").read_text())
    counts = {}
    for name in ("random", "poses_auto", "sfm", "auto"):
        metrics = json.loads((out / f"run_{name}/metrics.json").read_text())
        config = json.loads((out / f"run_{name}/config.json").read_text())
        assert metrics["steps"] == 44
        assert config["strategy"] == "default"
        assert config["cap_max"] == seeded["num_points"]
        counts[name] = metrics["num_gaussians"]
        assert f"{metrics['psnr']:.2f}" in run.out
    assert counts["auto"] == seeded["num_points"]
    alone = load_scene(out / "scene_poses_auto").points
    assert len(alone) > seeded["num_original"]
    assert not alone.num_original  # no point of the scene was known
    assert len(load_scene(out / "scene_random").points) == 100_000
    assert seeded["num_original"] < counts["sfm"] <= counts["auto"]  # a round adds half at most
    assert "no error bars" in run.out
    with Image.open(out / "preview_trained.png") as file:
        pixels = np.asarray(file)
    assert pixels.shape[1] > 3 * 400
    assert pixels.shape[0] > 2 * 300
    # What the demo says to run next works: its runs know their scenes by where they lie now.
    again = splatseed("evaluate", out / "run_auto")
    assert again.code == 0, again
    assert f"{metrics['psnr']:.2f}" in again.out


@pytest.mark.parametrize(("seconds", "psnr"), [(2.4, None), (2.5, 20.0), (9.9, 22.0)])
def test_psnr_after_some_seconds_counts_those_of_the_seeds(seconds, psnr):
    training = pytest.importorskip("splatseed.commands.demo.training", reason="needs PyTorch")
    tests = ((10, 0.5, 20.0), (20, 1.0, 22.0), (30, 1.5, 25.0))  # the last is of the mean
    curve = tuple(CurvePoint(*test, 100) for test in tests)
    arm = training.Arm("auto", None, None, seconds=2.0)
    result = TrainingResult(None, curve, steps=30, train_seconds=1.5, num_seeds=100)
    each = training.TrainedArm(arm, result, None, None)
    assert training.psnr_after(seconds, each) == psnr
    assert training.total_seconds(each) == 3.5


def test_without_pytorch_the_demo_says_what_to_install(splatseed, tmp_path, monkeypatch):
    def absent(*_):
        raise MissingDependencyError(
            "the packages", found="no torch", fix="Install them: pip install 'torch>=2.4'."
        )

    monkeypatch.setattr(demo, "require", absent)
    run = splatseed(*WORDS, "-o", tmp_path / "demo")
    assert run.code == 0, run
    assert "not trained: no torch installed" in run.out
    assert "pip install 'torch>=2.4'" in run.out
    assert "splatseed evaluate" not in run.out
    assert not (tmp_path / "demo" / "run_sfm").exists()
    assert (tmp_path / "demo" / "geometry.csv").is_file()


def test_negative_steps_are_refused(splatseed, tmp_path):
    run = splatseed(*WORDS, "--train-steps", "-1", "-o", tmp_path / "demo")
    assert run.code == 2
    assert "--train-steps" in run.err
    assert not (tmp_path / "demo").exists()
