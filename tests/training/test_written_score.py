"""The score of a run is that of the file it writes, for all cameras, photographs and formats."""

from __future__ import annotations

import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
from PIL import Image

from splatseed.camera import CAMERA_MODELS, Intrinsics
from splatseed.io import colmap, load_scene, write_scene
from splatseed.splat.evaluate import evaluate_model, evaluate_views, load_model
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings

STRAIGHT = [name for name in CAMERA_MODELS if "FISHEYE" not in name]
"""Models that are pinholes where their coefficients are 0."""
COPIES = ((193, 143), (97, 73), (145, 109))
"""Sizes of copies of photographs of 96 x 72, each with another aspect ratio."""
LOSSES = {"ply": 0.01, "spz": 0.1, "sog": 0.5, "splat": 1.0}
"""What a format may cost, in dB; a .splat has no view-dependent colour."""


def score_of(path, scene, factor):
    return evaluate_model(load_model(path, scene, data_factor=factor)).psnr


def run_of(scene, folder, **settings):
    asked = TrainSettings(**{"strategy": "none", "seeding": "scene", "max_steps": 2, **settings})
    run = prepare_run(load_scene(scene), folder, asked)
    run.train()
    return run.finish(evaluate_views).scores.psnr


@pytest.mark.parametrize(
    ("model", "size"), [(model, COPIES[i % len(COPIES)]) for i, model in enumerate(STRAIGHT)]
)
def test_a_run_scores_as_its_file(model, size, room, tmp_path):
    scene, pinhole, kind = tmp_path / "scene", room.images[0].intrinsics, CAMERA_MODELS[model]
    (fx, _, cx), (_, fy, cy), _ = pinhole.K
    params = [fx, *[fy] * (kind.num_focal - 1), cx, cy]
    params += [0.0] * (kind.num_params - len(params))
    lens = Intrinsics(pinhole.camera_id, model, 96, 72, tuple(params))
    write_scene(room, scene, copy_images=True)
    colmap.write_cameras(scene / "sparse/0/cameras.bin", [lens])
    for path in (scene / "images").iterdir():
        Image.open(path).resize(size).save(path)
    trained = run_of(scene, tmp_path / "run", data_factor=2)
    assert score_of(tmp_path / "run/point_cloud.ply", scene, 2) == pytest.approx(trained, abs=0.01)


def test_a_run_scores_as_its_exports(room_path, tmp_path):
    trained = run_of(room_path, tmp_path / "run", max_steps=40)
    gaussians = read_gaussians(tmp_path / "run/point_cloud.ply")
    for name, loss in LOSSES.items():
        path = tmp_path / f"model.{name}"
        write_gaussians(path, gaussians)
        assert score_of(path, room_path, 1) == pytest.approx(trained, abs=loss), name
