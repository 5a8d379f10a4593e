"""What ``rasterization`` cannot do is refused in one line, before anything is rendered."""

from __future__ import annotations

import re
import subprocess
import sys
from enum import Enum
from typing import Any

import numpy as np
import pytest
import torch

from splatseed.errors import ParameterError
from splatseed.render import rasterization

from .scenes import random_scene

N, C = 7, 2


class Shutter(Enum):
    """As gsplat's own, which lives beside its CUDA code."""

    GLOBAL = 0
    ROLLING = 1


REFUSED: dict[str, dict[str, Any]] = {
    "fisheye cameras": {"camera_model": "fisheye"},
    "distributed": {"distributed": True},
    "covars": {"covars": torch.eye(3).repeat(N, 1, 1)},
    "with_ut": {"with_ut": True},
    "distortion": {"radial_coeffs": torch.zeros(C, 6)},
    "rolling shutter": {"rolling_shutter": Shutter.ROLLING},
    "a misspelt argument": {"back_grounds": None},
    "degree 4": {"sh_degree": 4},
    "degree -1": {"sh_degree": -1},
    "unknown render_mode": {"render_mode": "rgb"},
    "unknown rasterize_mode": {"rasterize_mode": "antialias"},
    "width 0": {"width": 0},
    "fractional height": {"height": 3.5},
    "tile_size 0": {"tile_size": 0},
    "sparse gradients of what is not packed": {"sparse_grad": True, "packed": False},
    "negative near plane": {"near_plane": -1.0},
    "NaN blur": {"eps2d": float("nan")},
    "float64": {"means": torch.zeros(N, 3, dtype=torch.float64)},
    "half": {"colors": torch.zeros(N, 3, dtype=torch.float16)},
    "means of NumPy": {"means": np.zeros((N, 3), np.float32)},
    "NumPy": {"scales": np.zeros((N, 3), np.float32)},
    "means [N, 2]": {"means": torch.zeros(N, 2)},
    "means without an axis": {"means": torch.tensor(1.0)},
    "quats [N, 3]": {"quats": torch.zeros(N, 3)},
    "scales of others": {"scales": torch.zeros(N + 1, 3)},
    "opacities [N, 1]": {"opacities": torch.zeros(N, 1)},
    "no camera": {"viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)},
    "one viewmat without its axis": {"viewmats": torch.eye(4)},
    "fewer Ks than viewmats": {"Ks": torch.eye(3)[None]},
    "colors of others": {"colors": torch.zeros(N - 1, 3)},
    "colors of more cameras": {"colors": torch.zeros(C + 1, N, 3)},
    "colors of no channel": {"colors": torch.zeros(N, 0)},
    "one background for two": {"backgrounds": torch.zeros(1, 3)},
    "background without its axis": {"backgrounds": torch.zeros(3)},
    "too few coefficients": {"sh_degree": 2, "colors": torch.zeros(N, 8, 3)},
    "coefficients of two channels": {"sh_degree": 0, "colors": torch.zeros(N, 4, 2)},
    "colors for coefficients": {"sh_degree": 0, "colors": torch.zeros(N, 3)},
    "pair without coefficients": {"colors": (torch.zeros(N, 1, 3), torch.zeros(N, 3, 3))},
    "pair of others": {"sh_degree": 1, "colors": (torch.zeros(N, 1, 3), torch.zeros(N + 1, 3, 3))},
    "pair of too few": {"sh_degree": 2, "colors": (torch.zeros(N, 1, 3), torch.zeros(N, 7, 3))},
    "pair of NumPy": {
        "sh_degree": 0,
        "colors": (torch.zeros(N, 1, 3), np.zeros((N, 3, 3), np.float32)),
    },
    "absgrad of five channels": {"absgrad": True, "colors": torch.zeros(N, 5), "backgrounds": None},
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    scene = random_scene(np.random.default_rng(0), N, cameras=C)
    with pytest.raises(ParameterError) as caught:
        rasterization(**{**scene, **REFUSED[case]})
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("expected ")


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
def test_one_gaussian_one_camera_one_coefficient(count: int) -> None:
    """Where all sizes are equal, axes must not be taken for one another."""
    scene = random_scene(np.random.default_rng(0), count, cameras=count, coefficients=count)
    shared = rasterization(**scene, sh_degree=0)[0]
    scene["colors"] = scene["colors"].expand(count, -1, -1, -1)
    assert torch.equal(shared, rasterization(**scene, sh_degree=0)[0])


def test_names_and_defaults_are_gsplats() -> None:
    from inspect import signature

    from gsplat import rasterization as gsplats

    from splatseed.render.validation import CUDA_ONLY

    ours, theirs = signature(rasterization).parameters, signature(gsplats).parameters
    named = [name for name in ours if name != "unsupported"]
    assert named == list(theirs)[: len(named)]
    assert all(ours[name].default == theirs[name].default for name in named)
    assert set(CUDA_ONLY) == set(theirs) - set(named)


WITHOUT_TORCH = """
import sys
sys.modules["torch"] = None
import splatseed
assert not [name for name in sys.modules if name.startswith("splatseed.render")]
from splatseed.errors import MissingDependencyError
try:
    import splatseed.render
except MissingDependencyError as error:
    print(error)
"""


def test_without_torch_the_error_says_what_to_install() -> None:
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, check=True
    )
    assert run.stdout.count("\n") == 1
    assert re.search(r"pip install .*'torch>=2\.4'", run.stdout)
