"""Batch dimensions: a batch is rendered as if it were alone, and ``info`` lists them in order."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseed.rendering import rasterization

from .scenes import random_scene

CAMERAS, N = 2, 40
BATCHES = [(2,), (2, 1, 2), (1,)]
MODELS = {
    "colors": {},
    "harmonics": {"sh_degree": 1},
    "antialiased, depth": {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"},
}


def scenes_of(batch, sh, per_camera=False):
    """Different scenes; some of their Gaussians are outside all cameras."""
    scenes = []
    for seed in range(int(np.prod(batch))):
        rng = np.random.default_rng(seed)
        scene = random_scene(rng, N, cameras=CAMERAS, coefficients=4 if sh else None)
        scene["viewmats"][:, 2, 3] = 0.7
        if per_camera:
            scene["colors"] = torch.rand(CAMERAS, *scene["colors"].shape)
        scenes.append(scene)
    return scenes


def joined(scenes, batch):
    return {
        name: stacked([scene[name] for scene in scenes], batch) if isinstance(value, Tensor)
        else value
        for name, value in scenes[0].items()
    }  # fmt: skip


def stacked(tensors, batch):
    return torch.stack(tensors).reshape(*batch, *tensors[0].shape)


def rendered(scene, options):
    """Image, alpha and the gradients of a loss that weights the last scene alone."""
    inputs = {k: v.clone().requires_grad_() for k, v in scene.items() if isinstance(v, Tensor)}
    image, alpha, info = rasterization(**{**scene, **inputs}, absgrad=True, **options)
    info["means2d"].retain_grad()
    (image if image.dim() == 4 else image.flatten(0, -5)[-1]).square().sum().backward()
    return image, alpha, *(each.grad for name, each in inputs.items() if name != "Ks")


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize(("packed", "per_camera"), [(True, False), (False, True)])
@pytest.mark.parametrize("model", MODELS)
def test_a_batch_is_rendered_as_if_alone(batch, packed, per_camera, model):
    options = {"packed": packed, **MODELS[model]}
    scenes = scenes_of(batch, "sh_degree" in options, per_camera)
    image, alpha, *gradients = rendered(joined(scenes, batch), options)
    alone = [rendered(scene, options) for scene in scenes]
    assert torch.equal(image, stacked([each[0] for each in alone], batch))
    assert torch.equal(alpha, stacked([each[1] for each in alone], batch))
    for ours, expected in zip(gradients, alone[-1][2:], strict=True):
        each = ours.flatten(0, len(batch) - 1)
        assert torch.equal(each[-1], expected)
        assert expected.any()
        assert not each[:-1].any()


@pytest.mark.parametrize("batch", BATCHES)
def test_info_is_stacked_and_packed_info_names_the_batch(batch):
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
