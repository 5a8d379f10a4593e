"""Runs with known gains in them."""

from __future__ import annotations

import json
import math

import numpy as np

from splatseed.bench.plan import SFM, SHARED, Arm, RunResult, RunSpec
from splatseed.bench.runs import ERROR, RESULT, BenchRun, record_plan, run_folder
from splatseed.bench.scenes import PlannedScene, SceneFacts, survey
from splatseed.scores import CurvePoint, EvalResult, ViewScore
from splatseed.training.settings import TrainSettings

SCENES = ("bonsai", "fox", "room0", "treehill")
GAINS = {(SFM, 1): 0.0, ("linear", 8): 0.3, ("mls", 4): 0.2, ("mls", 8): 0.5, ("random", 8): -0.4}
"""The gain that is planted for each method and ratio, dB."""
NOISE = 0.02


def result(
    psnr, *, steps=1000, points=10, num_gaussians=5000, early=0.0, lpips=None, flip=None, **changes
):
    """A result whose curve rises to ``psnr`` in a straight line, ``early`` of the way sooner."""
    rise = [min(1.0, (i + 1) / points / (1 - early)) for i in range(points)]
    curve = tuple(
        CurvePoint(steps * (i + 1) // points, 2.0 * (i + 1), psnr - 10 + 10 * part, num_gaussians)
        for i, part in enumerate(rise)
    )
    view = ViewScore("a.png", psnr, 0.8, lpips, 0.01, psnr + 0.5, 0.9, flip)
    scores = EvalResult((view,), num_gaussians=num_gaussians, model_bytes=num_gaussians * 236)
    values = {"scores": scores, "curve": curve, "num_seeds": num_gaussians, "device": "CPU",
              "upsample_seconds": 0.5, "train_seconds": 20.0, "peak_bytes": 5 * 10**8,
              "wall_seconds": 25.0}  # fmt: skip
    return RunResult(**{**values, **changes})


def surveyed(path, *, name="room", images="", depth="", cloud="", with_depth=False):
    """Facts about a scene on disk."""
    planned = PlannedScene(str(path), name, images, str(depth), str(cloud))
    return survey(planned, with_depth=with_depth, with_cloud=bool(cloud))


def spec(
    scene, method, ratio, *, strategy="none", repeat=0, profile="default", budget="", **changes
):
    values = {"max_steps": 1000, "backend": "cpu", "data_factor": 4, **changes}
    own = {name: values.pop(name) for name in set(values) - set(SHARED)}
    facts = SceneFacts(own.pop("path", ""), scene, digest=own.pop("digest", f"{scene}0123"),
                       cloud_digest=own.pop("scan", ""))  # fmt: skip
    arm, training = Arm(method, profile, ratio, strategy, budget), TrainSettings(**values)
    return RunSpec(facts, arm, repeat, training, **{"version": "0.1.0", **own})


def runs(
    scenes=SCENES, gains=GAINS, strategies=("none",), repeats=3, noise=NOISE, seed=0, **changes
):
    """All runs of a plan, done; scenes and repeats have levels of their own, runs have noise."""
    rng = np.random.default_rng(seed)
    finished = []
    for strategy in strategies:
        for i, scene in enumerate(scenes):
            level = 24.0 + i + 0.05 * rng.standard_normal(repeats)
            for (method, ratio), gain in gains.items():
                for repeat in range(repeats):
                    psnr = level[repeat] + gain + noise * rng.standard_normal()
                    count, early = int(5000 * math.sqrt(ratio)), 0.1 if gain > 0 else 0.0
                    made = result(float(psnr), num_gaussians=count, early=early)
                    told = {"strategy": strategy, "repeat": repeat, **changes}
                    finished.append(BenchRun(spec(scene, method, ratio, **told), made))
    return finished


def write_bench(bench, planned, words=("--scenes", "<A>", "b c")):
    """A benchmark's folder with these runs."""
    record_plan(bench, "bench", [run.spec for run in planned], words)
    for run in planned:
        told = {"spec": run.spec.to_dict()}
        if run.result or run.error:
            told |= {"result": run.result.to_dict()} if run.result else {"error": run.error}
            folder = run_folder(bench, run.spec)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / (RESULT if run.result else ERROR)).write_text(json.dumps(told), "utf-8")
    return bench
