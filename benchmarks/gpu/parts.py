"""The machine, and one training run of ours, each for a process of its own."""

from __future__ import annotations

import subprocess
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch

from splatseed import load_scene
from splatseed.splat.evaluate import evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.device import pick_device

__all__ = ["machine", "train"]


def machine() -> dict[str, str]:
    """What it runs on; builds gsplat's kernels, the first time, so that no other part has to."""
    start = time.perf_counter()
    device = pick_device("cuda")
    loading = time.perf_counter() - start
    packages = ("torch", "gsplat", "splatseed")
    return {
        "GPU": f"{torch.cuda.get_device_name(device)}, driver {_driver()}",
        "CUDA of PyTorch": str(torch.version.cuda),
        "packages": ", ".join(f"{name} {version(name)}" for name in packages),
        "gsplat's kernels": f"loaded or built in {loading:.0f} s",
    }


def _driver() -> str:
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return said.partition("\n")[0].strip()


def train(scene: str, settings: dict[str, Any]) -> dict[str, Any]:
    """A run of splatseed's: scores, and the seconds of a step and of what goes before.

    Args:
        scene: The capture's folder.
        settings: Fields of ``TrainSettings``.
    """
    wanted = TrainSettings(**settings)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        run = prepare_run(load_scene(Path(scene)), Path(folder) / "run", wanted)
        before, counted = time.perf_counter() - start, run.state.watch.seconds
        run.train()
    return {
        "psnr": evaluate_views(run.trainer.render, run.trainer.test_views).psnr,
        "gaussians": run.count(),
        "step": (run.state.watch.seconds - counted) / wanted.max_steps,
        "before": before,
        "bytes": run.peak_gpu_bytes,
    }
