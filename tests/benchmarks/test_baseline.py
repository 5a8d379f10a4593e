"""The benchmark of the training schedule: its arms, its held-out views, its ledger."""

from __future__ import annotations

import shutil

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene
from splatseed.training import TrainSettings
from splatseed.training.schedule import make_schedule

MODULES = ("training.baseline", "training.baseline_arms")


@pytest.fixture(scope="module")
def captures(room_of, tmp_path_factory):
    """A folder with a capture that goes by the name of a real one."""
    folder = tmp_path_factory.mktemp("captures")
    shutil.copytree(room_of(18, 64, 48).path, folder / "fern")
    return folder


def test_an_arm_is_a_strategy_with_one_choice_changed(bench):
    own = make_schedule("default", 1500, as_3dgs=False)
    for name, arm in bench.baseline_arms.ARMS.items():
        settings = TrainSettings(strategy=arm.strategy, max_steps=1500)
        changed = arm.change(settings.schedule)
        if arm.opacity_reset:
            continue
        plain = name in {"default", "grow", "mcmc", "none"} or name.endswith("-3dgs")
        assert (changed == settings.schedule) == plain, name
        if arm.strategy == "default" and not plain:
            different = [k for k in vars(own) if getattr(own, k) != getattr(changed, k)]
            assert different, name
            assert len(different) == 1 or {*different} == {"refine_start", "refine_stop"}, name


def test_neither_test_views_nor_held_out_views_are_trained_on(bench, captures, monkeypatch):
    seen = {}

    def watch(scene, *rest, **more):
        run = prepare_run(scene, *rest, **more)
        seen["train"] = {view.name for view in run.trainer.train_views}
        seen["held out"] = {view.name for view in run.trainer.test_views}
        return run

    prepare_run = bench.baseline_arms.prepare_run
    monkeypatch.setattr(bench.baseline_arms, "prepare_run", watch)
    scores = bench.baseline_arms.train(str(captures / "fern"), "default", 5, 1, 0, 900)
    names = sorted(image.name for image in load_scene(captures / "fern").images)
    test = set(names[::8])
    rest = [name for name in names if name not in test]
    assert seen == {"held out": set(rest[::8]), "train": set(rest) - set(rest[::8])}
    assert 0 < scores["gaussians"] <= 900
    assert 3 < scores["psnr"] < 40
    assert 0 < scores["ssim"] < 1


def test_what_is_in_the_ledger_is_not_run_again(bench, captures, monkeypatch, tmp_path, capsys):
    asked = []

    def call(function, *, threads, **run):
        asked.append((function, threads, run["arm"], run["seed"]))
        return {"psnr": 20.0 + run["seed"], "ssim": 0.5, "gaussians": 1000, "seconds": 2.0}

    monkeypatch.setattr(bench.baseline, "call", call)
    monkeypatch.setattr(bench.baseline, "find_scenes", lambda: captures)
    settings = bench.baseline.Settings(("fern",), ("none",), seeds=2, ledger=tmp_path / "l.jsonl")
    bench.baseline.main(settings)
    assert sorted(asked) == [
        ("benchmarks.training.baseline_arms:train", 1, "none", seed) for seed in (0, 1)
    ]
    bench.baseline.main(settings)
    assert len(asked) == 2
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| none")]
    assert rows[0] == rows[1]
    assert "20.50 / 0.5000 (1k, 2 s)" in rows[0]
