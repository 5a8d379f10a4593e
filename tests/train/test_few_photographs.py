"""With few photographs each step leaves out some Gaussians."""

from __future__ import annotations

import pytest
import torch

from splatseed.train import trainer
from splatseed.train.parameters import LEFT_OUT, as_parameters, without_some
from splatseed.train.schedule import make_schedule


def test_some_are_left_out_and_the_others_make_up_for_them():
    params = as_parameters({"means": torch.zeros(4000, 3), "opacities": torch.zeros(4000)})
    assert without_some(params, 0.0) is params
    torch.manual_seed(0)
    shown = without_some(params, 0.2)
    out = shown["opacities"] == LEFT_OUT
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
    assert torch.isfinite(without_some(params, 0.01)["opacities"]).all()


def test_the_share_rises_and_3dgs_leaves_out_none():
    schedule = make_schedule("grow", 1500, as_3dgs=False)
    assert [schedule.left_out(step) for step in (0, 750, 1500)] == [0, 0.1, 0.2]
    assert make_schedule("default", 1500, as_3dgs=True).left_out(1500) == 0


@pytest.mark.parametrize(("few", "differs"), [(7, True), (6, False)])
def test_only_runs_with_few_photographs_are_changed(begin, monkeypatch, few, differs):
    def trained(name, most):
        monkeypatch.setattr(trainer, "FEW", most)
        run = begin(name, strategy="none", max_steps=9)
        assert len(run.trainer.train_views) == 7
        run.train()
        return run.state.params["means"].detach()

    assert torch.equal(trained("plain", 0), trained("few", few)) is not differs
