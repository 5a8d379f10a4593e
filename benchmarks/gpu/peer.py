"""gsplat's own trainer on a GPU: its file, strategy mcmc, on our views and points.

Of what ``training/peer_stand_ins.py`` gives it in place of CUDA, viewer and files, it keeps the
last two here: it renders with gsplat, loads photographs with its own worker processes, and has
``fused_ssim`` where that is installed, else the convolutions that splatseed has then.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import gsplat.rendering
import torch
from benchmarks.training.peer_runs import TEST_EVERY, _adjust, _options
from benchmarks.training.peer_stand_ins import Capture, load_peer
from torch import Tensor

from splatseed import load_scene
from splatseed.photos.loading import load_split
from splatseed.photos.view import View
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.ssim import l1_and_ssim_by_convolution
from splatseed.training import TrainSettings
from splatseed.training.device import pick_device
from splatseed.training.seeds import usable_seeds
from splatseed.training.trainer import _fused_ssim

__all__ = ["train"]


def train(scene: str, settings: dict[str, Any], examples: str) -> dict[str, Any]:
    """A run of gsplat's, told as ``parts.train`` tells ours.

    Args:
        scene: The capture's folder.
        settings: Fields of ``TrainSettings``: max_steps, cap_max and data_factor.
        examples: The folder of its file.
    """
    start, device = time.perf_counter(), pick_device("cuda")
    wanted = TrainSettings(**settings, strategy="mcmc")
    whole = load_scene(Path(scene))
    views, test_views = load_split(whole, data_factor=wanted.data_factor, test_every=TEST_EVERY)
    capture = Capture((*views, *test_views), usable_seeds(whole.points, wanted, lambda _: None))
    with tempfile.TemporaryDirectory() as folder:
        runner = _runner(capture, wanted, Path(examples), Path(folder))
        _step(runner, test_views[0]).mean().backward()  # loads its kernels
        for value in runner.splats.values():
            value.grad = None
        torch.cuda.synchronize()
        begun = time.perf_counter()
        runner.train()
        torch.cuda.synchronize()
        ended = time.perf_counter()
    with torch.no_grad():
        scores = evaluate_views(lambda view: _step(runner, view), test_views)
    return {
        "psnr": scores.psnr,
        "gaussians": len(runner.splats["means"]),
        "step": (ended - begun) / wanted.max_steps,
        "before": begun - start,
        "bytes": torch.cuda.max_memory_allocated(device),
    }


def _runner(capture: Capture, wanted: TrainSettings, examples: Path, folder: Path) -> Any:
    """Its Runner on the first GPU."""
    loader, rasterize = torch.utils.data.DataLoader, gsplat.rendering.rasterization
    main, config = load_peer(examples, capture, folder, _options(wanted)).make_runner.args  # type: ignore[attr-defined]  # a partial
    torch.utils.data.DataLoader = loader
    main.__globals__.update(rasterization=rasterize, fused_ssim=_fused_ssim() or _convolved_ssim)
    _adjust(config, wanted, capped=False)
    return main.__globals__["Runner"](0, 0, 1, config)


def _step(runner: Any, view: View) -> Tensor:
    """A render, at the camera that gsplat moved into its own world."""
    parser, config = runner.parser, runner.cfg
    pose = parser.camtoworlds[parser.image_names.index(view.name)]
    image, _, _ = runner.rasterize_splats(
        camtoworlds=torch.from_numpy(pose).float()[None].to(runner.device),
        Ks=torch.from_numpy(view.K).float()[None].to(runner.device),
        width=view.width, height=view.height,
        sh_degree=config.sh_degree, near_plane=config.near_plane, far_plane=config.far_plane,
    )  # fmt: skip
    return image[0]


def _convolved_ssim(x: Tensor, y: Tensor, padding: str) -> Tensor:
    """``fused_ssim`` of two images [1, 3, H, W], valid windows only."""
    if padding != "valid" or len(x) != 1:
        raise NotImplementedError(f"{padding} padding, {len(x)} images")
    similarity: Tensor = _Ssim.apply(*(each[0].permute(1, 2, 0) for each in (x, y)))
    return similarity


class _Ssim(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:
        _, similarity, gradient = l1_and_ssim_by_convolution(x, y, 0.0, 1.0)
        ctx.save_for_backward(gradient)
        return similarity

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * -upstream[0], None  # it is that of 1 - SSIM
