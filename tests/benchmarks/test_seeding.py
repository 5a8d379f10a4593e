"""The benchmark of seeds: held-out views, curves, kept seeds, ledger and gains."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene
from splatseed.photos.visibility import points_in_image
from splatseed.training.folder import Record

MODULES = ("training.seeding", "training.seeding_arms", "training.peer_starts")
PLAN = {"strategy": "none", "rho": 0.2, "max_steps": 20, "data_factor": 1, "seed": 0, "every": 1}


@pytest.fixture(scope="module")
def capture(room_of, tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "fern"
    return Path(shutil.copytree(room_of(18, 64, 48).path, folder))


@pytest.mark.usefixtures("score_often")
def test_a_run_keeps_its_curve_and_its_seeds(bench, capture, monkeypatch, tmp_path):
    first = bench.seeding_arms.train(str(capture), "sfm", kept=str(tmp_path), **PLAN)
    steps, seconds, psnr, _ = zip(*first["curve"], strict=True)
    assert steps == tuple(range(1, 21))
    assert list(seconds) == sorted(seconds)
    assert seconds[-1] == pytest.approx(first["whole_processor"], abs=0.01)
    assert psnr[-1] == pytest.approx(first["psnr"], abs=0.01)
    assert first["gaussians"] == first["seeds"] <= round(0.2 * 64 * 48)

    def fail(*_):
        raise AssertionError("the seeds are known")

    monkeypatch.setattr(bench.seeding_arms, "_seeds", fail)
    again = bench.seeding_arms.train(str(capture), "sfm", kept=str(tmp_path), **PLAN)
    assert again["psnr"] == first["psnr"]
    assert again["seeding"] == first["seeding"]
    with pytest.raises(AssertionError, match="the seeds are known"):
        bench.seeding_arms.train(str(capture), "cover", kept=str(tmp_path), **PLAN)


def test_scoring_takes_no_time_of_the_run(bench, monkeypatch):
    now = SimpleNamespace(at=0.0)
    monkeypatch.setattr(bench.seeding_arms.time, "process_time", lambda: now.at)
    passed = []
    trainer = SimpleNamespace(on_record=passed.append)
    curve = bench.seeding_arms.Curve(trainer, 0.0)
    for step in (1, 2):
        now.at += 3.0
        curve.on_step(step)
        now.at += 100.0  # the held-out views are rendered
        trainer.on_record(Record(step, 0.0, 0.1, 20.0, 20.0 + step, 7, 0.5))
    assert curve.points == [(1, 3.0, 21.0, 0.5), (2, 6.0, 22.0, 0.5)]
    assert curve.last == 6.0
    assert len(passed) == 2


def test_validation_views_are_no_test_views_and_are_not_trained(bench, capture):
    scene = load_scene(capture)
    names = sorted(image.name for image in scene.images)
    split = bench.seeding_arms.validation_split(scene, 1, 0)
    train, held = (sorted(image.name for image in part) for part in split.split(8))
    rest = [name for name in names if name not in names[::8]]
    assert held == rest[::8]
    assert train == sorted(set(rest) - set(held))


def test_runs_in_the_ledger_are_not_repeated_and_gains_are_over_the_first_arm(
    bench, monkeypatch, tmp_path, capsys
):
    calls = []

    def call(function, *, threads, **run):
        calls.append((function, threads, run["scene"], run["arm"], run["seed"]))
        psnr = 20.0 + 2 * run["seed"] + (run["arm"] == "auto") * (1 + run["scene"].endswith("fox"))
        facts = {"gaussians": 1000, "seeds": 500, "seeding": 1.0, "seconds": 2.0}
        return {"psnr": psnr, "ssim": 0.5 + 0.01 * (run["arm"] == "auto"), **facts}

    monkeypatch.setattr(bench.seeding, "call", call)
    monkeypatch.setattr(bench.seeding, "find_scenes", lambda: tmp_path)
    settings = bench.seeding.Settings(
        ("fern", "fox"), ("sfm", "auto"), ("none",), seeds=2, ledger=tmp_path / "l.jsonl"
    )
    bench.seeding.main(settings)
    assert sorted(calls) == [
        ("benchmarks.training.seeding_arms:train", 1, str(tmp_path / scene), arm, seed)
        for scene in ("fern", "fox") for arm in ("auto", "sfm") for seed in (0, 1)
    ]  # fmt: skip
    bench.seeding.main(settings)
    assert len(calls) == 8
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("| none")
    ]
    sfm, auto = rows[:2]
    assert rows == [sfm, auto] * 2
    assert sfm[3:] == ["21.00 / 0.5000 (1.0k, 0.5k seeds, 1 + 2 s)"] * 2 + ["21.00 / 0.5000", ""]
    assert auto[-2:] == ["22.50 / 0.5100", "+1.50 ± 0.50 / +0.010"]


def test_other_trainers_start_where_their_rules_say(bench, room):
    draw = bench.peer_starts.peer_start
    cube = draw(room, np.random.default_rng(0), "lichtfeld")
    assert len(cube) == 10_000
    np.testing.assert_allclose(np.ptp(cube.xyz, axis=0), 2, atol=0.01)
    frusta = draw(room, np.random.default_rng(0), "brush")
    assert len(frusta) == 10_000
    seen = np.zeros(len(frusta), np.bool_)
    for image in room.images:
        seen[points_in_image(image.camera, frusta.xyz).point_idx] = True
    assert seen.all()
    assert frusta.rgb.min() >= 127  # coefficients from 0 to 1 are added to grey
    assert frusta.rgb.max() <= 200
