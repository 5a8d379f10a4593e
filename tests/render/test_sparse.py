"""Sparse gradients: the dense ones' values, of the Gaussians that are seen."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseed.render import rasterization

from .scenes import gradients, random_scene

SPARSE = ("means", "quats", "scales")
OTHERS = ("opacities", "colors", "viewmats", "backgrounds")


def partly_seen(cameras: int, **more: Any) -> dict[str, Any]:
    """Some Gaussians lie behind a camera or beside its image."""
    scene = random_scene(np.random.default_rng(0), 80, cameras=cameras, **more)
    scene["viewmats"][:, 2, 3] = 0.6
    return scene


def seen(scene: dict[str, Any], **options: Any) -> Tensor:
    return rasterization(**scene, **options)[2]["gaussian_ids"].unique()


@pytest.mark.parametrize("cameras", [1, 2, 3])
@pytest.mark.parametrize(
    "options", [{}, {"rasterize_mode": "antialiased"}, {"render_mode": "RGB+ED"}]
)
def test_values_are_the_dense_ones_and_indices_the_seen(
    cameras: int, options: dict[str, Any]
) -> None:
    scene = partly_seen(cameras)
    *picture, dense = gradients(scene, **options)
    *same, grads = gradients(scene, sparse_grad=True, **options)
    assert all(torch.equal(a, b) for a, b in zip(picture, same, strict=True))
    rows = seen(scene, **options)
    assert 10 < len(rows) < 70
    for name in SPARSE:
        assert grads[name].layout == torch.sparse_coo
        assert grads[name].shape == dense[name].shape
        each = grads[name].coalesce()
        assert torch.equal(each.indices(), rows[None])
        assert torch.equal(each.to_dense(), dense[name])
    for name in OTHERS:
        assert torch.equal(grads[name], dense[name])


def test_directions_of_harmonics_make_the_gradient_of_means_dense() -> None:
    scene = partly_seen(2, coefficients=4)
    dense = gradients(scene, sh_degree=1)[2]
    grads = gradients(scene, sh_degree=1, sparse_grad=True)[2]
    assert [grads[name].is_sparse for name in SPARSE] == [False, True, True]
    for name in SPARSE:
        torch.testing.assert_close(grads[name].to_dense(), dense[name])


@pytest.mark.parametrize("cameras", [1, 2])
def test_sparse_adam_moves_the_seen_as_adam_does(cameras: int) -> None:
    scene, results = partly_seen(cameras), []
    for optimizer, sparse in ((torch.optim.SparseAdam, True), (torch.optim.Adam, False)):
        params = {name: torch.nn.Parameter(scene[name].clone()) for name in SPARSE}
        image = rasterization(**{**scene, **params}, sparse_grad=sparse)[0]
        image.square().mean().backward()
        optimizer(list(params.values()), lr=0.01, eps=1e-15).step()
        results.append(params)
    ours, expected = results
    rows = seen(scene)
    unseen = torch.ones(80, dtype=torch.bool).index_fill(0, rows, value=False)
    for name in SPARSE:
        torch.testing.assert_close(ours[name], expected[name], rtol=0, atol=1e-5)
        assert not torch.equal(ours[name][rows], scene[name][rows])
        assert torch.equal(ours[name][unseen], scene[name][unseen])


def test_a_camera_that_sees_nothing() -> None:
    scene = partly_seen(1)
    scene["viewmats"][:, 2, 3] = -10.0
    scene["means"] = torch.nn.Parameter(scene["means"])
    rasterization(**scene, sparse_grad=True)[0].sum().backward()
    assert scene["means"].grad.is_sparse
    assert scene["means"].grad._nnz() == 0
    torch.optim.SparseAdam([scene["means"]]).step()


def splats(scene: dict[str, Any]) -> tuple[dict[str, torch.nn.Parameter], list[Any]]:
    values = {
        "means": scene["means"], "quats": scene["quats"], "scales": scene["scales"].log(),
        "opacities": scene["opacities"].logit(), "sh0": scene["colors"][:, :1],
        "shN": scene["colors"][:, 1:],
    }  # fmt: skip
    params = {name: torch.nn.Parameter(value.contiguous()) for name, value in values.items()}
    return params, [torch.optim.SparseAdam([each], lr=0.01) for each in params.values()]


def as_sparse(parameter: Tensor, rows: Tensor) -> Tensor:
    """A dense gradient as gsplat's example hands it to SparseAdam."""
    grad = parameter.grad
    assert grad is not None
    return grad if grad.is_sparse else torch.sparse_coo_tensor(
        rows[None], grad[rows], parameter.shape, is_coalesced=True, check_invariants=False
    )  # fmt: skip


def test_the_loop_of_gsplats_example_learns() -> None:
    views = partly_seen(1, coefficients=4)
    options = {"sh_degree": 1, "packed": True}
    target = rasterization(**{**views, "backgrounds": None}, **options)[0]
    start = random_scene(np.random.default_rng(1), 60, coefficients=4)
    params, optimizers = splats(start)
    losses = []
    for _ in range(20):
        image, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(),
            params["opacities"].sigmoid(), torch.cat([params["sh0"], params["shN"]], 1),
            views["viewmats"], views["Ks"], views["width"], views["height"], sparse_grad=True,
            **options,
        )  # fmt: skip
        loss = (image - target).abs().mean()
        loss.backward()
        for parameter in params.values():
            parameter.grad = as_sparse(parameter, info["gaussian_ids"])
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        losses.append(loss.item())
    assert losses[-1] < 0.9 * losses[0]
