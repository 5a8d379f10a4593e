"""``splatseed evaluate``: a run agrees with its own metrics, and any .ply can be scored."""

from __future__ import annotations

import json

import pytest

torch = pytest.importorskip("torch", reason="evaluation needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.io import load_scene
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.training.evaluation import split_findings
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings


@pytest.fixture(scope="module")
def run_folder(room, tmp_path_factory):
    """A finished run of a few steps at half size."""
    path = tmp_path_factory.mktemp("runs") / "run"
    settings = TrainSettings(max_steps=20, data_factor=2, test_every=4, strategy="none")
    run = prepare_run(load_scene(room), path, settings)
    assert run.train()
    run.finish(evaluate_views)
    return path


@pytest.fixture
def model(room, tmp_path):
    path = tmp_path / "model.ply"
    write_gaussians(path, initial_gaussians(load_scene(room).points))
    return path


def test_a_run_scores_as_it_did_when_it_was_trained(run_folder, splatseed, tmp_path):
    run = splatseed("evaluate", run_folder, "-o", tmp_path / "scores.json")
    assert run.code == 0, run
    scores = json.loads((tmp_path / "scores.json").read_text())
    metrics = json.loads((run_folder / "metrics.json").read_text())
    # What was written is in the world, in single precision: the training frame must be undone.
    assert scores["psnr"] == pytest.approx(metrics["psnr"], abs=0.01)
    assert scores["ssim"] == pytest.approx(metrics["ssim"], abs=1e-3)
    assert scores["cc_psnr"] == pytest.approx(metrics["cc_psnr"], abs=0.01)
    assert scores["flip"] == pytest.approx(metrics["flip"], abs=1e-3)
    assert scores["num_gaussians"] == metrics["num_gaussians"]
    assert (scores["data_factor"], scores["test_every"]) == (2, 4)
    assert [s["name"] for s in scores["per_image"]] == [s["name"] for s in metrics["per_image"]]


def test_a_ply_of_another_trainer_is_scored(model, room, splatseed, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    out = tmp_path / "out"
    run = splatseed("evaluate", model, "--scene", room, "--renders", out)
    assert run.code == 0, run
    test = load_scene(room).split()[1]
    for image in test:
        assert image.name in run.out
        assert (out / image.name).is_file()
    weights = ("LPIPS was not computed", "https://", str(tmp_path / "hub"), "--lpips-weights")
    assert all(said in run.err for said in weights), run.err
    assert "mean" in run.out
    assert run.unexpected == ""
    assert "does not record on which photographs it was trained" in run.err


@pytest.mark.parametrize("evaluated", [True, False])
def test_graphdecos_trainer_records_whether_it_held_out_photographs(evaluated, tmp_path):
    model = tmp_path / "point_cloud/iteration_7/point_cloud.ply"
    model.parent.mkdir(parents=True)
    (tmp_path / "cfg_args").write_text(f"Namespace(data_device='cuda', eval={evaluated})")
    kinds = [each.kind for each in split_findings(model, 3)]
    assert kinds == ([] if evaluated else ["trained-test-views"])


def _refused(run, *texts):
    assert run.code == 2, run
    assert run.err.startswith("error: expected ")
    assert run.err.count("\n") == 1
    for text in texts:
        assert str(text) in run.err


def test_a_damaged_run_is_refused(run_folder, splatseed, tmp_path):
    for name in ("config.json", "splatseed.json"):
        (tmp_path / name).write_bytes((run_folder / name).read_bytes())
    (tmp_path / "point_cloud.ply").write_bytes((run_folder / "point_cloud.ply").read_bytes())
    deep, masks = 9**6 * "[", '{"scene": "x", "masks": 5}'
    for content in ("[]", "{", '{"scene": 7}', '{"scene": "x", "data_factor": "two"}', deep, masks):
        (tmp_path / "config.json").write_text(content)
        _refused(splatseed("evaluate", tmp_path))


def test_outputs_are_replaced_only_with_overwrite(model, room, splatseed, tmp_path):
    scores, renders = tmp_path / "scores.json", tmp_path / "renders"
    words = ("evaluate", model, "--scene", room, "-o", scores, "--renders", renders)
    assert splatseed(*words).code == 0
    before = scores.read_bytes()
    scores.unlink()
    _refused(splatseed(*words), "--overwrite")  # the renders
    assert not scores.exists()
    assert splatseed(*words, "--overwrite").code == 0
    names = [s["name"] for s in json.loads(scores.read_text())["per_image"]]
    assert names == [s["name"] for s in json.loads(before)["per_image"]]
