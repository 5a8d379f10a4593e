"""Going on from trained Gaussians: whole or with a hole, of any trainer, within a budget."""

from __future__ import annotations

import dataclasses
import json
import shutil

import numpy as np
import pytest

from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.model_frame import find_transform, transform_gaussians
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings

FIRST = TrainSettings(strategy="grow", max_steps=120, cap_max=1200, backend="cpu")


def trained(scene, folder, settings, **options):
    """The scores of a run, and the run."""
    run = prepare_run(scene, folder, settings, **options)
    run.train()
    return run.finish(evaluate_views).scores, run


@pytest.fixture(scope="module")
def first(room, tmp_path_factory):
    """A trained model of the room, and its scores."""
    folder = tmp_path_factory.mktemp("first") / "run"
    scores, _ = trained(room, folder, FIRST)
    return folder / "point_cloud.ply", scores


def going_on(path, steps=60, **settings):
    return dataclasses.replace(FIRST, start=str(path), max_steps=steps, seed=1, **settings)


def test_a_run_that_goes_on_keeps_what_was_learnt(room, first, tmp_path):
    path, scores = first
    before = path.read_bytes()
    further, run = trained(room, tmp_path / "run", going_on(path, 80, strategy="none"))
    assert further.psnr > scores.psnr - 0.1
    assert run.count() == len(read_gaussians(path))
    assert path.read_bytes() == before
    config = run.folder.read_config()
    assert config["start"] == str(path)


def test_a_hole_is_filled_where_the_strategy_adds(room, first, tmp_path):
    path, _ = first
    whole, corner = read_gaussians(path), room.points.xyz[0]
    away = np.linalg.norm(whole.means - corner, axis=1)
    reach = np.quantile(away, 0.25)
    write_gaussians(tmp_path / "hole.ply", whole.select(away > reach))
    for strategy, least, most in (("none", 0, 50), ("grow", 100, 300)):
        settings = going_on(tmp_path / "hole.ply", strategy=strategy)
        trained(room, tmp_path / strategy, settings)
        means = read_gaussians(tmp_path / strategy / "point_cloud.ply").means
        assert least <= np.sum(np.linalg.norm(means - corner, axis=1) < reach) <= most


def test_a_model_in_its_trainers_world_is_brought_into_the_scenes(room, first, tmp_path):
    path, scores = first
    world = find_transform("gsplat", room)
    write_gaussians(tmp_path / "theirs.ply", transform_gaussians(read_gaussians(path), world))
    findings = []
    run = prepare_run(
        room, tmp_path / "run", going_on(tmp_path / "theirs.ply"), note=findings.append
    )
    assert any("(gsplat)" in each.text for each in findings)
    shown = evaluate_views(run.trainer.render, run.trainer.test_views)
    assert shown.psnr == pytest.approx(scores.psnr, abs=0.02)


def test_a_smaller_budget_keeps_those_that_contribute_most(room, first, tmp_path):
    path, _ = first
    whole, findings = read_gaussians(path), []
    half = len(whole) // 2
    settings = going_on(path, cap_max=half)
    run = prepare_run(room, tmp_path / "run", settings, note=findings.append)
    assert run.count() == half
    assert any(f"{half} of {len(whole):,} Gaussians" in each.text for each in findings)
    rng = np.random.default_rng(0)
    write_gaussians(
        tmp_path / "some.ply", whole.select(np.sort(rng.permutation(len(whole))[:half]))
    )
    other = prepare_run(room, tmp_path / "other", going_on(tmp_path / "some.ply"))
    best, any_ = (evaluate_views(r.trainer.render, r.trainer.test_views) for r in (run, other))
    assert best.psnr > any_.psnr + 1


def test_a_run_is_in_its_scenes_world_whatever_its_clones(room_path, first, splatseed, tmp_path):
    """As mcmc makes them; a file of the same Gaussians may be of another scene."""
    run = shutil.copytree(first[0].parent, tmp_path / "run")
    whole = read_gaussians(run / "point_cloud.ply")
    write_gaussians(run / "point_cloud.ply", whole.select(np.arange(len(whole)) // 40))
    file = shutil.copy(run / "point_cloud.ply", tmp_path / "file.ply")
    words = ["train", room_path, "--max-steps", 3, "--strategy", "none", "-o"]
    for model, code in ((run, 0), (file, 2)):
        ended = splatseed(*words, tmp_path / f"{model.stem}_on", "--start", model)
        assert (ended.code, "another scene" in ended.err) == (code, code == 2)
    assert splatseed("evaluate", run).code == 0
    assert splatseed("evaluate", file, "--scene", room_path).code == 2


def test_the_config_of_such_a_run_serves_another(room_path, first, splatseed, tmp_path):
    words = ["train", room_path, "--max-steps", 3, "--strategy", "none", "-o"]
    for name, given in (
        ("a", ["--start", first[0]]),
        ("b", ["--config", tmp_path / "a/config.json"]),
        ("c", ["--config", tmp_path / "a/config.json", "--seeds", "scene", "--long-side", 80]),
    ):
        ended = splatseed(*words, tmp_path / name, *given)
        assert ended.code == 0, ended.err
    configs = [json.loads((tmp_path / name / "config.json").read_text()) for name in "abc"]
    assert [config["start"] for config in configs] == [str(first[0]), str(first[0]), None]
    assert configs[2]["data_factor"] > 1


def test_the_command(room_path, first, splatseed, tmp_path):
    path, _ = first
    words = ["train", room_path, "--max-steps", 20, "--budget", 1200]
    done = splatseed(*words, "-o", tmp_path / "run", "--start", path.parent)
    assert done.code == 0, done.err
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["start"] == str(path)
    assert config["seeds"]["count"] == len(read_gaussians(path))
    for words_of, found in (
        (["--start", path, "--seeds", "auto"], "--start or --seeds"),
        (["--start", tmp_path / "none.ply"], "a file of Gaussians"),
        (["--start", room_path / "sparse/0/points3D.bin"], ""),
    ):
        failed = splatseed(*words, "-o", tmp_path / "bad", *words_of)
        assert failed.code == 2
        assert found in " ".join(failed.err.split())
        assert not (tmp_path / "bad").exists()
