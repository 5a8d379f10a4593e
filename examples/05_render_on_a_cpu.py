"""Fit Gaussians to an image with code written for gsplat, without a GPU.

python examples/05_render_on_a_cpu.py [STEPS]
"""

from __future__ import annotations

import os
import sys

os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # before PyTorch: see docs/training.md

import numpy as np
import torch
from PIL import Image

from splatseed.rendering import rasterization
from splatseed.synthetic import make_capture

NUM_GAUSSIANS = 600


def main(steps: int) -> None:
    """Fit Gaussians, and write image and render side by side."""
    image = make_capture(seed=0, num_views=3, width=160, height=120).images[0]
    truth = torch.tensor(image) / 255.0
    height, width, _ = truth.shape
    K = torch.tensor([[80.0, 0, width / 2], [0, 80.0, height / 2], [0, 0, 1]])
    camera = {"viewmats": torch.eye(4)[None], "Ks": K[None], "width": width, "height": height}
    torch.manual_seed(0)
    means = torch.rand(NUM_GAUSSIANS, 3) * torch.tensor([4.0, 3.0, 0.0]) - torch.tensor(
        [2, 1.5, -2.0]
    )
    params = {
        "means": means,
        "quats": torch.randn(NUM_GAUSSIANS, 4),
        "scales": torch.full((NUM_GAUSSIANS, 3), -2.5),
        "opacities": torch.zeros(NUM_GAUSSIANS),
        "colors": torch.zeros(NUM_GAUSSIANS, 3),
    }
    optimizer = torch.optim.Adam([param.requires_grad_() for param in params.values()], lr=0.02)
    for step in range(steps + 1):
        renders, _, _ = rasterization(
            means=params["means"],
            quats=params["quats"],
            scales=torch.exp(params["scales"]),
            opacities=torch.sigmoid(params["opacities"]),
            colors=torch.sigmoid(params["colors"]),
            **camera,
        )
        loss = (renders[0] - truth).square().mean()
        if step % (steps // 4) == 0:
            print(f"step {step:4d}: {-10 * float(loss.detach().log10()):.2f} dB")
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    render = (renders[0].detach().clamp(0, 1).numpy() * 255).round().astype(np.uint8)
    Image.fromarray(np.hstack([image, render])).save("fitted.png")
    print("wrote fitted.png: the image and its fit")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 300)
