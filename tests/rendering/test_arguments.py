"""``rasterization``'s arguments: gsplat's names, and errors before rendering."""

from __future__ import annotations

import sys
from enum import Enum
from importlib import import_module
from inspect import signature

import gsplat
import numpy as np
import pytest
import torch

import splatseed
from splatseed.errors import MissingDependencyError, ParameterError
from splatseed.rendering import rasterization
from splatseed.rendering.rasterize import CUDA_ONLY

from .scenes import random_scene

N, C = 7, 2


class Shutter(Enum):
    """Stands in for gsplat's function, which needs its CUDA code."""

    GLOBAL = 0
    ROLLING = 1


def zeros(*shape):
    return torch.zeros(shape)


def pair(*rest):
    return zeros(N, 1, 3), zeros(*rest)


REFUSED = [
    {"camera_model": "fisheye"},
    {"covars": torch.eye(3).repeat(N, 1, 1)},
    {"rolling_shutter": Shutter.ROLLING},
    {"back_grounds": None},
    *({"sh_degree": degree} for degree in (4, -1)),
    {"render_mode": "rgb"},
    {"rasterize_mode": "antialias"},
    {"width": 0},
    {"height": 3.5},
    {"tile_size": 0},
    {"sparse_grad": True, "packed": False},
    {"near_plane": -1.0},
    {"eps2d": float("nan")},
    *({"means": bad} for bad in (None, zeros(N, 3).double(), zeros(N, 2), torch.tensor(1.0))),
    {"quats": zeros(N, 3)},
    *({"scales": bad} for bad in (np.zeros((N, 3), np.float32), zeros(N + 1, 3))),
    {"opacities": zeros(N, 1)},
    {"viewmats": zeros(0, 4, 4), "Ks": zeros(0, 3, 3)},
    {"viewmats": torch.eye(4)},
    {"Ks": torch.eye(3)[None]},
    *({"backgrounds": zeros(*shape)} for shape in ((1, 3), (3,))),
    *({"colors": zeros(*shape)} for shape in ((N - 1, 3), (C + 1, N, 3))),
    {"colors": zeros(N, 3).half()},
    {"colors": zeros(N, 0), "backgrounds": None},
    {"colors": pair(N, 3, 3)},
    {"colors": zeros(N, 8, 3), "sh_degree": 2},
    {"colors": zeros(N, 4, 2), "sh_degree": 0, "backgrounds": None},
    {"colors": zeros(N, 3), "sh_degree": 0},
    *({"colors": pair(*shape), "sh_degree": 1} for shape in ((N + 1, 3, 3), (3,))),
    {"colors": pair(N, 7, 3), "sh_degree": 2},
    {"colors": (zeros(N, 1, 3), np.zeros((N, 3, 3), np.float32)), "sh_degree": 0},
    {"absgrad": True, "colors": zeros(N, 5), "backgrounds": None},
]


def refuse(scene, change):
    name, value = next(iter(change.items()))
    with pytest.raises(ParameterError, match=f"{value}\\." if "mode" in name else name) as caught:
        rasterization(**{**scene, **change})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("change", REFUSED)
def test_an_error_names_the_argument_in_one_line(change):
    refuse(random_scene(np.random.default_rng(0), N, cameras=C), change)


BATCHED = [
    {"viewmats": torch.eye(4).repeat(C, 1, 1)},
    {"Ks": torch.eye(3).repeat(C, 1, 1)},
    {"colors": zeros(N, 3)},
    {"colors": zeros(N, 4, 3), "sh_degree": 1},
    {"colors": pair(N, 3, 3), "sh_degree": 1},
    {"backgrounds": zeros(C, 3)},
    {"means": zeros(1, 0, N, 3)},
    {"sparse_grad": True},
]


@pytest.mark.parametrize("change", BATCHED)
def test_tensors_without_the_batch_are_refused(change):
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    wide = {
        name: each.expand(1, 2, *each.shape) if isinstance(each, torch.Tensor) else each
        for name, each in scene.items()
    }
    refuse(wide, change)


def test_defaults_of_gsplats_further_arguments_pass():
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    defaults = {**CUDA_ONLY, "rolling_shutter": Shutter.GLOBAL, "tile_size": 16}
    assert torch.equal(rasterization(**scene, **defaults)[0], rasterization(**scene)[0])


@pytest.mark.parametrize("count", [1, 2])
def test_axes_of_equal_sizes_are_not_confused(count):
    scene = random_scene(np.random.default_rng(0), count, cameras=count, coefficients=count)
    shared = rasterization(**scene, sh_degree=0)[0]
    scene["colors"] = scene["colors"].expand(count, -1, -1, -1)
    assert torch.equal(shared, rasterization(**scene, sh_degree=0)[0])


def test_names_and_defaults_are_gsplats():
    ours, theirs = (signature(each).parameters for each in (rasterization, gsplat.rasterization))
    named = [name for name in ours if name != "unsupported"]
    assert named == list(theirs)[: len(named)]
    assert all(ours[name].default == theirs[name].default for name in named)
    assert set(CUDA_ONLY) == set(theirs) - set(named)


@pytest.mark.parametrize("package", ["torch", "gsplat"])
def test_a_missing_package_is_named_with_its_extra(package, monkeypatch):
    monkeypatch.setattr(splatseed, "render", None)
    for name in [name for name in sys.modules if name.startswith("splatseed.rendering")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingDependencyError, match=f"^.*'{package}>=.*$"):
        import_module("splatseed.rendering").MCMCStrategy  # noqa: B018  (looking it up is enough)
