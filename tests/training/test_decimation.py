"""What renders need most is kept, in the frame of the file, wherever that is."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs PyTorch")
pytest.importorskip("gsplat", reason="training needs gsplat's strategies")
import torch

from splatseed.camera import Camera
from splatseed.photos.view import NO_PIXELS, View
from splatseed.splat.formats import write_gaussians
from splatseed.splat.from_seeds import initial_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.model_frame import find_transform, transform_gaussians
from splatseed.splat.render_loss import measure_loss
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame
from splatseed.training.decimation import most_needed, needs
from splatseed.training.model_views import find_model_views

CPU = torch.device("cpu")
FRAME = TrainingFrame(np.zeros(3), 1.0)
K = np.array([[40.0, 0, 16], [0, 40, 12], [0, 0, 1]])
VIEW = View("a", NO_PIXELS, Camera(K, 32, 24, np.eye(4)))


def balls(means, size, opacity, colors):
    count = len(means)
    opacities = np.broadcast_to(np.float64(opacity), count)
    arrays = {
        "means": means,
        "scales": np.full((count, 3), np.log(size)),
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "opacities": np.log(opacities / (1 - opacities)),
        "sh0": colors,
        "shN": np.zeros((count, 0, 3)),
    }
    return Gaussians(**{name: np.asarray(each, np.float32) for name, each in arrays.items()})


def test_the_need_is_the_squared_error_of_leaving_one_out(rng):
    means = rng.uniform([-0.7, -0.5, 2], [0.7, 0.5, 3], (12, 3))
    opacities = np.where(np.arange(12) == 3, 0.95, rng.uniform(0.2, 0.9, 12))
    model = balls(means, 0.15, opacities, rng.normal(size=(12, 1, 3)))
    whole = ModelRenderer(model, FRAME).image(VIEW)
    without = [
        ModelRenderer(model.select(np.arange(12) != i), FRAME).image(VIEW) for i in range(12)
    ]
    errors = np.array([float((image - whole).square().sum()) for image in without])
    estimated = needs(model, [VIEW] * 400, CPU) / 400  # other random signs in each view
    np.testing.assert_allclose(estimated, errors, rtol=0.35)


def test_a_model_in_its_trainers_frame_is_thinned_there(larger_room_path, tmp_path):
    from splatseed.io import load_scene

    scene = load_scene(larger_room_path)
    model = initial_gaussians(scene.points, opacity=0.9)
    moved = transform_gaussians(model, find_transform("gsplat", scene))
    keeps, scores = [], []
    for name, each in (("own", model), ("gsplat", moved)):
        write_gaussians(tmp_path / f"{name}.ply", each)
        views = find_model_views(tmp_path / f"{name}.ply", each, larger_room_path)
        keeps.append(most_needed(each, views, len(model) // 2, CPU))
        loss = measure_loss([each, each.select(keeps[-1])], views.test, views.frame)
        scores.append(loss.scores)
    assert (keeps[0] == keeps[1]).mean() > 0.98
    np.testing.assert_allclose(scores[0], scores[1], atol=0.05)
