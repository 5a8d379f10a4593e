"""gsplat's densification runs unchanged on what the CPU rasteriser reports."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gsplat.strategy import DefaultStrategy
from torch import Tensor

from splatseed.render import rasterization

from ..scenes import random_scene


def parameters(scene: dict[str, Any]) -> torch.nn.ParameterDict:
    """The scene's Gaussians as gsplat keeps them: logarithms of scales, logits of opacities."""
    values = {
        "means": scene["means"], "quats": scene["quats"], "scales": scene["scales"].log(),
        "opacities": scene["opacities"].logit(), "colors": scene["colors"],
    }  # fmt: skip
    return torch.nn.ParameterDict({k: torch.nn.Parameter(v.clone()) for k, v in values.items()})


def render(params: torch.nn.ParameterDict, scene: dict[str, Any], **options: Any) -> Any:
    return rasterization(
        params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(),
        params["colors"], scene["viewmats"], scene["Ks"], scene["width"], scene["height"],
        **options,
    )  # fmt: skip


def train(
    strategy: DefaultStrategy, *, packed: bool, steps: int = 30
) -> tuple[list[float], list[int], torch.nn.ParameterDict, dict[str, Any]]:
    """Fit a target with Adam and densification: losses and counts by step, parameters, state."""
    target_scene = random_scene(np.random.default_rng(0), 60, cameras=2)
    target = rasterization(**{**target_scene, "backgrounds": None})[0]
    start = random_scene(np.random.default_rng(1), 25, cameras=2)
    params = parameters(start)
    optimizers = {
        name: torch.optim.Adam([{"params": params[name], "lr": 0.01, "name": name}])
        for name in params
    }
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    losses, counts = [], []
    for step in range(steps):
        image, _, info = render(params, target_scene, packed=packed, absgrad=strategy.absgrad)
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss: Tensor = (image - target).abs().mean()
        loss.backward()
        strategy.step_post_backward(params, optimizers, state, step, info, packed=packed)
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
        counts.append(len(params["means"]))
    return losses, counts, params, state


@pytest.mark.parametrize(("packed", "absgrad"), [(True, True), (False, False)])
def test_default_strategy_densifies(packed: bool, absgrad: bool) -> None:
    torch.manual_seed(0)
    strategy = DefaultStrategy(
        refine_start_iter=5, refine_every=10, grow_grad2d=1e-4, absgrad=absgrad, reset_every=1000
    )
    losses, counts, params, state = train(strategy, packed=packed)
    assert losses[-1] < 0.9 * losses[0]
    assert counts[-1] > counts[0]
    assert all(len(each) == counts[-1] == len(state["grad2d"]) for each in params.values())
    assert all(each.isfinite().all() for each in params.values())


def test_packed_and_not_gather_the_same_statistics() -> None:
    """Without refinement the running sums of gradients and counts are the same either way."""
    sums = []
    for packed in (True, False):
        *_, state = train(DefaultStrategy(), packed=packed, steps=5)
        assert state["count"].max() == 10
        sums.append(state["grad2d"])
    torch.testing.assert_close(sums[0], sums[1], rtol=1e-5, atol=1e-7)


def test_opacity_reset_and_pruning() -> None:
    torch.manual_seed(0)
    strategy = DefaultStrategy(refine_start_iter=1, refine_every=4, prune_opa=0.5, grow_grad2d=1e9)
    _, counts, params, _ = train(strategy, packed=True, steps=9)
    assert counts[-1] < counts[0]
    assert len(params["means"]) == counts[-1]
