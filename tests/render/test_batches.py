"""Batch dimensions: each batch is rendered as it is alone, and ``info`` lists them in order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseed.render import rasterization

from .scenes import random_scene

CAMERAS, N = 2, 40
BATCHES = [(2,), (2, 1, 2), (1,)]
MODELS: dict[str, dict[str, Any]] = {
    "colors": {},
    "harmonics": {"sh_degree": 1},
    "antialiased, depth": {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"},
}


def scenes_of(batch: tuple[int, ...], sh: bool, per_camera: bool = False) -> list[dict[str, Any]]:
    """Unlike scenes, some of whose Gaussians no camera sees."""
    scenes = []
    for seed in range(int(np.prod(batch))):
        rng = np.random.default_rng(seed)
        scene = random_scene(rng, N, cameras=CAMERAS, coefficients=4 if sh else None)
        scene["viewmats"][:, 2, 3] = 0.7
        if per_camera:
            scene["colors"] = torch.rand(CAMERAS, *scene["colors"].shape)
        scenes.append(scene)
    return scenes


def joined(scenes: list[dict[str, Any]], batch: tuple[int, ...]) -> dict[str, Any]:
    return {
        name: stacked([scene[name] for scene in scenes], batch) if isinstance(value, Tensor)
        else value
        for name, value in scenes[0].items()
    }  # fmt: skip


def stacked(tensors: list[Tensor], batch: tuple[int, ...]) -> Tensor:
    return torch.stack(tensors).reshape(*batch, *tensors[0].shape)


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("packed", "per_camera"), [(True, False), (False, True)])
@pytest.mark.parametrize("model", MODELS)
def test_batches_are_rendered_as_alone(
    batch: tuple[int, ...], packed: bool, per_camera: bool, model: str
) -> None:
    options = {"packed": packed, **MODELS[model]}
    scenes = scenes_of(batch, "sh_degree" in options, per_camera)
    image, alpha, _ = rasterization(**joined(scenes, batch), **options)
    alone = [rasterization(**scene, **options) for scene in scenes]
    assert torch.equal(image, stacked([each[0] for each in alone], batch))
    assert torch.equal(alpha, stacked([each[1] for each in alone], batch))
    assert not torch.equal(alone[0][0], alone[-1][0]) or len(scenes) == 1


@pytest.mark.parametrize("packed", [True, False])
@pytest.mark.parametrize("model", MODELS)
def test_gradients_stay_in_their_batch(packed: bool, model: str) -> None:
    """The loss weights the second batch alone, so the first must have none."""
    options = {"packed": packed, **MODELS[model]}
    scenes = scenes_of((2,), "sh_degree" in options)
    inputs, own = (
        {k: v.clone().requires_grad_() if isinstance(v, Tensor) else v for k, v in scene.items()}
        for scene in (joined(scenes, (2,)), scenes[1])
    )
    rasterization(**inputs, **options)[0][1].sum().backward()
    rasterization(**own, **options)[0].sum().backward()
    for name in ("means", "quats", "scales", "opacities", "colors", "viewmats", "backgrounds"):
        expected, grad = own[name].grad, inputs[name].grad
        assert expected.abs().max() > 0
        assert torch.equal(grad[1], expected), name
        assert not grad[0].any(), name


def test_gradients_of_expanded_cameras_are_summed() -> None:
    """As gsplat's test calls it: one pose and lens for all, expanded without a copy."""
    scene = random_scene(np.random.default_rng(0), N)
    wide = {name: each.expand(3, *each.shape) if isinstance(each, Tensor) else each
            for name, each in scene.items()}  # fmt: skip
    viewmats = scene["viewmats"].clone().requires_grad_()
    wide["viewmats"] = viewmats.expand(3, -1, -1, -1)
    rasterization(**wide)[0].square().sum().backward()
    alone = scene["viewmats"].clone().requires_grad_()
    rasterization(**{**scene, "viewmats": alone})[0].square().sum().backward()
    torch.testing.assert_close(viewmats.grad, 3 * alone.grad)


def test_a_pair_of_coefficients_is_the_joined_ones() -> None:
    scene = joined(scenes_of((1, 2), sh=True), (1, 2))
    pair = (scene["colors"][..., :1, :], scene["colors"][..., 1:, :])
    expected = rasterization(**scene, sh_degree=1)[0]
    assert torch.equal(rasterization(**{**scene, "colors": pair}, sh_degree=1)[0], expected)


@pytest.mark.parametrize("batch", BATCHES)
def test_info_is_stacked_and_packed_info_names_the_batch(batch: tuple[int, ...]) -> None:
    scenes = scenes_of(batch, sh=False)
    packed, info = (rasterization(**joined(scenes, batch), packed=p)[2] for p in (True, False))
    alone = [rasterization(**scene, packed=False)[2] for scene in scenes]
    assert (info["n_batches"], info["n_cameras"]) == (len(scenes), CAMERAS)
    rows = tuple(packed[name] for name in ("batch_ids", "camera_ids", "gaussian_ids"))
    assert set(rows[0].tolist()) == set(range(info["n_batches"]))
    for name in ("means2d", "radii", "depths", "conics", "opacities", "tiles_per_gauss"):
        assert torch.equal(info[name], stacked([each[name] for each in alone], batch)), name
        flat = info[name].reshape(-1, CAMERAS, N, *info[name].shape[len(batch) + 2 :])
        assert torch.equal(packed[name], flat[rows]), name
    pairs = torch.tensor([0, *(len(each["isect_ids"]) for each in alone)]).cumsum(0)
    offsets = [each["isect_offsets"] + pairs[i] for i, each in enumerate(alone)]
    assert torch.equal(info["isect_offsets"], stacked(offsets, batch).int())
    flat = [each["flatten_ids"] + i * CAMERAS * N for i, each in enumerate(alone)]
    assert torch.equal(info["flatten_ids"], torch.cat(flat))
    for name in ("isect_ids", "isect_offsets"):
        assert torch.equal(packed[name], info[name]), name


@pytest.mark.parametrize("packed", [True, False])
def test_absolute_gradients_are_those_of_each_batch(packed: bool) -> None:
    found = []
    scenes = scenes_of((1, 2), sh=False)
    for scene in (joined(scenes, (1, 2)), *scenes):
        leaf = scene["means"].clone().requires_grad_()
        image, _, info = rasterization(
            **{**scene, "means": leaf}, packed=packed, absgrad=True
        )  # fmt: skip
        info["means2d"].retain_grad()
        image.square().sum().backward()
        found.append((info["means2d"].absgrad, info["means2d"].grad))
    for together, *alone in zip(*found, strict=True):
        expected = torch.cat(alone) if packed else torch.stack(alone)[None]
        assert torch.equal(together, expected)
        assert together.any()
