"""Extreme or non-finite Gaussians: results stay finite, and invalid Gaussians have no effect."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings, strategies as st
from torch import Tensor

from splatseed.rendering import rasterization

from .scenes import PER_GAUSSIAN, gradients, random_scene

BROKEN = st.sampled_from([np.nan, np.inf, -np.inf])
EXTREME = {
    "means": st.sampled_from([0.0, -3.0, 1e-6, 1e3, -1e6, 1e12, 3e38]),
    "quats": st.sampled_from([0.0, 1e-20, -1.0, 1e18]),
    "scales": st.sampled_from([0.0, 1e-30, 1e-12, 1e-3, 10.0, 1e4, 1e12, 1e20, 3e38]),
    "opacities": st.sampled_from([0.0, 1.0, 1 / 255, 1.0 - 1e-7, 0.5]),
    "colors": st.sampled_from([0.0, 1.0, 1e6, -1e6]),
}
QUICK = settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@st.composite
def replacements(draw, broken):
    """Numbers to put into a scene: (parameter, Gaussian, component, value)."""
    changes = []
    for _ in range(draw(st.integers(1, 8))):
        name = draw(st.sampled_from(PER_GAUSSIAN))
        value = draw(BROKEN if broken else EXTREME[name])
        changes.append((name, draw(st.integers(0, 11)), draw(st.integers(0, 3)), value))
    return changes


def with_replacements(scene, changes):
    for name, gaussian, component, value in changes:
        row = scene[name].view(len(scene[name]), -1)[gaussian]
        row[component % len(row)] = value


def scene_of(seed, options):
    """Twelve Gaussians before two cameras, and one of the modes."""
    scene = random_scene(np.random.default_rng(seed), 12, cameras=2, size=(21, 13))
    return scene, [
        {}, {"packed": False}, {"rasterize_mode": "antialiased"}, {"render_mode": "RGB+ED"},
    ][options]  # fmt: skip


def assert_finite(scene, **options):
    image, alpha, grads = gradients(scene, **options)
    assert image.isfinite().all()
    assert ((alpha >= 0) & (alpha <= 1)).all()
    for name, each in grads.items():
        assert each.isfinite().all(), name


@QUICK
@given(replacements(broken=False), st.integers(0, 9), st.integers(0, 3))
def test_extreme_numbers_stay_finite(changes, seed, options):
    scene, chosen = scene_of(seed, options)
    with_replacements(scene, changes)
    assert_finite(scene, **chosen)


@QUICK
@given(replacements(broken=True), st.integers(0, 9), st.integers(0, 3))
def test_invalid_gaussians_have_no_effect(changes, seed, options):
    scene, chosen = scene_of(seed, options)
    with_replacements(scene, changes)
    broken = sorted({gaussian for _, gaussian, _, _ in changes})
    kept = [i for i in range(12) if i not in broken]
    without = {**scene, **{name: scene[name][kept] for name in PER_GAUSSIAN}}
    image, alpha, grads = gradients(scene, **chosen)
    expected_image, expected_alpha, expected = gradients(without, **chosen)
    assert torch.equal(image, expected_image)
    assert torch.equal(alpha, expected_alpha)
    for name in PER_GAUSSIAN:
        assert torch.equal(grads[name][kept], expected[name]), name
        assert not grads[name][broken].any(), name


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("degree", [1, 3])
def test_broken_coefficients(seed, degree):
    scene = random_scene(np.random.default_rng(seed), 12, coefficients=16)
    scene["colors"][3, 2, 1] = np.nan
    kept = [i for i in range(12) if i != 3]
    without = {**scene, **{name: scene[name][kept] for name in PER_GAUSSIAN}}
    rendered, expected = (rasterization(**s, sh_degree=degree)[0] for s in (scene, without))
    assert torch.equal(rendered, expected)


@pytest.mark.parametrize("options", [{}, {"packed": False}, {"render_mode": "RGB+ED"}])
def test_none_visible(options):
    """Behind the camera, or none at all."""
    scene = random_scene(np.random.default_rng(0), 20)
    scene["viewmats"][:, 2, 3] = -10.0
    for each in (scene, {**scene, **{name: scene[name][:0] for name in PER_GAUSSIAN}}):
        image, alpha, grads = gradients(each, **options)
        assert not alpha.any()
        behind = scene["backgrounds"][:, None, None].expand_as(image[..., :3])
        assert torch.equal(image[..., :3], behind)
        assert not any(grads[name].any() for name in (*PER_GAUSSIAN, "viewmats"))


@pytest.mark.parametrize("scale", [1e2, 1e8, 1e15, 1e19])
def test_a_huge_gaussian_covers_the_image_with_little_memory(scale):
    scene = random_scene(np.random.default_rng(0), 1, size=(320, 200))
    scene.update(means=torch.tensor([[0.1, 0.2, 1.0]]), scales=torch.full((1, 3), scale))
    scene.update(opacities=torch.tensor([0.5]), viewmats=torch.eye(4)[None])
    assert_finite(scene)
    tracemalloc.start()
    _, alpha, grads = gradients(scene)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert np.allclose(alpha.numpy(), 0.5, atol=1e-5)
    assert peak < 50e6  # a thousand tiles of 64 pixels are 6 MB of image and gradient
    assert grads["opacities"].isfinite().all()


def test_inputs_are_not_modified(rng):
    scene = random_scene(rng, 20, coefficients=4)
    before = {k: v.clone() for k, v in scene.items() if isinstance(v, Tensor)}
    gradients(scene, sh_degree=1)
    rasterization(**scene, sh_degree=1)
    assert all(torch.equal(before[name], scene[name]) for name in before)


def test_inputs_need_not_be_contiguous(rng):
    scene = random_scene(rng, 20)
    strided = {**scene, "means": scene["means"].T.contiguous().T}
    strided["colors"] = torch.cat([scene["colors"], scene["colors"]], dim=1)[:, :3]
    strided["quats"] = scene["quats"].flip(1).contiguous().flip(1)
    strided["viewmats"] = scene["viewmats"].mT.contiguous().mT
    expected, rendered = gradients(scene), gradients(strided)
    assert torch.equal(expected[0], rendered[0])
    assert all(torch.equal(expected[2][name], rendered[2][name]) for name in rendered[2])
