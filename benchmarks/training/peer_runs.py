"""One training run, by gsplat's own trainer or by ours, and what came of it.

Notation: *held out* are the views that a run is scored on: of the capture's test views, or without
these of every eighth of the rest (*validation*). Promise: both trainers are given the same pixels,
cameras and points, and their renders are scored by the same function; seconds are those of
training and of finding depth for growth, without reading, compiling, tests and scores.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from benchmarks.training.peer_stand_ins import Capture, Peer, fused_ssim, load_peer
from torch import Tensor

from splatseed import Scene, load_scene
from splatseed.errors import SceneFormatError
from splatseed.io.depth_maps import depth_folder
from splatseed.photos.loading import load_split
from splatseed.photos.view import View
from splatseed.rendering import mcmc_on_cpu
from splatseed.runtime.workarounds import keep_freed_memory
from splatseed.splat.evaluate import Render, evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.depths import known_depths
from splatseed.training.device import Capacity
from splatseed.training.schedule import FULL_RUN
from splatseed.training.seeds import usable_seeds
from splatseed.training.strategies.default import Capped

__all__ = ["Split", "read_scene", "train_ours", "train_peer"]

Split = Literal["validation", "test"]
Result = dict[str, float]

TEST_EVERY = 8
CPU = torch.device("cpu")


def read_scene(path: Path, split: Split) -> Scene:
    """The capture; for validation without its test views, which no choice may depend on."""
    scene = load_scene(path)
    if split == "test":
        return scene
    return scene.replace(images=scene.split(TEST_EVERY)[0])


def train_ours(scene: str, split: Split, settings: dict[str, Any]) -> Result:
    """A run of splatseed's.

    Args:
        scene: The capture's folder.
        split: Which views are held out.
        settings: Fields of ``TrainSettings``.
    """
    wanted = TrainSettings(**settings, test_every=TEST_EVERY, backend="cpu")
    with tempfile.TemporaryDirectory() as folder:
        run = prepare_run(read_scene(Path(scene), split), Path(folder) / "run", wanted)
        run.train()
    count = len(run.state.params["means"])
    return _result(run.trainer.render, run.trainer.test_views, count, run.state.watch.seconds)


def train_peer(
    scene: str, split: Split, settings: dict[str, Any], examples: str, *, capped: bool = False
) -> Result:
    """A run of gsplat's.

    Args:
        scene: The capture's folder.
        split: Which views are held out.
        settings: Fields of ``TrainSettings``: of them strategy, max_steps, seed, cap_max and
            data_factor; all else is gsplat's own.
        examples: The folder of its file.
        capped: Whether strategy ``default`` is held to the cap too, by our rule.
    """
    ours = TrainSettings(**settings)
    whole = read_scene(Path(scene), split)
    train, test_views = load_split(whole, data_factor=ours.data_factor, test_every=TEST_EVERY)
    capture = Capture((*train, *test_views), usable_seeds(whole.points, ours, print))
    comparing, options = 0.0, _options(ours)
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as maps:
        if ours.strategy == "grow":
            comparing = _write_depths(whole, ours, Path(maps) / "maps")
            options += ["--strategy.depths", f"{maps}/maps"]
        peer = load_peer(Path(examples), capture, Path(folder), options)
        _adjust(peer.config, ours, capped=capped)
        runner = _ready(peer, ours.seed, train)
        seconds = _train(runner, mcmc_on_cpu() if ours.strategy == "mcmc" else nullcontext())
    count = len(runner.splats["means"])
    return _result(_renderer(runner), test_views, count, seconds + comparing)


def _write_depths(scene: Scene, settings: TrainSettings, folder: Path) -> float:
    """Write the depth maps of the training views that ours grows by; returns the seconds."""
    depths, seconds = known_depths(scene, 1.0, settings, "cpu")
    with depth_folder(folder, "z") as writer:
        for name, depth in depths.items():
            writer.write(name, depth)
    return seconds


def _options(settings: TrainSettings) -> list[str]:
    """The peer's command line: a preset, schedules shrunk as it shrinks them, no tests and logs."""
    options: list[Any] = [settings.strategy, "--disable-viewer", "--disable-video"]
    options += ["--tb-every", 0, "--eval-steps", -1, "--save-steps", -1, "--test-every", TEST_EVERY]
    options += ["--steps-scaler", settings.max_steps / FULL_RUN]
    if settings.strategy != "default":
        options += ["--strategy.cap-max", settings.cap]
    return [str(option) for option in options]


