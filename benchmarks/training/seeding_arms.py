"""The arms of ``seeding.py``: seeds of one method, trained on held-out training views.

Notation: rho is Gaussians per pixel of a photograph at the size that is trained. Promise: the views
that a run is scored on are held out of the training views after the test views were taken out, and
no method looks at them.
"""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from benchmarks.training.peer_starts import peer_start

import splatseed as ss
from splatseed.io.photograph import photograph_folder
from splatseed.io.staging import atomic_file
from splatseed.methods import configure
from splatseed.pointcloud import PointCloud
from splatseed.runtime.fingerprint import fingerprint
from splatseed.scene import Scene, Split
from splatseed.sfm import Settings, reconstruct, refined
from splatseed.splat.evaluate import evaluate_views
from splatseed.training import TrainSettings, prepare_run
from splatseed.training.depths import stereo_size
from splatseed.training.folder import Record
from splatseed.training.trainer import Trainer

__all__ = ["ARMS", "TEST_EVERY", "at_given_poses", "at_refined_poses", "train", "validation_split"]

ARMS: Mapping[str, Mapping[str, Any]] = {
    "sfm": {"method": "linear", "ratio": 1},
    "mls": {"method": "mls", "ratio": 4},
    "cover": {"method": "cover"},
    "stereo": {"method": "stereo", "dense": False},
    "auto": {"method": "auto", "dense": False},
    "auto, photographs alone": {"method": "auto", "dense": False, "depth_maps": False},
    "depth": {"method": "depth"},
    "auto, no points": {"method": "auto", "dense": False, "points": False},
    "1,500 of sfm": {"method": "linear", "ratio": 1, "kept": 1500},
    "auto, 1,500 of sfm": {"method": "auto", "dense": False, "kept": 1500},
    "auto, refined": {"method": "auto", "dense": False, "refined": True},
    "triangulated": {"method": "linear", "ratio": 1, "refined": True},
    "triangulated at given poses": {"method": "linear", "ratio": 1, "triangulated": True},
    "dense": {"method": "auto"},
    "dense, no points": {"method": "auto", "points": False},
    "random as gsplat": {"random": "gsplat"},
    "random as nerfstudio": {"random": "nerfstudio"},
    "random as Brush": {"random": "brush"},
    "random as LichtFeld": {"random": "lichtfeld"},
    "random, refined": {"random": "gsplat", "refined": True},
}
"""How seeds are made, by what the table calls them; *photographs alone* leaves out the depth maps
that come with a capture; at ratio 1 nothing is added to SfM's points, and without points these are
taken away first; *refined* is with ``--refine-poses``, which triangulates others in their place,
also where poses are exact and stay; *dense* are as many as the budget allows, and auto's others are
those of ``splatseed train``. SfM's points were made from all photographs, those held out too;
*triangulated* are only those of the features of the training photographs; *random as* are those of
other trainers (``peer_starts.py``)."""
TEST_EVERY = 8
HELD_STEP = 3
"""Runs of seed s hold out every eighth view from the one of number 3 s (mod 8) on."""


