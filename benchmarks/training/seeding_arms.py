"""The arms of ``seeding.py``: seeds of one method, trained on held-out training views.

Notation: rho is Gaussians per pixel of a photograph at the size that is trained. Promise: the views
that a run is scored on are held out of the training views after the test views were taken out, and
no method looks at them.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64

import splatseed as ss
from splatseed.evaluate import evaluate_views
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene
from splatseed.train import TrainSettings, prepare_run
from splatseed.train.seeds import SEEDS_SHARE
from splatseed.upsample import configure

__all__ = ["ARMS", "TEST_EVERY", "train"]

ARMS: Mapping[str, Mapping[str, Any]] = {
    "sfm": {"method": "linear", "ratio": 1},
    "mls": {"method": "mls", "ratio": 4},
    "cover": {"method": "cover"},
    "stereo": {"method": "stereo"},
    "auto": {"method": "auto"},
    "auto, no points": {"method": "auto", "points": False},
    "random as gsplat": {"cube": "gsplat"},
    "random as nerfstudio": {"cube": "nerfstudio"},
}
"""How seeds are made, by what the table calls them; at ratio 1 nothing is added to SfM's points,
and without points these are taken away first."""
TEST_EVERY = 8


def train(
    scene: str, arm: str, strategy: str, rho: float, max_steps: int, data_factor: int, seed: int
) -> dict[str, float]:
    """One run.

    Scores, Gaussians, seeds, and seconds: of seeding and of training by the clock, of training by
    the processor, and ``whole_processor``, from the scene in memory to the last step.
    """
    whole = ss.load_scene(Path(scene))
    validation = whole.replace(images=whole.split(TEST_EVERY)[0])
    camera = validation.images[0].camera
    cap = round(rho * (camera.width // data_factor) * (camera.height // data_factor))
    start, begun = time.perf_counter(), time.process_time()
    points = _seeds(validation, arm, round(SEEDS_SHARE.get(strategy, 1.0) * cap), seed)
    seeding = time.perf_counter() - start
    settings = TrainSettings(
        strategy=strategy, max_steps=max_steps, data_factor=data_factor, seed=seed,
        cap_max=cap, test_every=TEST_EVERY, backend="cpu",
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        run = prepare_run(validation.replace(points=points), Path(folder) / "run", settings)
        before = time.process_time()
        run.train()
        processor, whole = time.process_time() - before, time.process_time() - begun
    scores = evaluate_views(run.trainer.render, run.trainer.test_views)
    return {
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "gaussians": len(run.state.params["means"]),
        "seeds": len(points),
        "seeding": seeding,
        "seconds": run.state.watch.seconds,
        "processor": processor,
        "whole_processor": whole,
    }


def _seeds(scene: Scene, arm: str, most: int, seed: int) -> PointCloud:
    """The points that a run begins with, thinned where there are more than may be trained."""
    chosen = dict(ARMS[arm])
    if "cube" in chosen:
        centers = np.stack([image.camera.center for image in scene.images])
        axes = np.stack([image.camera.cam_from_world[2, :3] for image in scene.images])
        return _CUBES[chosen["cube"]](centers, axes, np.random.default_rng(seed))
    if not chosen.pop("points", True):
        scene = scene.replace(points=PointCloud.empty(), tracks=None)
    name = chosen.pop("method")
    looks = hasattr(ss.METHODS[name], "hold_out")
    method = configure(name, hold_out=TEST_EVERY) if looks else configure(name)
    points = ss.upsample(scene, method, budget=most, **chosen)
    return points.select(points.distinct)


def _as_gsplat(
    centers: Float64[np.ndarray, "V 3"], axes: Float64[np.ndarray, "V 3"], rng: np.random.Generator
) -> PointCloud:
    """What gsplat 1.5.3's simple_trainer starts from without points: 3.3 times the cameras' reach.

    Its world is centred at the median, over cameras, of the point on the optical axis that is
    nearest to the origin; it is turned too, which the median of coordinates feels a little.
    """
    nearest = centers - (centers * axes).sum(axis=1, keepdims=True) * axes
    reach = np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    return _in_cube(np.median(nearest, axis=0), 3.0 * 1.1 * reach, 100_000, rng)


def _as_nerfstudio(
    centers: Float64[np.ndarray, "V 3"], _: Float64[np.ndarray, "V 3"], rng: np.random.Generator
) -> PointCloud:
    """What nerfstudio's splatfacto does: a cube 10 wide, the cameras' coordinates scaled to 1."""
    middle = centers.mean(axis=0)
    return _in_cube(middle, 5.0 * np.abs(centers - middle).max(), 50_000, rng)


_CUBES: Mapping[str, Callable[..., PointCloud]] = {
    "gsplat": _as_gsplat,
    "nerfstudio": _as_nerfstudio,
}


def _in_cube(
    middle: Float64[np.ndarray, " 3"], half: float, num: int, rng: np.random.Generator
) -> PointCloud:
    """Uniform positions and colours."""
    xyz = middle + half * rng.uniform(-1.0, 1.0, (num, 3))
    return PointCloud(xyz.astype(np.float32), rng.integers(0, 256, (num, 3), dtype=np.uint8))
