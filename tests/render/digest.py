"""Print a digest of pictures and gradients of fixed scenes, byte for byte.

Run as a script: other processes, with other numbers of threads or caches, must print the same.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatseed.render import rasterization

__all__ = ["digest"]


def digest() -> str:
    """SHA-256 of images, alphas and all gradients of a crowd in two cameras, in three modes."""
    total = hashlib.sha256()
    for options in (
        {"absgrad": True},
        {"rasterize_mode": "antialiased", "packed": False},
        {"render_mode": "RGB+ED", "sh_degree": 3},
    ):
        for each in _render(options):
            total.update(each.detach().numpy().tobytes())
    return total.hexdigest()


def _render(options: dict[str, object]) -> list[Tensor]:
    rng = np.random.default_rng(0)
    n = 3000
    colors = rng.normal(size=(n, 16, 3)) if "sh_degree" in options else rng.random((n, 3))
    K = [[60.0, 0.0, 40.0], [0.0, 60.0, 30.0], [0.0, 0.0, 1.0]]
    viewmats = np.eye(4)[None].repeat(2, axis=0)
    viewmats[:, 2, 3] = 3.0, 2.0
    arrays = {
        "means": rng.uniform(-1, 1, (n, 3)), "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(-5, -1.5, (n, 3))), "opacities": rng.random(n),
        "colors": colors, "viewmats": viewmats,
    }  # fmt: skip
    inputs = {k: torch.tensor(v, dtype=torch.float32).requires_grad_() for k, v in arrays.items()}
    image, alpha, info = rasterization(
        **inputs, Ks=torch.tensor([K, K]), width=77, height=59, **options
    )
    info["means2d"].retain_grad()
    (image.square().sum() + alpha.sum()).backward()
    gradients = [each.grad for each in inputs.values()]
    absolute = [info["means2d"].absgrad] if "absgrad" in options else []
    return [image, alpha, info["means2d"].grad, *gradients, *absolute]


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(Path(__file__).stem, digest())  # noqa: T201  (its one result)
