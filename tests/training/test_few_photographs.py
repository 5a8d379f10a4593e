"""With few photographs each step drops some Gaussians."""

from __future__ import annotations

import pytest
import torch

from splatseed.training import trainer
from splatseed.training.parameters import DROPPED, as_parameters, with_dropout
from splatseed.training.schedule import make_schedule
from splatseed.training.traits import STRATEGIES


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


def test_dropout_rises_and_3dgs_has_none():
    schedule = make_schedule(STRATEGIES["grow"], 1500, as_3dgs=False)
    assert [schedule.dropout_at(step) for step in (0, 750, 1500)] == [0, 0.1, 0.2]
    assert make_schedule(STRATEGIES["default"], 1500, as_3dgs=True).dropout_at(1500) == 0


@pytest.mark.parametrize(("few", "differs"), [(7, True), (6, False)])
def test_only_runs_with_few_photographs_are_changed(begin, monkeypatch, few, differs):
    def trained(name, most):
        monkeypatch.setattr(trainer, "MAX_DROPOUT_VIEWS", most)
        run = begin(name, strategy="none", max_steps=9)
        assert len(run.trainer.train_views) == 7
        run.train()
        return run.state.params["means"].detach()

    assert torch.equal(trained("plain", 0), trained("few", few)) is not differs
