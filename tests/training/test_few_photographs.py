"""Few photographs: dropout and opacity decay; all are trained on."""

from __future__ import annotations

import json
from functools import partial

import pytest
import torch

from splatseed.scene import Split
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import read_gaussians
from splatseed.splat.render_loss import RenderLoss
from splatseed.training import schedule
from splatseed.training.api import prepare_training
from splatseed.training.folder import config_of
from splatseed.training.model_views import find_model_views
from splatseed.training.parameters import DROPPED, as_parameters, decay_opacities, with_dropout
from splatseed.training.request import TrainRequest
from splatseed.training.schedule import default_steps, make_schedule
from splatseed.training.traits import STRATEGIES

from ..command_line import exit_code

SHORT = {"strategy": "none", "max_steps": 3, "data_factor": 2, "seeding": "scene"}


def test_some_are_dropped_and_the_others_make_up_for_them():
    params = as_parameters({"means": torch.zeros(4000, 3), "opacities": torch.zeros(4000)})
    assert with_dropout(params, 0.0) is params
    torch.manual_seed(0)
    shown = with_dropout(params, 0.2)
    out = shown["opacities"] == DROPPED
    assert 0.17 < out.float().mean() < 0.23
    opacities = torch.sigmoid(shown["opacities"])
    torch.testing.assert_close(opacities[~out], torch.full((int((~out).sum()),), 0.5 / 0.8))
    assert opacities.detach().mean().item() == pytest.approx(0.5, abs=0.02)
    opacities.sum().backward()
    gradient = params["opacities"].grad
    assert ((gradient == 0) == out).all()
    assert (params["opacities"] == 0).all()


def test_raised_opacities_stay_below_one():
    params = as_parameters({"opacities": torch.tensor([2.0, 30.0])})
    torch.manual_seed(1)
    assert torch.isfinite(with_dropout(params, 0.01)["opacities"]).all()


def test_opacities_decay_by_a_factor():
    params = as_parameters({"opacities": torch.tensor([0.3, 0.999]).logit()})
    for _ in range(10):
        decay_opacities(params, 0.1)
    torch.testing.assert_close(
        torch.sigmoid(params["opacities"]).detach(), torch.tensor([0.3, 0.999]) * 0.9**10
    )
    for _ in range(1000):
        decay_opacities(params, 0.1)
    assert (params["opacities"] == DROPPED).all()


def test_dropout_rises_and_is_less_with_more_photographs():
    ours = make_schedule(STRATEGIES["grow"], 1500, as_3dgs=False)
    assert [ours.dropout_at(step, 3) for step in (0, 750, 1500)] == pytest.approx([0, 0.4, 0.8])
    last = [ours.dropout_at(1500, n) for n in (2, 4, 6, 16, 17)]
    assert last == pytest.approx([0.8, 10 / 16, 10 / 36, 0.2, 0])
    assert [ours.opacity_decay(n) for n in (2, 3, 6, 17)] == pytest.approx([0.002, 0.002, 0.001, 0])


def test_3dgs_regularises_nothing():
    theirs = make_schedule(STRATEGIES["default"], 1500, as_3dgs=True)
    assert theirs.dropout_at(1500, 3) == theirs.opacity_decay(3) == 0
    assert not theirs.random_background


@pytest.mark.parametrize(("few", "differs"), [(7, True), (6, False)])
def test_only_runs_with_few_photographs_are_changed(begin, monkeypatch, few, differs):
    def trained(name, most):
        monkeypatch.setattr(schedule, "MAX_FEW_VIEWS", most)
        run = begin(name, strategy="none", max_steps=9)
        assert len(run.trainer.train_views) == 7
        run.train()
        return run.state.params["means"].detach()

    assert torch.equal(trained("plain", 0), trained("few", few)) is not differs


