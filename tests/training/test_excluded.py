"""Photographs that the user leaves out stay out of training, of scores and of resumed runs."""

from __future__ import annotations

import json

import pytest

from splatseed import evaluate, load_scene, train
from splatseed.commands.train import parse
from splatseed.errors import ParameterError
from splatseed.io.exclusion import EXCLUDED
from splatseed.training.api import prepare_training
from splatseed.training.request import TrainRequest

QUICK = {"max_steps": 4, "data_factor": 2, "strategy": "none", "seeding": "scene", "test_every": 4}


def _split(scene):
    return [{image.name for image in part} for part in scene.split(4)]


def test_they_are_neither_trained_on_nor_tested(larger_room_path, tmp_path):
    scene, names = load_scene(larger_room_path), ["view_003.png", "view_004.png"]
    run = train(scene, tmp_path / "run", exclude=["view_00[34]*"], **QUICK)
    assert run.config["excluded"] == names
    assert run.config["exclude"] == ["view_00[34]*"]
    parts = [set(run.config["split"][part]) for part in ("train", "test")]
    assert parts == [part - {*names} for part in _split(scene)]
    notes = []
    scores = evaluate(run, note=notes.append)
    assert {view.name for view in scores.per_image} == parts[1]
    assert scores.psnr == pytest.approx(run.metrics["psnr"], abs=1e-4)
    assert [(each.kind, [*each.subjects]) for each in notes] == [(EXCLUDED, names)]
    # a test view less, of a run that knows its photographs
    notes.clear()
    fewer = evaluate(run, exclude=["view_000"], note=notes.append)
    assert [each.name for each in fewer.per_image] == sorted(parts[1] - {"view_000.png"})
    assert {each.kind for each in notes} == {EXCLUDED}
    means = [score.psnr for score in scores.per_image if score.name != "view_000.png"]
    assert fewer.psnr == pytest.approx(sum(means) / len(means))
    with pytest.raises(ParameterError, match="some test views"):
        evaluate(run, exclude=sorted(parts[1]))


def test_a_scene_without_some_is_scored_without_them(larger_room_path, tmp_path):
    scene = load_scene(larger_room_path).without(["view_004.png", "view_005.png"])
    run = train(scene, tmp_path / "run", **QUICK)
    notes = []
    scores = evaluate(run, note=notes.append)  # the files have all
    assert {view.name for view in scores.per_image} == set(run.config["split"]["test"])
    assert [(each.kind, [*each.subjects]) for each in notes] == [(EXCLUDED, run.config["excluded"])]


def test_a_resumed_run_leaves_out_the_same(larger_room_path, tmp_path):
    def prepare(**options):
        request = TrainRequest.of({**QUICK, **options})
        return prepare_training(larger_room_path, tmp_path / "run", request)

    prepare(exclude=("view_003*",))
    run = prepare(resume=True)
    names = {view.name for view in run.trainer.train_views + run.trainer.test_views}
    assert names == {im.name for im in load_scene(larger_room_path).images} - {"view_003.png"}
    for other in ("view_005*", "view_00[35]*"):
        with pytest.raises(ParameterError, match="the scene of the run"):
            prepare(resume=True, exclude=(other,))


@pytest.mark.parametrize("value", ["view_003*", ["view_003*", "view_005.png"]])
def test_options_from_a_file(value, tmp_path):
    file = tmp_path / "options.json"
    file.write_text(json.dumps({"exclude": value}))
    options = parse(["scene", "-o", str(tmp_path / "run"), "--config", str(file)])
    assert [*options.request.exclude] == ([value] if isinstance(value, str) else value)
    words = ["scene", "-o", str(tmp_path / "run"), "--config", str(file), "--exclude", "x*"]
    assert parse(words).request.exclude == ("x*",)