def _adjust(config: Any, settings: TrainSettings, *, capped: bool) -> None:
    """What its command line cannot say."""
    config.max_steps = settings.max_steps  # its own product may be rounded down to one less
    if settings.strategy == "default" and capped:
        config.strategy = Capped(**vars(config.strategy))
        config.strategy.capacity = Capacity(settings.cap, CPU)
    # Runs of less than 300 steps would divide by an interval of 0.
    config.sh_degree_interval = max(1, config.sh_degree_interval)
    for name in ("refine_every", "reset_every"):
        if hasattr(config.strategy, name):
            setattr(config.strategy, name, max(1, getattr(config.strategy, name)))


def _ready(peer: Peer, seed: int, train: Sequence[View]) -> Any:
    """The runner, warm, and found to train on the views that ours trains on.

    Raises:
        SceneFormatError: It would train on others.
    """
    runner = peer.make_runner(seed)
    names = [runner.parser.image_names[i] for i in runner.trainset.indices]
    if names != [view.name for view in train]:
        raise SceneFormatError(
            "the same training views in both trainers",
            found=f"{len(names)} of gsplat's and {len(train)} of ours",
            fix="Report this: the stand-ins give gsplat another capture.",
        )
    keep_freed_memory()  # as our trainer does: what is compared is not the C library
    _warm_up(runner)
    return runner


def _warm_up(runner: Any) -> None:
    """Render and compare once, so that kernels are compiled before the clock runs."""
    example = runner.trainset[0]
    truth = example["image"][None] / 255.0
    image = _render(runner, example["camtoworld"], example["K"], *truth.shape[2:0:-1])
    (1 - fused_ssim(image.permute(0, 3, 1, 2), truth.permute(0, 3, 1, 2), "valid")).backward()
    for value in runner.splats.values():
        value.grad = None


def _train(runner: Any, context: AbstractContextManager[None]) -> float:
    """Train; returns the seconds, those of its checkpoint at the end among them."""
    with context:
        start = time.perf_counter()
        runner.train()
        return time.perf_counter() - start


def _renderer(runner: Any) -> Render:
    """Renders views of the world, at the cameras that gsplat moved into its own."""
    parser = runner.parser
    poses = dict(zip(parser.image_names, parser.camtoworlds, strict=True))

    @torch.no_grad()
    def render(view: View) -> Tensor:
        pose, K = (torch.from_numpy(each).float() for each in (poses[view.name], view.K))
        return _render(runner, pose, K, view.width, view.height)[0]

    return render


def _render(runner: Any, pose: Tensor, K: Tensor, width: int, height: int) -> Tensor:
    """As its own evaluation does."""
    config = runner.cfg
    image, _, _ = runner.rasterize_splats(
        camtoworlds=pose[None], Ks=K[None], width=width, height=height,
        sh_degree=config.sh_degree, near_plane=config.near_plane, far_plane=config.far_plane,
    )  # fmt: skip
    return image


def _result(render: Render, test_views: Sequence[View], count: int, seconds: float) -> Result:
    scores = evaluate_views(render, test_views)
    return {
        "psnr": float(np.round(scores.psnr, 4)),
        "ssim": float(np.round(scores.ssim, 5)),
        "gaussians": count,
        "seconds": round(seconds, 2),
    }
