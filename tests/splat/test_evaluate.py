"""Scores must be those of the papers: checked by hand; ``test_metrics`` has torchmetrics beside."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="evaluation needs PyTorch")

from splatseed.camera import Camera
from splatseed.errors import ParameterError, SceneNotFoundError
from splatseed.io import load_scene
from splatseed.io.photograph import photographs_digest
from splatseed.io.photograph_checks import with_photographs
from splatseed.photos.view import View, camera_views
from splatseed.scores import EvalResult, ViewScore
from splatseed.splat.evaluate import evaluate_model, evaluate_views, load_model
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import training_frame


def _view(image, name="a.png"):
    height, width = image.shape[:2]
    return View(name, image, Camera(np.eye(3), width, height, np.eye(4)))


def test_mean_psnr_averages_images_not_errors():
    image = np.zeros((16, 16, 3), np.uint8)
    errors = {"a.png": 0.1, "b.png": 0.01}
    views = [_view(image, name) for name in errors]
    result = evaluate_views(lambda v: torch.full((16, 16, 3), errors[v.name]), views)
    assert [s.psnr for s in result.per_image] == pytest.approx([20, 40], abs=1e-4)
    assert result.psnr == pytest.approx(30, abs=1e-4)
    assert [s.name for s in result.per_image] == ["a.png", "b.png"]


def test_scores_use_masks_and_lpips_and_pass_renders_on():
    view = _view(np.full((16, 16, 3), 100, np.uint8))
    image = torch.full((16, 16, 3), 100 / 255)
    image[:8] += 0.1
    drawn = []
    mask = np.zeros((16, 16), bool)
    mask[4:] = True  # a third of it is wrong by 0.1
    metric = {"lpips": lambda *_: 0.25, "covisible": {"a.png": mask}}
    result = evaluate_views(
        lambda _: image, [view], on_view=lambda *one: drawn.append(one), **metric
    )
    assert (result.lpips, result.lpips_net, result.lpips_reason) == (0.25, "vgg", "")
    assert result.covisible_share == 0.75
    ((seen, render, errors),) = drawn
    assert seen is view
    np.testing.assert_array_equal(render, image.numpy())
    assert result.flip == pytest.approx(errors.mean())
    assert errors[:4].mean() > 4 * errors[-4:].mean()
    assert result.covisible_psnr == pytest.approx(-10 * np.log10(0.01 / 3), abs=1e-3)
    plain = evaluate_views(lambda _: image, [view], lpips_reason="no weights").to_dict()
    assert (plain["lpips"], plain["lpips_reason"]) == (None, "no weights")
    assert (plain["covisible_psnr"], plain["covisible_share"]) == (None, None)


def test_invalid_renders_are_refused():
    truth = np.zeros((48, 64, 3), np.uint8)
    for image in (torch.zeros(64, 48, 3), torch.full((48, 64, 3), math.nan)):
        with pytest.raises(ParameterError, match=r"a\.png"):
            evaluate_views(lambda _, image=image: image, [_view(truth)])
    with pytest.raises(ParameterError, match="views"):
        evaluate_views(lambda _: torch.zeros(1), [])


def test_json_is_valid_also_for_a_perfect_render():
    scores = (ViewScore("a", math.inf, 1.0, 0.0, 0.1), ViewScore("b", 30.0, 0.9, 0.2, 0.3))
    result = EvalResult(scores, lpips_net="vgg", lpips_reason="")
    content = json.loads(json.dumps(result.to_dict(), allow_nan=False))
    assert content["psnr"] is content["per_image"][0]["psnr"] is None
    assert content["per_image"][1]["psnr"] == 30.0
    for name, mean in (("ssim", 0.95), ("lpips", 0.1), ("render_seconds", 0.2)):
        assert content[name] == pytest.approx(mean)


@pytest.fixture(scope="module")
def model_path(larger_room_path, tmp_path_factory):
    """The seeds themselves as Gaussians of the world, with some colour by direction."""
    gaussians = initial_gaussians(load_scene(larger_room_path).points, opacity=0.9)
    harmonics = gaussians.shN.copy()
    harmonics[:, :3] = np.random.default_rng(0).normal(0, 0.1, (len(gaussians), 3, 3))
    gaussians = dataclasses.replace(gaussians, shN=harmonics)
    path = tmp_path_factory.mktemp("model") / "seeds.ply"
    write_gaussians(path, gaussians)
    return path


def test_a_ply_in_world_coordinates_is_scored_on_the_test_views(
    larger_room_path, model_path, tmp_path
):
    model, scene = load_model(model_path, larger_room_path), load_scene(larger_room_path)
    result = evaluate_model(model)
    assert [s.name for s in result.per_image] == [i.name for i in scene.split()[1]]
    assert result.num_gaussians == len(scene.points)
    assert result.model_bytes == result.num_gaussians * 59 * 4
    black = evaluate_views(lambda v: torch.zeros(v.height, v.width, 3), model.views)
    assert result.psnr > black.psnr + 1
    with pytest.raises(SceneNotFoundError, match="to have images"):
        load_model(model_path, larger_room_path / "sparse/0/points3D.ply")
    # A Gaussian that is broken changes no score, and is said.
    scales = model.gaussians.scales.copy()
    scales[9] = np.nan
    broken = dataclasses.replace(model.gaussians, scales=scales)
    path = tmp_path / "broken.ply"
    write_gaussians(path, broken)
    whole = load_model(path, larger_room_path)
    assert (model.findings, len(whole.gaussians)) == ((), len(broken) - 1)
    assert [each.kind for each in whole.findings] == ["unusable-gaussians"]
    cut = load_model(model_path, larger_room_path, near_plane=1e3)  # all is nearer
    assert not cut.render(cut.views[0]).any()
    # It looks the same in whatever frame it is rendered; nothing lies at the nearer near plane.
    frame = training_frame(camera_views(scene.split()[0]))
    other = dataclasses.replace(frame, origin=frame.origin + 0.5, scale=3 * frame.scale)
    moved = ModelRenderer(model.gaussians, other)
    for view in model.views:
        torch.testing.assert_close(moved.image(view), model.render(view), atol=2e-3, rtol=0)


def test_missing_photographs_leave_the_other_test_views(larger_room_path, model_path, tmp_path):
    root = tmp_path / "room"
    shutil.copytree(larger_room_path, root)
    whole = load_scene(root)
    train, test = whole.split()
    folder = root / "images"
    for image in (test[1], train[0]):
        (folder / image.name).unlink()
    model = load_model(model_path, root)
    assert [view.name for view in model.views] == [test[0].name]
    assert [image.name for image in model.scene.split()[0]] == [i.name for i in train[1:]]
    assert [each.kind for each in model.findings] == ["missing-photographs"]
    assert (
        f"2 images of the scene are left out, without a photograph or a pose: {train[0].name}"
        in str(model.findings[0])
    )
    trained_on = photographs_digest(with_photographs(load_scene(root)))
    assert photographs_digest(model.scene) == trained_on
    for image in train[1:]:
        (folder / image.name).unlink()
    alone = load_model(model_path, root)  # only test photographs are needed
    assert [view.name for view in alone.views] == [test[0].name]
    (folder / test[0].name).unlink()
    with pytest.raises(SceneNotFoundError, match="at least half"):
        load_model(model_path, root)
