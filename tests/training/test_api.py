"""Training and scoring as users write them: through ``splatseed``."""

from __future__ import annotations

import dataclasses
import json
import os
import signal

import numpy as np
import pytest

import splatseed as ss
from splatseed.errors import OutputError, ParameterError, SceneNotFoundError
from splatseed.training.api import prepare_training
from splatseed.training.request import TrainRequest

SHORT = {"strategy": "none", "max_steps": 60, "data_factor": 2, "test_every": 3, "seeding": "scene"}


@pytest.fixture(scope="module")
def trained(room_path, tmp_path_factory):
    """A scene and a short run on it."""
    scene = ss.load_scene(room_path)
    return scene, ss.train(scene, tmp_path_factory.mktemp("runs") / "run", **SHORT)


def test_a_run_has_the_scores_that_evaluate_gives(trained):
    scene, run = trained
    scores = ss.evaluate(run, scene).to_dict()
    for name in ("psnr", "cc_psnr", "ssim", "flip", "num_gaussians"):
        assert scores[name] == pytest.approx(run.metrics[name], rel=1e-6), name
    assert len(run.gaussians) == run.metrics["num_gaussians"] == len(scene.points)


def test_any_form_of_a_model_scores_the_same(trained, room_path):
    scene, run = trained
    expected = ss.evaluate(run, scene).psnr
    same = {"data_factor": 2, "test_every": 3}
    assert ss.evaluate(str(run.folder)).psnr == expected  # a run knows its scene
    assert ss.evaluate(run.folder / "point_cloud.ply", room_path).psnr == expected
    # Without the run's near plane: found anew, by the same rule.
    assert ss.evaluate(run.gaussians, scene, **same).psnr == pytest.approx(expected, abs=1e-4)
    with pytest.raises(ParameterError, match="scene"):
        ss.evaluate(run.gaussians)


def test_poses_that_changed_since_a_run_are_noted(trained):
    scene, run = trained
    moved = [dataclasses.replace(im, translation=im.translation + 0.01) for im in scene.images]
    for each, noted in ((scene, 0), (scene.replace(images=tuple(moved)), 1)):
        findings = []
        ss.evaluate(run, each, note=findings.append)
        assert sum(each.kind == "changed-photographs" for each in findings) == noted


def test_a_render_shows_the_photograph(trained):
    scene, run = trained
    image = scene.split(3)[1][0]
    render = run.render(image)
    assert render.shape == (72, 96, 3)
    assert render.dtype == np.float32
    assert 0 <= render.min() <= render.max() <= 1
    assert np.array_equal(render, run.render(image.camera))
    assert np.array_equal(render, ss.Run(run.folder).render(image))
    errors = {
        other.name: float(np.abs(render - other.read() / 255.0).mean()) for other in scene.images
    }
    assert errors[image.name] < np.median(list(errors.values()))


def test_wrong_arguments_are_named(trained, tmp_path):
    scene, run = trained
    for wrong, named in (
        ({"max_step": 3}, "max_steps"),
        ({"strategy": "best"}, "strategy"),
        ({"budget": "1roh"}, "1roh"),
        ({"long_side": 0}, "long_side"),
        ({"long_side": 48, "data_factor": 2}, "long_side"),
        ({"start": str(run.folder), "seeding": "auto"}, "start"),
        ({"start": str(run.folder), "region": "0,0,0,1"}, "region"),
        ({"seeding": "scene", "region": "0,0,0,1"}, "region"),
        ({"region": "0,0,0,0"}, "region"),
    ):
        with pytest.raises(ParameterError, match=named):
            ss.train(scene, tmp_path / "run", **wrong)
        assert not (tmp_path / "run").exists()
    with pytest.raises(ParameterError, match="test_every"):
        ss.evaluate(run, scene, test_evry=3)
    with pytest.raises(OutputError, match="overwrite"):
        ss.train(scene, run.folder, **SHORT)
    with pytest.raises(SceneNotFoundError):
        ss.Run(tmp_path)


def test_ctrl_c_keeps_the_run_which_resumes(trained, room_path, tmp_path):
    scene, run = trained

    def stop(step):
        if step == 4:
            os.kill(os.getpid(), signal.SIGINT)

    with pytest.raises(KeyboardInterrupt, match="step 4"):
        ss.train(room_path, tmp_path / "run", on_step=stop, **SHORT)
    resumed = ss.train(scene, tmp_path / "run", resume=True)
    assert resumed.metrics["psnr"] == run.metrics["psnr"]


def test_the_budget_limits_a_run(room_path, tmp_path):
    findings = []
    run = ss.train(
        room_path,
        tmp_path / "run",
        max_steps=3,
        budget="0.25rho",
        long_side=48,
        note=findings.append,
    )
    assert run.config["strategy"] == "auto"
    assert run.config["cap_max"] == 48 * 36 // 4
    assert run.metrics["num_gaussians"] <= 48 * 36 // 4
    assert "budget" in {each.kind for each in findings}


def test_a_run_with_a_region_resumes_with_it(room_path, tmp_path):
    scene = ss.load_scene(room_path)
    text = ",".join(f"{value:.6g}" for value in [*np.median(scene.points.xyz, axis=0), 0.8])

    def prepare(**options):
        request = TrainRequest.of({**SHORT, "seeding": "auto", **options})
        return prepare_training(scene, tmp_path / "run", request, note=findings.append)

    findings = []
    count = prepare(region=text).count()
    (said,) = (each.text for each in findings if each.kind == "seeds-of-region")
    assert "the others are left out" in said
    assert count == prepare(resume=True).count()
    assert json.loads((tmp_path / "run/config.json").read_text())["region"] == text
    with pytest.raises(ParameterError, match="as when the run began"):
        prepare(resume=True, region="0,0,0,9")