def train(
    scene: str, arm: str, strategy: str, rho: float, max_steps: int, data_factor: int, seed: int,
    every: int, kept: str | None = None, backend: Literal["cpu", "cuda"] = "cpu",
) -> dict[str, Any]:  # fmt: skip
    """One run, from every ``every``-th of the training photographs by name.

    Scores, Gaussians, seeds, and seconds: of seeding and of training by the clock, of training by
    the processor, and ``whole_processor``, from the scene in memory to the last step; the scores in
    the course of the run are its ``curve``. The folder ``kept`` holds seeds of earlier runs, whose
    seconds count all the same. On a GPU only ``seconds`` is what training takes.
    """
    whole = ss.load_scene(Path(scene), require_points=False)
    validation = validation_split(whole, every, HELD_STEP * seed % TEST_EVERY)
    camera = validation.images[0].camera
    cap = round(rho * (camera.width // data_factor) * (camera.height // data_factor))
    settings = TrainSettings(
        strategy=strategy, max_steps=max_steps, data_factor=data_factor, seed=seed,
        cap_max=cap, test_every=TEST_EVERY, backend=backend, seeding="scene",
    )  # fmt: skip
    plan = settings.max_seeds(cap), max_steps, data_factor, seed, every
    key = fingerprint(Path(scene).name, ARMS[arm], *plan)
    file = Path(kept) / f"{key}.npz" if kept else None
    seeding = seeding_processor = 0.0
    for how, place in (("refined", at_refined_poses), ("triangulated", at_given_poses)):
        if ARMS[arm].get(how, False):
            key = fingerprint(Path(scene).name, how, seed, every)
            poses = Path(kept) / f"{key}.npz" if kept else None
            validation, *took = _known_poses(validation, seed, place, poses)
            seeding, seeding_processor = took
    points, *more = _known_seeds(validation, arm, settings, file)
    seeding, seeding_processor = seeding + more[0], seeding_processor + more[1]
    begun = time.process_time() - seeding_processor
    with tempfile.TemporaryDirectory() as folder:
        run = prepare_run(validation.replace(points=points), Path(folder) / "run", settings)
        before = time.process_time()
        curve = Curve(run.trainer, begun)
        run.train(curve.on_step)
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
        "processor": curve.last - before,
        "whole_processor": curve.last - begun,
        "curve": curve.points,
    }


class Curve:
    """Scores of the held-out views in the course of a run, which takes no time to score them.

    Args:
        trainer: The trainer, whose records are watched.
        begun: The processor's clock when the run began, seeds included.
    """

    def __init__(self, trainer: Trainer, begun: float) -> None:
        self.points: list[tuple[int, float, float, float]] = []
        """Step, seconds by the processor, PSNR, SSIM."""
        self.last = begun
        """The clock at the last step, scoring left out."""
        self._begun, self._scoring = begun, 0.0
        self._pass_on, trainer.on_record = trainer.on_record, self._on_record

    def on_step(self, _: int) -> None:
        """Note the time of a step."""
        self.last = time.process_time() - self._scoring

    def _on_record(self, record: Record) -> None:
        if record.test_psnr is not None and record.test_ssim is not None:
            seconds = round(self.last - self._begun, 2)
            self.points.append((record.step, seconds, record.test_psnr, record.test_ssim))
        self._pass_on(record)
        self._scoring = time.process_time() - self.last


def validation_split(whole: Scene, every: int, first: int) -> Scene:
    """The training views; every eighth from ``first`` on is held out, the others are thinned."""
    validation = whole.replace(images=whole.split(TEST_EVERY)[0])
    images = sorted(validation.images, key=lambda image: image.name)
    held = tuple(images[first::TEST_EVERY])
    del images[first::TEST_EVERY]
    shown = tuple(images[::every])
    split = Split(*(frozenset(each.name for each in part) for part in (shown, held)), "benchmark")
    return validation.replace(images=(*shown, *held), listed=split)


def _known_seeds(
    scene: Scene, arm: str, settings: TrainSettings, file: Path | None
) -> tuple[PointCloud, float, float]:
    """The seeds of a run, from a file of an earlier one if there is one.

    Also returns the seconds that making them took, by the clock and by the processor.
    """
    if file is not None and file.is_file():
        with np.load(file) as arrays:
            values = {name: arrays[name] for name in arrays.files}
        seconds, processor = values.pop("seconds")
        return PointCloud(**values), float(seconds), float(processor)
    start, begun = time.perf_counter(), time.process_time()
    points = _seeds(scene, arm, settings)
    took = time.perf_counter() - start, time.process_time() - begun
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        arrays = {"xyz": points.xyz, "rgb": points.rgb, "source": points.source}
        with atomic_file(file) as partial, partial.open("wb") as opened:
            np.savez(opened, **arrays, **points.attributes, seconds=np.array(took))
    return points, *took


def _seeds(scene: Scene, arm: str, settings: TrainSettings) -> PointCloud:
    """The points that a run begins with, thinned where there are more than may be trained.

    Photographs are compared at the size at which ``splatseed train`` compares them.
    """
    chosen = dict(ARMS[arm])
    if "random" in chosen:
        return peer_start(scene, np.random.default_rng(settings.seed), chosen["random"])
    if not chosen.pop("points", True):
        scene = scene.replace(points=PointCloud.empty(), tracks=None)
    if kept := chosen.pop("kept", None):
        drawn = np.random.default_rng(settings.seed).permutation(len(scene.points))[:kept]
        scene = scene.replace(points=scene.points.select(np.sort(drawn)), tracks=None)
    for each in ("refined", "triangulated"):
        chosen.pop(each, None)
    name = chosen.pop("method")
    size = stereo_size(scene.split(TEST_EVERY)[0], settings, "cpu")
    known = {field.name for field in dataclasses.fields(ss.METHODS[name])}
    given = {"test_every": TEST_EVERY, "max_size": size, **chosen}
    method = configure(name, **{option: given[option] for option in known & given.keys()})
    how = {option: chosen[option] for option in chosen.keys() - known}
    points = ss.upsample(scene, method, budget=settings.max_seeds(settings.cap or 0), **how)
    return points.select(points.distinct)


def _known_poses(
    scene: Scene, seed: int, place: Callable[[Scene, int], Scene], file: Path | None
) -> tuple[Scene, float, float]:
    """The scene as ``place`` makes it, from a file of an earlier run if there is one.

    Also returns the seconds that it took, by the clock and by the processors of the child process.
    """
    if file is not None and file.is_file():
        with np.load(file) as arrays:
            kept = {name: arrays[name] for name in arrays.files}
        images = tuple(
            dataclasses.replace(image, quat=quat, translation=translation, observations=None)
            for image, quat, translation in zip(
                scene.images, kept["quats"], kept["translations"], strict=True
            )
        )
        points = PointCloud(kept["xyz"], kept["rgb"])
        return scene.replace(images=images, points=points, tracks=None), *kept["seconds"].tolist()
    start, before = time.perf_counter(), os.times()
    found = place(scene, seed)
    after = os.times()
    processor = after.children_user - before.children_user
    took = time.perf_counter() - start, processor + after.children_system - before.children_system
    if file is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(file) as partial, partial.open("wb") as opened:
            np.savez(
                opened,
                quats=np.stack([image.quat for image in found.images]),
                translations=np.stack([image.translation for image in found.images]),
                xyz=found.points.xyz, rgb=found.points.rgb, seconds=np.array(took),
            )  # fmt: skip
    return found, *took


def at_refined_poses(scene: Scene, seed: int) -> Scene:
    """The scene at refined poses, with points from features of its training photographs.

    Args:
        scene: A scene with photographs.
        seed: Seed of every random choice.
    """
    return refined(scene, seed, test_every=TEST_EVERY)[0]


def at_given_poses(scene: Scene, seed: int) -> Scene:
    """The scene with points triangulated at its poses, from features of its training photographs.

    Arguments as for ``at_refined_poses``.
    """
    test = {image.name for image in scene.split(TEST_EVERY)[1]}
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "scene"
        reconstruct(
            photograph_folder(scene), output, Settings(seed=seed), poses_from=scene,
            test_names=test, masks=scene.masks, keep=False,
        )  # fmt: skip
        points = ss.load_scene(output).points
    return scene.replace(points=PointCloud(points.xyz, points.rgb), tracks=None)
