"""Masked pixels count neither in training nor in scores: an occluder that moves leaves no trace."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import torch
from PIL import Image as PilImage

from splatseed import train
from splatseed.errors import ParameterError
from splatseed.io import load_scene
from splatseed.io.masks import with_masks
from splatseed.photos.loading import load_views
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.metrics import mirrored_ssim
from splatseed.splat.photographs import fill_masked, over_background, photograph_tensor
from splatseed.splat.rendering import render_view
from splatseed.training import trainer
from splatseed.training.evaluation import Evaluation
from splatseed.training.prepare import prepare_run
from splatseed.training.request import PrepareOptions
from splatseed.training.settings import TrainSettings
from splatseed.training.strategies.grow import contributions
from splatseed.training.trainer import photometric_loss


@pytest.fixture(scope="module")
def occluded_path(larger_room_path, tmp_path_factory):
    """The room with a box before a part of each training photograph, elsewhere in each."""
    path = shutil.copytree(larger_room_path, tmp_path_factory.mktemp("masks") / "occluded")
    (path / "masks").mkdir()
    rng = np.random.default_rng(0)
    for i in set(range(12)) - {0, 8}:
        photograph = path / f"images/view_{i:03}.png"
        pixels = np.asarray(PilImage.open(photograph)).copy()
        box = tuple(slice(at, at + 36) for at in rng.integers(0, [36, 60]))
        mask = np.full(pixels.shape[:2], 255, np.uint8)
        pixels[box], mask[box] = (255, 0, 255), 0
        PilImage.fromarray(pixels).save(photograph)
        PilImage.fromarray(mask).save(path / f"masks/view_{i:03}.png.png")
    return path


def test_masks_keep_an_occluder_out(
    larger_room_path, occluded_path, splatseed, tmp_path, monkeypatch
):
    """The test views have none, so that the scores compare."""
    monkeypatch.setattr(trainer, "NUM_TESTS", 1)  # the last is the one that counts

    def score(name, path, *options):
        run = splatseed(
            "train", path, "-o", tmp_path / name, "--max-steps", 150, "--seeds", "scene",
            "--strategy", "none", *options,
        )  # fmt: skip
        assert run.code == 0, run.err
        return json.loads((tmp_path / name / "metrics.json").read_text("utf-8"))["psnr"]

    clean, masked = score("clean", larger_room_path), score("masked", occluded_path)
    whole = score("whole", occluded_path, "--masks", "none")
    assert masked > whole + 1
    assert masked - whole > 2 * (clean - masked)
    again = splatseed("evaluate", tmp_path / "whole", "-o", tmp_path / "scores.json")
    assert again.code == 0
    assert json.loads((tmp_path / "scores.json").read_text("utf-8"))["psnr"] == pytest.approx(whole)
    told = json.loads(splatseed("info", occluded_path, "--json").out)["masks"]
    assert told["images"] == 10
    assert told["share"] == pytest.approx(36**2 / (96 * 72))


def test_masked_pixels_have_no_part_in_loss_growth_and_scores(occluded_path, begin):
    scene = load_scene(occluded_path)
    (view,) = load_views(scene, scene.images[1:2])
    photograph, mask = torch.tensor(view.photograph / 255.0).float(), torch.tensor(view.mask)
    render = torch.rand(photograph.shape, generator=torch.manual_seed(0))
    other = torch.where(mask[..., None], render, 1 - render)
    losses = []
    for each in (render.requires_grad_(), other.detach().requires_grad_()):
        loss = photometric_loss(fill_masked(each, photograph, mask), photograph)
        loss.backward()
        losses.append(float(loss.detach()))
        assert (each.grad[~mask] == 0).all()
    assert losses[0] == losses[1]
    results = [
        evaluate_views(lambda _, each=each: each.detach(), [view]) for each in (render, other)
    ]
    assert results[0].psnr == results[1].psnr
    assert results[0].ssim == results[1].ssim < 0.5
    everywhere = torch.ones_like(mask)
    assert mirrored_ssim(render.detach(), photograph, everywhere) == pytest.approx(
        mirrored_ssim(render.detach(), photograph), abs=1e-5
    )
    run = begin(strategy="none")
    (seen,) = load_views(scene, scene.images[1:2])
    params, error = run.state.params, torch.ones(mask.shape)
    counted = contributions(params, run.frame.view(seen), error)[0]
    masked = contributions(params, run.frame.view(seen), error * mask)[1]
    assert torch.allclose(counted, masked)


def test_a_resumed_run_keeps_its_masks(occluded_path, tmp_path, begin):
    scene, settings = load_scene(occluded_path), TrainSettings(max_steps=30, strategy="none")
    prepare_run(with_masks(scene, "inverted"), tmp_path / "run", settings)
    resumed = prepare_run(scene, tmp_path / "run", settings, PrepareOptions(resume=True))
    (view, *_) = (v for v in resumed.trainer.train_views if v.name == "view_001.png")
    assert 0 < view.mask.mean() < 0.5
    with pytest.raises(ParameterError, match=r"masks=.inverted"):
        prepare_run(
            with_masks(scene, "none"), tmp_path / "run", settings, PrepareOptions(resume=True)
        )


def test_masks_that_changed_since_a_run_began_are_found_out(larger_room_path, tmp_path):
    """A folder of masks that is new beside the photographs."""
    own_path = shutil.copytree(larger_room_path, tmp_path / "own")
    settings = TrainSettings(max_steps=2, data_factor=2, strategy="none", seeding="scene")
    resume, without = PrepareOptions(resume=True), load_scene(own_path)
    prepare_run(without, tmp_path / "run", settings)
    mask, white = own_path / "masks/view_000.png", np.full((72, 96), 255, np.uint8)
    white[:9] = 0
    mask.parent.mkdir()
    PilImage.fromarray(white).save(mask)
    with pytest.raises(ParameterError, match="other masks in"):
        prepare_run(load_scene(own_path), tmp_path / "run", settings, resume)
    run = prepare_run(without, tmp_path / "run", settings, resume)
    run.train()
    run.finish(evaluate_views)
    for noted in (True, False):
        evaluation = Evaluation.of(tmp_path / "run")
        assert (
            any(each.kind == "changed-masks" for each in evaluation.findings(evaluation.load()))
            == noted
        )
        mask.unlink(missing_ok=True)


def test_nothing_is_around_an_object_that_is_cut_out(larger_room_path, tmp_path):
    """Renders are black where photographs are transparent, unless these pixels are left out."""
    scene = _cut_out(larger_room_path, tmp_path / "cut")
    outside = {}
    for masks in (None, "alpha"):
        run = train(
            scene,
            tmp_path / f"{masks}",
            max_steps=60,
            strategy="none",
            masks=masks,
            seeding="scene",
        )
        (view, *_) = load_views(scene, scene.images[:1])
        outside[masks] = run.render(view.camera)[view.empty].mean()
    assert outside[None] < 0.5 * outside["alpha"]


def _cut_out(source, path, color=None):
    """The room with a box of each photograph cut out, in a colour if given."""
    shutil.copytree(source, path)
    for i, file in enumerate(sorted((path / "images").iterdir())):
        alpha = np.zeros((72, 96), np.uint8)
        alpha[12:60, 16 + i : 64 + i] = 250
        with PilImage.open(file) as photograph:
            cut = photograph.convert("RGB")
            if color is not None:
                cut.paste(color, (0, 0, *cut.size))
            cut.putalpha(PilImage.fromarray(alpha))
            cut.save(file)
    return load_scene(path)


@pytest.mark.parametrize("factor", [1, 2])
def test_photographs_are_composited_over_any_background(larger_room_path, tmp_path, factor):
    scene = _cut_out(larger_room_path, tmp_path / "cut")
    (view,) = load_views(scene, scene.images[:1], data_factor=factor)
    with PilImage.open(scene.images[0].path) as photograph:
        orange = PilImage.new("RGBA", photograph.size, (255, 128, 0))
        expected = PilImage.alpha_composite(orange, photograph.convert("RGBA")).convert("RGB")
    background = torch.tensor([1.0, 128 / 255, 0.0])
    got = over_background(photograph_tensor(view, background.device), view, background)
    wanted = np.asarray(expected.reduce(factor)) / 255
    np.testing.assert_allclose(got.numpy(), wanted, atol=2.1 / 255)


def test_a_black_object_does_not_become_transparent(larger_room_path, tmp_path):
    scene = _cut_out(larger_room_path, tmp_path / "cut", "black")
    settings = TrainSettings(max_steps=80, data_factor=2, strategy="none")
    run = prepare_run(scene, tmp_path / "run", settings)
    run.train()
    view = run.trainer.train_views[0]
    over_white = render_view(run.state.params, view, 0, torch.ones(3))[0].detach().mean(dim=-1)
    assert over_white[view.opacity == 250].mean() < 0.3
    assert over_white[view.opacity == 0].mean() > 0.6


def test_dark_pixels_are_not_left_transparent(begin):
    run = begin(strategy="none", max_steps=80)
    for view in run.trainer.train_views:
        view.photograph[:] //= 20
    run.train()
    white = torch.ones(3)
    render, _ = render_view(run.state.params, run.trainer.train_views[0], 0, white)
    assert render.detach().mean() < 0.2
