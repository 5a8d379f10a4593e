"""gsplat's MCMC strategy on the CPU, called as its users call it."""

from __future__ import annotations

import re
import subprocess
import sys
from contextlib import nullcontext
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from torch import Tensor

from splatseed.render import MCMCStrategy, mcmc_on_cpu, rasterization

from ..scenes import random_scene


def splats(scene: dict[str, Any]) -> tuple[torch.nn.ParameterDict, dict[str, torch.optim.Adam]]:
    """Parameters and optimisers as gsplat's example makes them; every fifth Gaussian is faint."""
    scene["opacities"][::5] = 1e-3
    values = {
        "means": scene["means"], "quats": scene["quats"], "scales": scene["scales"].log(),
        "opacities": scene["opacities"].logit(), "colors": scene["colors"].logit(),
    }  # fmt: skip
    params = torch.nn.ParameterDict({k: torch.nn.Parameter(v.clone()) for k, v in values.items()})
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": 0.01, "name": name}])
        for name in params
    }
    return params, optimizers


def train(strategy: gsplat.MCMCStrategy, steps: int = 11) -> tuple[list[float], Any]:
    """Fit a target: losses by step, and the parameters."""
    torch.manual_seed(0)
    views = random_scene(np.random.default_rng(0), 60, cameras=2)
    target = rasterization(**{**views, "backgrounds": None})[0]
    params, optimizers = splats(random_scene(np.random.default_rng(1), 50))
    strategy.check_sanity(params, optimizers)
    state, losses = strategy.initialize_state(), []
    for step in range(steps):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(),
            params["opacities"].sigmoid(), params["colors"].sigmoid(), views["viewmats"],
            views["Ks"], views["width"], views["height"],
        )  # fmt: skip
        loss: Tensor = (image - target).abs().mean()
        loss.backward()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, lr=1e-4)
        losses.append(loss.item())
    return losses, params


SCHEDULE = {"refine_start_iter": 2, "refine_every": 5, "cap_max": 54}


@pytest.mark.parametrize(
    ("make", "block"), [(MCMCStrategy, nullcontext), (gsplat.MCMCStrategy, mcmc_on_cpu)]
)
def test_a_users_loop_relocates_adds_and_learns(make: Any, block: Any, capsys: Any) -> None:
    with block():
        losses, params = train(make(**SCHEDULE, verbose=True))
    said = capsys.readouterr().out
    assert "Step 5: Relocated 10 GSs." in said
    assert "Step 5: Added 2 GSs. Now having 52 GSs." in said
    assert {len(each) for each in params.values()} == {54}
    assert all(each.isfinite().all() for each in params.values())
    assert params["opacities"].sigmoid().min() >= 0.004
    assert losses[-1] < losses[0]


def test_it_is_gsplats_own_class_in_all_else() -> None:
    ours, theirs = MCMCStrategy(**SCHEDULE), gsplat.MCMCStrategy(**SCHEDULE)
    assert isinstance(ours, gsplat.MCMCStrategy)
    assert vars(ours) == vars(theirs)
    with mcmc_on_cpu():
        expected = train(theirs)
    trained = train(ours)
    assert trained[0] == expected[0]
    assert all(torch.equal(trained[1][name], expected[1][name]) for name in trained[1])


WITHOUT_GSPLAT = """
import sys
sys.modules["gsplat"] = None
from splatseed.errors import MissingDependencyError
import splatseed.render as render
assert not hasattr(render, "DefaultStrategy")
for ask in (lambda: render.MCMCStrategy, render.mcmc_on_cpu().__enter__):
    try:
        ask()
    except MissingDependencyError as error:
        print(error)
"""


def test_without_gsplat_only_the_strategy_is_missing() -> None:
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_GSPLAT], capture_output=True, text=True, check=True
    )
    assert len(re.findall(r"pip install .*'gsplat>=1\.5\.3,<1\.6'", run.stdout)) == 2


def test_rendering_does_not_import_gsplat() -> None:
    code = "import sys, splatseed.render; sys.exit('gsplat' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
