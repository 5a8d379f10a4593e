"""``rasterization``'s arguments: gsplat's names, and what is refused before rendering."""

from __future__ import annotations

import subprocess
import sys
from enum import Enum
from inspect import signature
from typing import Any

import gsplat
import numpy as np
import pytest
import torch

from splatseed.errors import ParameterError
from splatseed.render import rasterization
from splatseed.render.rasterize import CUDA_ONLY

from .scenes import random_scene

N, C = 7, 2


class Shutter(Enum):
    """As gsplat's own, which lives beside its CUDA code."""

    GLOBAL = 0
    ROLLING = 1


def zeros(*shape: int) -> torch.Tensor:
    return torch.zeros(shape)


REFUSED: list[tuple[str, dict[str, Any]]] = [
    ("camera_model", {"camera_model": "fisheye"}),
    ("covars", {"covars": torch.eye(3).repeat(N, 1, 1)}),
    ("rolling_shutter", {"rolling_shutter": Shutter.ROLLING}),
    ("back_grounds", {"back_grounds": None}),
    ("sh_degree", {"sh_degree": 4}),
    ("sh_degree", {"sh_degree": -1}),
    ("rgb", {"render_mode": "rgb"}),
    ("antialias", {"rasterize_mode": "antialias"}),
    ("width", {"width": 0}),
    ("height", {"height": 3.5}),
    ("tile_size", {"tile_size": 0}),
    ("sparse_grad", {"sparse_grad": True, "packed": False}),
    ("near_plane", {"near_plane": -1.0}),
    ("eps2d", {"eps2d": float("nan")}),
    ("means", {"means": zeros(N, 3).double()}),
    ("colors", {"colors": zeros(N, 3).half()}),
    ("scales", {"scales": np.zeros((N, 3), np.float32)}),
    ("means", {"means": zeros(N, 2)}),
    ("means", {"means": torch.tensor(1.0)}),
    ("quats", {"quats": zeros(N, 3)}),
    ("scales", {"scales": zeros(N + 1, 3)}),
    ("opacities", {"opacities": zeros(N, 1)}),
    ("viewmats", {"viewmats": zeros(0, 4, 4), "Ks": zeros(0, 3, 3)}),
    ("viewmats", {"viewmats": torch.eye(4)}),
    ("Ks", {"Ks": torch.eye(3)[None]}),
    ("colors", {"colors": zeros(N - 1, 3)}),
    ("colors", {"colors": zeros(C + 1, N, 3)}),
    ("colors", {"colors": zeros(N, 0), "backgrounds": None}),
    ("backgrounds", {"backgrounds": zeros(1, 3)}),
    ("backgrounds", {"backgrounds": zeros(3)}),
    ("colors", {"sh_degree": 2, "colors": zeros(N, 8, 3)}),
    ("colors", {"sh_degree": 0, "colors": zeros(N, 4, 2), "backgrounds": None}),
    ("colors", {"sh_degree": 0, "colors": zeros(N, 3)}),
    ("colors", {"colors": (zeros(N, 1, 3), zeros(N, 3, 3))}),
    ("colors", {"sh_degree": 1, "colors": (zeros(N, 1, 3), zeros(N + 1, 3, 3))}),
    ("colors", {"sh_degree": 1, "colors": (zeros(N, 1, 3), zeros(3))}),
    ("colors", {"sh_degree": 2, "colors": (zeros(N, 1, 3), zeros(N, 7, 3))}),
    ("colors", {"sh_degree": 0, "colors": (zeros(N, 1, 3), np.zeros((N, 3, 3), np.float32))}),
    ("absgrad", {"absgrad": True, "colors": zeros(N, 5), "backgrounds": None}),
]


@pytest.mark.parametrize(("named", "change"), REFUSED)
def test_refused_in_one_line_that_names_the_argument(named: str, change: dict[str, Any]) -> None:
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    with pytest.raises(ParameterError, match=named) as caught:
        rasterization(**{**scene, **change})
    assert "\n" not in str(caught.value)


BATCHED: list[tuple[str, dict[str, Any]]] = [
    ("viewmats", {"means": zeros(2, N, 3)}),
    ("viewmats", {"viewmats": torch.eye(4).repeat(C, 1, 1)}),
    ("Ks", {"Ks": torch.eye(3).repeat(C, 1, 1)}),
    ("colors", {"colors": zeros(N, 3)}),
    ("colors", {"colors": zeros(N, 4, 3), "sh_degree": 1}),
    ("colors", {"colors": (zeros(N, 1, 3), zeros(N, 3, 3)), "sh_degree": 1}),
    ("backgrounds", {"backgrounds": zeros(C, 3)}),
    ("means", {"means": zeros(1, 0, N, 3)}),
    ("sparse_grad", {"sparse_grad": True}),
]


@pytest.mark.parametrize(("named", "change"), BATCHED)
def test_what_lacks_the_batch_is_refused(named: str, change: dict[str, Any]) -> None:
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    wide = {
        name: each.expand(1, 2, *each.shape) if isinstance(each, torch.Tensor) else each
        for name, each in scene.items()
    }
    with pytest.raises(ParameterError, match=named):
        rasterization(**{**wide, **change})


@pytest.mark.parametrize(
    "defaults",
    [{"camera_model": "pinhole", "distributed": False, "covars": None},
     {"rolling_shutter": Shutter.GLOBAL, "viewmats_rs": None},
     {"tile_size": 16, "channel_chunk": 32, "sparse_grad": False, "segmented": False}],
)  # fmt: skip
def test_defaults_of_gsplats_further_arguments_pass(defaults: dict[str, Any]) -> None:
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    assert torch.equal(rasterization(**scene, **defaults)[0], rasterization(**scene)[0])


@pytest.mark.parametrize("count", [1, 2])
def test_axes_of_equal_sizes_are_not_taken_for_one_another(count: int) -> None:
    scene = random_scene(np.random.default_rng(0), count, cameras=count, coefficients=count)
    shared = rasterization(**scene, sh_degree=0)[0]
    scene["colors"] = scene["colors"].expand(count, -1, -1, -1)
    assert torch.equal(shared, rasterization(**scene, sh_degree=0)[0])


def test_names_and_defaults_are_gsplats() -> None:
    ours, theirs = (signature(each).parameters for each in (rasterization, gsplat.rasterization))
    named = [name for name in ours if name != "unsupported"]
    assert named == list(theirs)[: len(named)]
    assert all(ours[name].default == theirs[name].default for name in named)
    assert set(CUDA_ONLY) == set(theirs) - set(named)


WITHOUT = """
import sys
sys.modules[{package!r}] = None
from splatseed.errors import MissingDependencyError
try:
    import splatseed.render
    assert not hasattr(splatseed.render, "DefaultStrategy")
    splatseed.render.MCMCStrategy
except MissingDependencyError as error:
    print(error)
"""


@pytest.mark.parametrize("package", ["torch", "gsplat"])
def test_a_missing_package_is_named_with_what_to_install(package: str) -> None:
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT.format(package=package)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout.count("\n") == 1
    assert f"'{package}>=" in run.stdout


def test_rendering_does_not_import_gsplat() -> None:
    code = "import sys, splatseed.render; sys.exit('gsplat' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
