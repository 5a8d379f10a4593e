"""What a change of a model costs is measured from its cameras, and reported where it matters."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

pytest.importorskip("torch", reason="rendering needs PyTorch")

from splatseed.camera import Camera
from splatseed.photos.view import NO_PIXELS, View
from splatseed.splat.formats import read_gaussians, write_gaussians
from splatseed.splat.gaussians import Gaussians
from splatseed.splat.pictures import to_uint8
from splatseed.splat.render_loss import MAX_LOST, MIN_LIKENESS, RenderLoss, measure_loss
from splatseed.splat.rendering import ModelRenderer
from splatseed.splat.training_frame import TrainingFrame

FRAME = TrainingFrame(np.zeros(3), 1.0)


@pytest.fixture
def model(rng):
    """Opaque balls whose colour depends on the direction, and more than an .spz holds."""
    arrays = {
        "means": rng.uniform([-1, -0.7, 2], [1, 0.7, 4], (200, 3)),
        "scales": np.full((200, 3), np.log(0.08)),
        "quats": rng.normal(size=(200, 4)),
        "opacities": np.full(200, 3.0),
        "sh0": rng.uniform(-0.5, 0.5, (200, 1, 3)),
        "shN": np.zeros((200, 15, 3)),
    }
    # +2 of the harmonic in z, seen along z, and as much less of the mean colour.
    arrays["shN"][:, 1] += 2.0
    arrays["sh0"] -= 2.0 * 0.4886025 / 0.2820948
    return Gaussians(**{name: each.astype(np.float32) for name, each in arrays.items()})


@pytest.fixture
def views(model):
    """Two cameras, with the model's renders as photographs."""
    K, found = np.array([[60.0, 0, 32], [0, 60, 24], [0, 0, 1]]), []
    for i in range(2):
        pose = np.eye(4)
        pose[0, 3] = 0.1 * i
        view = View(f"{i}.png", NO_PIXELS, Camera(K, 64, 48, pose))
        pixels = to_uint8(ModelRenderer(model, FRAME).color(view))
        found.append(dataclasses.replace(view, photograph=pixels))
    return found


def test_a_score_that_a_format_loses_is_reported(model, views, tmp_path):
    write_gaussians(tmp_path / "a.spz", model)
    packed = read_gaussians(tmp_path / "a.spz")
    loss = measure_loss([model, packed], views, FRAME)
    assert loss.scores[0] > 50  # rounding to 8 bits alone
    assert loss.scores[1] < 20
    (like,) = loss.likeness
    assert like == pytest.approx(loss.scores[1], abs=3)  # over what shows something
    text = str(loss.finding(".spz"))
    assert f"costs the model {loss.scores[0] - loss.scores[1]:.2f} dB" in text
    bare = [dataclasses.replace(view, photograph=NO_PIXELS) for view in views]
    loss = measure_loss([model, packed], bare, FRAME)
    assert loss.scores == ()
    assert loss.likeness == pytest.approx([like])
    assert "Renders of the .spz differ" in str(loss.finding(".spz"))


def test_stages_are_compared_one_after_another(model, views):
    half = model.select(np.arange(100))
    loss = measure_loss([model, half, half], views, FRAME)
    assert loss.scores[1] == loss.scores[2] < loss.scores[0]
    assert loss.likeness[0] < 30
    assert math.isinf(loss.likeness[1])
    assert loss.finding(".spz") is None
    # A camera that sees nothing has no part; if none sees anything, that is no likeness.
    away = views[0].posed(np.diag([1.0, -1, -1, 1]))
    both = measure_loss([model, half], [views[0], away], FRAME).likeness
    assert both == measure_loss([model, half], views[:1], FRAME).likeness
    nothing = measure_loss([model, half], [dataclasses.replace(away, photograph=NO_PIXELS)], FRAME)
    assert math.isnan(nothing.likeness[0])
    assert nothing.finding(".spz") is None


def test_small_losses_are_not_reported():
    assert RenderLoss(3, (25.0, 25.1 - MAX_LOST), (35.0,)).finding(".sog") is None
    assert RenderLoss(3, (25.0, 24.9 - MAX_LOST), (50.0,)).finding(".sog") is not None
    assert RenderLoss(3, (), (MIN_LIKENESS,)).finding(".sog") is None
    assert RenderLoss(3, (), (MIN_LIKENESS - 1,)).finding(".sog") is not None
