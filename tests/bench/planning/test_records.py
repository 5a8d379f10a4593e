"""Specifications and results of runs survive JSON, and keys tell runs apart."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math

import pytest

from splatseed.bench.planning.records import SFM, Arm, RunResult, RunSpec
from splatseed.scores import CurvePoint, EvalResult, ViewScore
from splatseed.train.settings import TrainSettings

ARM = Arm("mls", "default", 8, "none")
TRAINING = TrainSettings(max_steps=100, backend="cpu")
SPEC = RunSpec("room", "ab12", ARM, repeat=0, training=TRAINING, parameters={"k": 12}, version="1")


def test_specs_survive_json():
    assert RunSpec.from_json(SPEC.to_json()) == SPEC
    assert RunSpec.from_json(SPEC.to_json()).key == SPEC.key


def test_results_survive_json():
    views = (ViewScore("a.png", math.inf, 0.8, None, 0.01, 22.0, 0.9),)
    scores = EvalResult(views, num_gaussians=8, model_bytes=1888)
    curve = (CurvePoint(5, 0.1, 20.0, 7, 0.7),)
    result = RunResult(scores, curve, 7, 0.2, 1.5, 10**9, "CPU", twin="ab")
    assert RunResult.from_json(result.to_json()) == result


def test_results_of_the_old_layout_are_read():
    """Scores stood beside the rest, and co-visible pixels were not known."""
    old = {
        "psnr": 21.5, "ssim": 0.8, "lpips": None,
        "per_image": [{"name": "a.png", "psnr": 21.5, "ssim": 0.8, "lpips": None}],
        "curve": [{"step": 5, "seconds": 0.1, "psnr": 20.0, "num_gaussians": 7}],
        "num_seeds": 7, "num_gaussians": 8, "model_bytes": 1888, "upsample_seconds": 0.2,
        "train_seconds": 1.5, "render_seconds": 0.01, "peak_bytes": 10**9, "device": "CPU",
        "peak_gpu_bytes": None,
    }  # fmt: skip
    result = RunResult.from_json(json.dumps(old))
    assert (result.psnr, result.num_gaussians, result.scores.render_seconds) == (21.5, 8, 0.01)
    assert result.curve == (CurvePoint(5, 0.1, 20.0, 7),)
    assert result.scores.covisible_psnr is None
    assert RunResult.from_json(result.to_json()) == result


def test_where_a_scene_lies_is_no_part_of_the_key():
    there = dataclasses.replace(
        SPEC, scene_path="/a", depth_path="/b", images="images_4", cloud_path="/c"
    )
    assert there.key == SPEC.key


def test_a_whole_ratio_may_be_written_either_way():
    assert dataclasses.replace(SPEC, arm=Arm("mls", "default", 8.0, "none")).key == SPEC.key


@pytest.mark.parametrize(
    "change",
    [{"scene": "x"}, {"scene_digest": "x"}, {"repeat": 1}, {"version": "2"},
     {"parameters": {"k": 13}}, {"depth_digest": "x"}, {"cloud_digest": "x"},
     {"arm": Arm("mls", "default", 4, "none")}, {"arm": Arm("mls", "paper", 8, "none")},
     {"arm": Arm("mls", "default", 8, "mcmc")}, {"arm": Arm("linear", "default", 8, "none")}],
)  # fmt: skip
def test_all_else_is(change):
    assert dataclasses.replace(SPEC, **change).key != SPEC.key


@pytest.mark.parametrize(
    "change",
    [{"max_steps": 101}, {"data_factor": 2}, {"test_every": 4}, {"cap_max": 9}, {"sh_degree": 0},
     {"backend": "cuda"}, {"opacity_reset": True}, {"seed_sizes": True}, {"seed_colors": True}],
)  # fmt: skip
def test_so_is_every_setting_of_training(change):
    changed = dataclasses.replace(SPEC, training=dataclasses.replace(TRAINING, **change))
    assert changed.key != SPEC.key
    assert RunSpec.from_json(changed.to_json()) == changed


def test_an_older_ledger_keeps_its_keys():
    """Its runs have fewer settings, and must not be run again for that."""
    old = json.loads(SPEC.to_json())
    for later in (
        "placing",
        "seed_sizes",
        "seed_normals",
        "seed_colors",
        "cloud_digest",
        "cloud_path",
    ):
        del old[later]
    assert RunSpec.from_json(json.dumps(old)) == SPEC
    where = {"scene_path", "depth_path", "images"}
    told = {name: value for name, value in old.items() if name not in where}
    del told["arm"]["budget"]
    text = json.dumps(told, sort_keys=True, separators=(",", ":"))
    assert SPEC.key == hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def test_settings_and_labels():
    assert (SPEC.settings.strategy, SPEC.settings.seed) == ("none", 0)
    assert ARM.label == "mls 8x"
    assert Arm(SFM, "default", 1, "none").label == "sfm"
    assert Arm("mls", "paper", 4, "none").label == "mls 4x (paper)"
