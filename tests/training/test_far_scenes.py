"""Wherever a scene's world lies, training, the file that it writes and its scores are the same."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")

from splatseed.io import colmap, load_scene, write_scene
from splatseed.io.origin import RECENTER, offset_beside, translated
from splatseed.splat.evaluate import evaluate_model, evaluate_views, load_model
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.model_frame import translate_gaussians
from splatseed.training.prepare import prepare_run
from splatseed.training.settings import TrainSettings
from splatseed.training.start import read_start
from splatseed.viewer.models import open_item

PLACES = {"here": (0, 0, 0), "site": (3000.3, -9000.2, 12.7), "ecef": (-1.28e6, -4.72e6, 4e6)}
SETTINGS = TrainSettings(strategy="none", max_steps=30, data_factor=2)


@pytest.fixture(scope="module")
def runs(room, tmp_path_factory):
    """Scenes, runs on them, and their scores, by place."""
    done = {}
    for place, offset in PLACES.items():
        folder = tmp_path_factory.mktemp(place)
        write_scene(room, folder / "scene")
        there, model = translated(room, -np.array(offset)), folder / "scene" / "sparse" / "0"
        colmap.write_images(model / "images.bin", there.images)
        colmap.write_points3d(model / "points3D.bin", there.points, there.tracks)
        run = prepare_run(load_scene(folder / "scene"), folder / "run", SETTINGS)
        assert run.train()
        done[place] = folder, run.finish(evaluate_views).scores.psnr
    return done


def scored(path, scene, **ways):
    return evaluate_model(load_model(path, scene, data_factor=2, **ways)).psnr


@pytest.mark.parametrize("place", PLACES)
def test_the_written_model_scores_as_in_training_wherever_the_world_lies(runs, place, tmp_path):
    folder, psnr = runs[place]
    file, scene = folder / "run" / "point_cloud.ply", load_scene(folder / "scene")
    assert psnr == pytest.approx(runs["here"][1], abs=0.05)
    assert scored(file, folder / "scene") == pytest.approx(psnr, abs=0.01)
    assert (folder / "run" / RECENTER).is_file() == (place != "here")
    gaussians = read_gaussians(file)
    offset = np.zeros(3) if place == "here" else offset_beside(file)
    middle = np.median(read_gaussians(runs["here"][0] / "run" / "point_cloud.ply").means, axis=0)
    there = np.median(gaussians.means, axis=0) + offset - PLACES[place]
    np.testing.assert_allclose(there, middle, atol=0.02)
    # Without the record, around another, and around the scene's as it is written again.
    write_gaussians(tmp_path / "lost.ply", gaussians)
    write_scene(scene, tmp_path / "again")
    for path, name in ((file, "again"), (tmp_path / "lost.ply", "again")):
        assert scored(path, tmp_path / name) == pytest.approx(psnr, abs=0.01)
    assert scored(tmp_path / "lost.ply", folder / "scene") == pytest.approx(psnr, abs=0.01)
    assert np.array_equal(open_item(folder / "run").model.means, gaussians.means)


def test_a_model_in_the_coordinates_of_the_files_is_moved_and_it_is_said(runs, tmp_path):
    folder, psnr = runs["site"]
    file, findings = folder / "run" / "point_cloud.ply", []
    gaussians = read_gaussians(file)
    write_gaussians(tmp_path / "world.ply", translate_gaussians(gaussians, offset_beside(file)))
    score = scored(tmp_path / "world.ply", folder / "scene")
    assert score == pytest.approx(psnr, abs=0.3)  # float32 has rounded it before
    started = read_start(tmp_path / "world.ply", load_scene(folder / "scene"), findings.append)
    np.testing.assert_allclose(started.means, gaussians.means, atol=2e-3)
    assert [each.kind for each in findings] == ["far-from-origin"]
