"""Against what gsplat itself gave on a GPU, where someone has kept it.

The file is written, and its format described, by ``benchmarks/gpu/compare_gsplat.py``.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from splatseed.render import rasterization

GOLDEN = Path(__file__).with_name("golden_gsplat.npz")
TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    if not GOLDEN.is_file():
        pytest.skip(f"{GOLDEN.name} not there: benchmarks.gpu --golden writes it on a GPU")
    with np.load(GOLDEN) as file:
        return dict(file)


def test_agrees_with_gsplat(golden: dict[str, np.ndarray]) -> None:
    names = sorted({key.partition("/")[0] for key in golden})
    assert names
    for name in names:
        ours = _run(_part(golden, f"{name}/inputs/"), json.loads(str(golden[f"{name}/options"])))
        for key, expected in _part(golden, f"{name}/outputs/").items():
            largest = max(float(np.abs(expected).max()), 1e-12)
            assert np.abs(ours[key] - expected).max() <= TOLERANCE * largest, (name, key)


def _part(golden: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    return {
        key.removeprefix(prefix): each for key, each in golden.items() if key.startswith(prefix)
    }


def _run(inputs: dict[str, np.ndarray], options: dict[str, object]) -> dict[str, np.ndarray]:
    tensors = {name: torch.from_numpy(array).requires_grad_() for name, array in inputs.items()}
    image, alpha, info = rasterization(**tensors, **options)
    info["means2d"].retain_grad()
    ((image - 0.3).square().sum() + (alpha - 0.5).square().sum()).backward()
    results = {"image": image, "alpha": alpha, "d_means2d": info["means2d"].grad}
    results |= {f"d_{name}": each.grad for name, each in tensors.items() if each.grad is not None}
    if options.get("absgrad"):
        results["absgrad"] = info["means2d"].absgrad
    return {name: each.detach().numpy() for name, each in results.items()}
