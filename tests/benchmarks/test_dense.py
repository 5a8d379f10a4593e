"""The benchmark of dense seeds: how its runs start, their curves, and its tables."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch")

from splatseed.io import load_scene
from splatseed.training.folder import Record

MODULES = ("training.dense", "training.seeding", "training.seeding_arms")
PLAN = {"strategy": "none", "rho": 0.2, "max_steps": 20, "data_factor": 1, "seed": 0, "every": 1}


@pytest.fixture(scope="module")
def capture(room_of, tmp_path_factory):
    folder = tmp_path_factory.mktemp("captures") / "fern"
    return Path(shutil.copytree(room_of(18, 64, 48).path, folder))


def test_opacities_follow_the_confidence_of_seeds_that_have_one(bench):
    start = bench.seeding_arms.Start(opacities=(0.1, 0.9))
    logits = torch.nn.Parameter(torch.full((3,), -2.0))
    start.set_opacities(logits, np.array([np.nan, 0.0, 0.5], np.float32))
    assert float(logits[0].detach()) == -2.0
    np.testing.assert_allclose(torch.sigmoid(logits[1:]).detach(), [0.1, 0.5], atol=1e-6)


def test_a_slow_start_changes_the_rate_of_positions_alone(bench):
    given = {"strategy": "none", "max_steps": 500}
    plain = bench.seeding_arms.Start().settings(**given).schedule
    slow = bench.seeding_arms.Start(position_rate=1 / 3).settings(**given).schedule
    assert slow.learning_rates["means"] == pytest.approx(plain.learning_rates["means"] / 3)
    different = [name for name in vars(plain) if getattr(plain, name) != getattr(slow, name)]
    assert different == ["learning_rates"]
    assert bench.seeding_arms.Start(discs=True).settings(**given).seed_normals


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


CURVES = {
    ("a", "sfm", "grow"): [(1, 5.0, 20.0, 0.5), (2, 10.0, 22.0, 0.6)],
    ("b", "sfm", "grow"): [(1, 5.0, 20.0, 0.5), (2, 10.0, 30.0, 0.6)],
    ("c", "sfm", "grow"): [(1, 5.0, 20.0, 0.5), (2, 10.0, 25.0, 0.6)],
    ("a", "dense", "none"): [(1, 2.0, 21.0, 0.6), (2, 4.0, 23.0, 0.7)],
    ("b", "dense", "none"): [(1, 2.0, 21.0, 0.5), (2, 4.0, 29.0, 0.7)],
    ("c", "dense", "none"): [(1, 2.0, 21.0, 0.5), (2, 4.0, 25.1, 0.7)],
}


@pytest.fixture
def ledger(tmp_path):
    path = tmp_path / "dense.jsonl"
    lines = []
    for (capture, seeds, strategy), curve in CURVES.items():
        facts = {"gaussians": 9, "seeds": 9, "cap": 9, "points": 5}
        run = {"psnr": curve[-1][2], "ssim": curve[-1][3], "whole_processor": curve[-1][1]}
        key = [capture, seeds, strategy, 1.0, 500, 2, 0, 1]
        lines.append(json.dumps([key, {**facts, **run, "curve": curve}]))
    path.write_text("\n".join(lines))
    return path


def test_an_arm_is_compared_in_quality_and_in_seconds_to_the_baselines(bench, ledger):
    dense = bench.dense
    runs, base = dense.read_runs(ledger), dense.Arm("sfm", "grow")
    found = dense.compare(runs, dense.Arm("dense", "none"), base, dense.Plan(1.0, 500))
    assert {name: round(each.psnr, 6) for name, each in found.items()} == {
        "a": 1,
        "b": -1,
        "c": 0.1,
    }
    # 22 dB lie halfway between the points at 2 and 4 seconds; the baseline took 10.
    assert found["a"].reached == {"psnr": pytest.approx(0.3), "ssim": pytest.approx(0.2)}
    assert found["b"].reached["psnr"] is None
    (row,) = dense.rows(runs, base)
    assert row == ["1", "500", "dense + none", "+0.03 ± 0.58", "+100", "b -1.00", "0.40",
                   "0.35 (2 of 3)", "0.27 (3 of 3)"]  # fmt: skip


def test_an_arm_is_chosen_on_the_other_captures(bench, ledger):
    dense = bench.dense
    runs, base = dense.read_runs(ledger), dense.Arm("sfm", "grow")
    # Without b dense seeds look good, with it they do not.
    chosen = dense.left_out(runs, base, dense.Plan(1.0, 500))
    assert {name: (str(arm), round(gain, 6)) for name, (arm, gain) in chosen.items()} == {
        "a": ("sfm + grow", 0.0), "b": ("dense + none", -1.0), "c": ("sfm + grow", 0.0),
    }  # fmt: skip


def test_runs_and_curves_are_written_as_csv(bench, ledger, tmp_path, capsys):
    bench.dense.main(bench.dense.Settings(ledger, csv=tmp_path / "out.csv"))
    assert "dense + none" in capsys.readouterr().out
    runs = list(csv.DictReader((tmp_path / "out.csv").open()))
    points = list(csv.DictReader((tmp_path / "out_curves.csv").open()))
    assert (len(runs), len(points)) == (6, 12)
    assert {**points[0], **runs[0]} == {
        "capture": "a", "seeds": "9", "strategy": "none", "rho": "1.0", "steps": "500",
        "factor": "2", "seed": "0", "psnr": "23.0", "ssim": "0.7", "gaussians": "9", "cap": "9",
        "points": "5", "whole_processor": "4.0", "at": "1", "seconds": "2.0", "method": "dense",
    }  # fmt: skip
