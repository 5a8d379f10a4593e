"""The arms of ``seeding.py``: seeds of one method, trained on held-out training views.

Notation: rho is Gaussians per pixel of a photograph at the size that is trained. Promise: the views
that a run is scored on are held out of the training views after the test views were taken out, and
no method looks at them.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

import splatseed as ss
from splatseed.methods import configure
from splatseed.pointcloud import PointCloud
from splatseed.scene import Scene, Split
from splatseed.seeding.poses import random_start
from splatseed.sfm import refined
from splatseed.splat.evaluate import evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.depths import stereo_size

__all__ = ["ARMS", "TEST_EVERY", "train", "triangulated", "validation_split"]

ARMS: Mapping[str, Mapping[str, Any]] = {
    "sfm": {"method": "linear", "ratio": 1},
    "mls": {"method": "mls", "ratio": 4},
    "cover": {"method": "cover"},
    "stereo": {"method": "stereo"},
    "auto": {"method": "auto"},
    "auto, no points": {"method": "auto", "points": False},
    "auto, refined": {"method": "auto", "points": False, "refined": True},
    "triangulated": {"method": "linear", "ratio": 1, "points": False, "refined": True},
    "random as gsplat": {"random": "gsplat"},
    "random as nerfstudio": {"random": "nerfstudio"},
}
"""How seeds are made, by what the table calls them; at ratio 1 nothing is added to SfM's points,
and without points these are taken away first; *refined* is with ``--refine-poses``, which
triangulates some again. SfM's points were made from all photographs, those held out too;
*triangulated* are only those of the features of the training photographs."""
TEST_EVERY = 8
HELD_STEP = 3
"""Runs of seed s hold out every eighth view from the one of number 3 s (mod 8) on."""


def train(
    scene: str, arm: str, strategy: str, rho: float, max_steps: int, data_factor: int, seed: int,
    every: int,
) -> dict[str, float]:  # fmt: skip
    """One run, from every ``every``-th of the training photographs by name.

    Scores, Gaussians, seeds, and seconds: of seeding and of training by the clock, of training by
    the processor, and ``whole_processor``, from the scene in memory to the last step.
    """
    whole = ss.load_scene(Path(scene))
    validation = validation_split(whole, every, HELD_STEP * seed % TEST_EVERY)
    camera = validation.images[0].camera
    cap = round(rho * (camera.width // data_factor) * (camera.height // data_factor))
    settings = TrainSettings(
        strategy=strategy, max_steps=max_steps, data_factor=data_factor, seed=seed,
        cap_max=cap, test_every=TEST_EVERY, backend="cpu", seeding="scene",
    )  # fmt: skip
    start, begun = time.perf_counter(), time.process_time()
    points = _seeds(validation, arm, settings)
    seeding = time.perf_counter() - start
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
        "cap": cap,
        "points": int(validation.points.distinct.sum()),
        "seeding": seeding,
        "seconds": run.state.watch.seconds,
        "processor": processor,
        "whole_processor": whole,
    }


def validation_split(whole: Scene, every: int, first: int) -> Scene:
    """The training views; every eighth from ``first`` on is held out, the others are thinned."""
    validation = whole.replace(images=whole.split(TEST_EVERY)[0])
    images = sorted(validation.images, key=lambda image: image.name)
    held = tuple(images[first::TEST_EVERY])
    del images[first::TEST_EVERY]
    shown = tuple(images[::every])
    split = Split(*(frozenset(each.name for each in part) for part in (shown, held)), "benchmark")
    return validation.replace(images=(*shown, *held), listed=split)


def _seeds(scene: Scene, arm: str, settings: TrainSettings) -> PointCloud:
    """The points that a run begins with, thinned where there are more than may be trained.

    Photographs are compared at the size at which ``splatseed train`` compares them.
    """
    chosen = dict(ARMS[arm])
    if "random" in chosen:
        return random_start(scene, np.random.default_rng(settings.seed), chosen["random"])
    if not chosen.pop("points", True):
        scene = scene.replace(points=PointCloud.empty(), tracks=None)
    if chosen.pop("refined", False):
        scene = triangulated(scene, settings.seed)
    name = chosen.pop("method")
    size = stereo_size(scene.split(TEST_EVERY)[0], settings, "cpu")
    known = {field.name for field in dataclasses.fields(ss.METHODS[name])}
    given = {"test_every": TEST_EVERY, "max_size": size}
    method = configure(name, **{option: given[option] for option in known & given.keys()})
    points = ss.upsample(scene, method, budget=settings.max_seeds(settings.cap or 0), **chosen)
    return points.select(points.distinct)


def triangulated(scene: Scene, seed: int) -> Scene:
    """The scene with points from the features of its training photographs, at its own poses.

    Args:
        scene: A scene with photographs.
        seed: Seed of every random choice.
    """
    shown = scene.replace(images=scene.split(TEST_EVERY)[0])
    return scene.replace(points=refined(shown, seed)[0].points, tracks=None)
