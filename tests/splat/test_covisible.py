"""Co-visible pixels: as the true depth of a made scene has them, and from the capture alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch", reason="scoring needs PyTorch")

import torch

from splatseed.io import load_scene
from splatseed.splat.covisible import find_covisible, pixel_masks, read_covisible
from splatseed.splat.evaluate import evaluate_views
from splatseed.synthetic import make_capture, write_capture
from splatseed.views.view import View, poses_of


@pytest.fixture(scope="module")
def capture():
    return make_capture(0, num_views=16, width=160, height=120)


@pytest.fixture(scope="module")
def scene(capture, tmp_path_factory):
    return load_scene(write_capture(capture, tmp_path_factory.mktemp("made") / "room"))


def _truth(scene, depths, view, train):
    """Which pixels of a view at least two training views see, by the true depth maps."""
    v, u = np.indices((view.height, view.width)) + 0.5
    rays = np.linalg.inv(view.K) @ np.stack([u.ravel(), v.ravel(), np.ones(u.size)])
    xyz = np.vstack([rays * depths[view.name].ravel(), np.ones(u.size)])
    world = np.linalg.inv(view.cam_from_world) @ xyz
    count = np.zeros(u.size, int)
    for other in train:
        x, y, z = other.K @ (other.cam_from_world @ world)[:3]
        i, j = np.floor(y / z).astype(int), np.floor(x / z).astype(int)
        inside = (z > 0) & (i >= 0) & (i < other.height) & (j >= 0) & (j < other.width)
        i, j = np.where(inside, i, 0), np.where(inside, j, 0)
        count += inside & (depths[other.name][i, j] > 0.95 * z)
    return (count >= 2).reshape(view.height, view.width)


def test_agrees_with_the_true_depth(capture, scene):
    train, test = (poses_of(part) for part in scene.split(8))
    depths = {i.name: depth for i, depth in zip(scene.images, capture.depths, strict=True)}
    masks = pixel_masks(find_covisible(scene, 8), test)
    agree = [(masks[v.name] == _truth(scene, depths, v, train)).mean() for v in test]
    assert np.mean(agree) > 0.9


def test_what_no_training_view_shows_is_left_out(scene):
    """With the training cameras turned away nothing is co-visible."""
    train, test = scene.split(8)
    turned = []
    for image in train:  # half a turn about y, in camera axes
        w, x, y, z = image.quat
        translation = image.translation * np.array([-1, 1, -1])
        turned.append(replace(image, quat=np.array([-y, z, w, -x]), translation=translation))
    assert np.allclose(turned[0].camera.center, train[0].camera.center, atol=1e-6)
    before, after = (
        np.mean([grid.mean() for grid in find_covisible(each, 8).values()])
        for each in (scene, scene.replace(images=(*turned, *test)))
    )
    assert after < 0.5 * before


def test_scores_over_a_mask():
    truth = np.full((16, 16, 3), 100, np.uint8)
    view = View("a.png", truth, np.eye(3), 16, 16, np.eye(4))
    image = torch.full((16, 16, 3), 100 / 255)
    image[:8] += 0.1
    mask = np.zeros((16, 16), bool)
    mask[4:] = True  # a third of it is wrong by 0.1
    (score,) = evaluate_views(lambda _: image, [view], covisible={"a.png": mask}).per_image
    assert score.covisible_share == 0.75
    assert score.covisible_psnr == pytest.approx(-10 * np.log10(0.01 / 3), abs=1e-3)
    (plain,) = evaluate_views(lambda _: image, [view]).per_image
    assert (plain.covisible_psnr, plain.covisible_share) == (None, None)


def test_a_damaged_file_is_no_file(tmp_path):
    (tmp_path / "a.npz").write_bytes(b"PK nonsense")
    assert read_covisible(tmp_path / "a.npz") is None
    assert read_covisible(tmp_path / "none.npz") is None