def test_without_test_views_the_curve_ends_with_the_gaussians_written(begin):
    run = begin(strategy="grow", max_steps=3, test_every=0)
    run.train()
    written = run.finish(evaluate_views).scores.num_gaussians
    before, end = run.folder.curve_csv.read_text().splitlines()[-2:]
    assert int(end.split(",")[5]) == written > int(before.split(",")[5])  # margins


@pytest.mark.usefixtures("draw_curves")
def test_all_of_few_photographs_are_trained_on_and_nothing_is_scored(room_path, tmp_path, capsys):
    run, train = tmp_path / "run", partial(exit_code, "train", room_path)
    words = ("--strategy", "none", "--max-steps", "3", "--data-factor", "2", "--seeds", "scene")
    assert train(*words, "-o", run) == 0
    said, notes = capsys.readouterr()
    assert "All 9 photographs are trained on" in notes
    assert "--test-every 8 holds some out" in notes
    assert "no photograph was held out" in said
    assert not any(word in said for word in ("nan", "PSNR", "renders", "test views", "evaluate"))
    metrics, config = (json.loads((run / f"{n}.json").read_text()) for n in ("metrics", "config"))
    assert (metrics["psnr"], metrics["ssim"], metrics["per_image"], metrics["tests"]) == (
        None, None, [], [],
    )  # fmt: skip
    assert (config["test_every"], len(config["split"]["train"]), config["split"]["test"]) == (
        0, 9, [],
    )  # fmt: skip
    assert not (run / "renders").exists()
    assert (run / "curve.png").is_file()
    assert (run / "curve.csv").read_text().count("\n") == 4  # a header and every step

    assert exit_code("evaluate", run) == 2
    assert "nothing was held out" in capsys.readouterr().err
    assert exit_code("evaluate", run, "--test-every", "8") == 0
    assert "trained on 2 of these 2 views" in " ".join("".join(capsys.readouterr()).split())

    path = run / "point_cloud.ply"
    views = find_model_views(path, read_gaussians(path), room_path, config_of(run))
    assert (len(views.train), views.label) == (9, "training view")
    loss = RenderLoss(3, (30.0, 29.0), (40.0,), views.label).finding(".sog")
    assert "(3 training views)" in loss.text


def test_photographs_are_held_out_where_the_user_or_the_scene_says_so(room, tmp_path):
    def begun(scene, **options):
        notes = []
        request = TrainRequest.of({**SHORT, **options})
        run = prepare_training(scene, tmp_path / "run", request, note=notes.append)
        views, said = [view.name for view in run.trainer.test_views], " ".join(map(str, notes))
        ignored = scene.listed is not None and "test_every" in options
        assert ("`test_every` is ignored" in said) == ignored
        return views, "nothing-held-out" in {note.kind for note in notes}

    names = sorted(image.name for image in room.images)
    assert begun(room, test_every=8) == ([names[0], names[8]], False)
    assert begun(room, test_every=0, overwrite=True) == ([], False)
    split = Split(frozenset(names[:4]), frozenset(names[4:5]), "list")
    assert begun(room.replace(listed=split), overwrite=True) == ([names[4]], False)
    listed = room.replace(listed=split)
    assert begun(listed, test_every=2, overwrite=True) == ([names[4]], False)
    assert begun(room, overwrite=True) == ([], True)


@pytest.mark.parametrize(
    ("options", "steps"),
    [({}, 1500), ({"max_steps": 30_000}, 30_000), ({"strategy": "default-3dgs"}, 30_000)],
)
def test_few_photographs_get_fewer_steps_by_default(room, tmp_path, options, steps):
    notes = []
    request = TrainRequest.of({"strategy": "none", "seeding": "scene", **options})
    run = prepare_training(room, tmp_path / "run", request, note=notes.append)
    assert run.settings.max_steps == steps
    assert ("fewer-steps" in {note.kind for note in notes}) == (steps < 30_000)
    assert [default_steps(count) for count in (0, 3, 11, 12)] == [30_000, 1500, 1500, 30_000]
