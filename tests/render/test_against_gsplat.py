"""Projection and colour against the PyTorch code that gsplat publishes beside its CUDA kernels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import (
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)
from torch import Tensor

from splatseed.render import rasterization
from splatseed.render.autograd import Harmonics

from .scenes import random_scene

NAMES = ("radii", "means2d", "depths", "conics", "compensations")


def theirs(scene: dict[str, Any], **options: Any) -> dict[str, Tensor]:
    """gsplat's projection, in float64, [C, N, ...] each."""
    covariances, _ = _quat_scale_to_covar_preci(
        scene["quats"].double(), scene["scales"].double(), compute_preci=False
    )
    results = _fully_fused_projection(
        scene["means"].double(), covariances, scene["viewmats"].double(), scene["Ks"].double(),
        scene["width"], scene["height"], calc_compensations=True, **options,
    )  # fmt: skip
    return dict(zip(NAMES, results, strict=True))


def crowded(rng: np.random.Generator) -> dict[str, Any]:
    """Two cameras close enough that some Gaussians lie behind them and many outside of the
    image."""
    scene = random_scene(rng, 400, cameras=2, size=(50, 37))
    scene["viewmats"][:, 2, 3] = 0.8
    return scene


@pytest.mark.parametrize("options", [{}, {"eps2d": 1.5}, {"near_plane": 0.5, "far_plane": 1.2}])
def test_projection(rng, options: dict[str, float]) -> None:
    scene = crowded(rng)
    scene["opacities"] = torch.ones(400)  # their PyTorch code has no opacity-aware bound
    _, _, info = rasterization(**scene, packed=False, **options)
    expected = theirs(scene, **options)
    seen = (expected["radii"] > 0).all(dim=-1)
    ours = (info["radii"] > 0).all(dim=-1)
    assert seen.sum() > 50
    assert (~seen).sum() > 50
    # An opacity of 1 reaches 1/255 at 3.329 sigmas, their code's box ends at 3.33: a pixel more or
    # less.
    assert (info["radii"] - expected["radii"])[ours & seen].abs().max() <= 1
    assert (ours != seen).sum() <= 1
    for name, relative in (("means2d", 1e-6), ("depths", 1e-6), ("conics", 1e-5)):
        torch.testing.assert_close(
            info[name][ours & seen].double(), expected[name][ours & seen], rtol=relative, atol=1e-5
        )


def test_compensation(rng) -> None:
    scene = crowded(rng)
    _, _, info = rasterization(**scene, packed=False, rasterize_mode="antialiased")
    expected = theirs(scene)
    seen = (info["radii"] > 0).all(dim=-1)
    compensated = scene["opacities"].double() * expected["compensations"]
    torch.testing.assert_close(
        info["opacities"][seen].double(), compensated[seen], rtol=1e-5, atol=1e-6
    )
    assert (compensated[seen] >= 1 / 255 - 1e-6).all()
    assert (compensated[seen] < 0.5 * scene["opacities"].expand(2, -1)[seen]).any()


def test_radii_know_the_opacity() -> None:
    """The box ends where alpha is 1/255: sigma = sqrt(2 log(255 opacity)) standard deviations."""
    scene = random_scene(np.random.default_rng(0), 3, size=(64, 64))
    scene["viewmats"] = torch.eye(4)[None]
    scene["means"] = torch.tensor([[0.0, 0.0, 2.0]]).repeat(3, 1)
    scene["quats"] = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    scene["scales"] = torch.tensor([[0.2, 0.1, 0.1]]).repeat(3, 1)
    scene["opacities"] = torch.tensor([0.02, 0.3, 1.0])
    scene["Ks"] = torch.tensor([[[64.0, 0, 32], [0, 64.0, 32], [0, 0, 1]]])
    _, _, info = rasterization(**scene, packed=False)
    # The covariance along x is (64 * 0.2 / 2)^2 + 0.3: a blur of 0.3 px^2 on 6.4 px.
    sigmas = np.sqrt(2 * np.log(255 * np.array([0.02, 0.3, 1.0])))
    expected = np.ceil(sigmas[:, None] * np.sqrt(np.array([6.4, 3.2]) ** 2 + 0.3))
    assert np.array_equal(info["radii"][0].numpy(), expected)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics(rng, degree: int) -> None:
    arrays = rng.normal(size=(200, 3)), rng.normal(size=3), rng.normal(size=(200, 16, 3))
    weights = torch.tensor(rng.normal(size=(200, 3)))
    ours = [torch.tensor(each, dtype=torch.float32).requires_grad_() for each in arrays]
    slow = [each.detach().double().requires_grad_() for each in ours]
    colors = Harmonics.apply(*ours, None, torch.ones(200, 2, dtype=torch.int32), degree)
    harmonics = _spherical_harmonics(degree, slow[0] - slow[1], slow[2])
    expected = torch.clamp_min(harmonics + 0.5, 0.0)
    assert bool((expected == 0).any())
    torch.testing.assert_close(colors.double(), expected, rtol=1e-6, atol=1e-6)
    (colors * weights.float()).sum().backward()
    (expected * weights).sum().backward()
    for mine, theirs, tolerance in zip(ours, slow, (1e-5, 1e-4, 1e-6), strict=True):
        grad = torch.zeros_like(theirs) if theirs.grad is None else theirs.grad
        torch.testing.assert_close(mine.grad.double(), grad, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("coefficients", [4, 9, 16, 25])
def test_coefficients_that_take_no_part_do_not_matter(rng, coefficients: int) -> None:
    scene = random_scene(rng, coefficients=coefficients)
    broken, few = {**scene, "colors": scene["colors"].clone()}, dict(scene)
    broken["colors"][:, 4:] = torch.nan
    few["colors"] = scene["colors"][:, :4]
    rendered, expected = (rasterization(**each, sh_degree=1)[0] for each in (broken, few))
    assert torch.equal(rendered, expected)
    broken["colors"].requires_grad_()
    rasterization(**broken, sh_degree=1)[0].sum().backward()
    gradient = broken["colors"].grad
    assert bool(gradient[:, :4].any())
    assert not gradient[:, 4:].any()


def test_colors_are_half_more_and_never_negative() -> None:
    """Degree 0 of the image is opacity-weighted max(0, 0.5 + 0.2821 c)."""
    scene = random_scene(np.random.default_rng(0), 1, size=(8, 8), coefficients=1)
    scene.update(viewmats=torch.eye(4)[None], means=torch.tensor([[0.0, 0.0, 2.0]]))
    scene.update(scales=torch.full((1, 3), 100.0), opacities=torch.tensor([0.5]), backgrounds=None)
    scene["colors"] = torch.tensor([[[1.0, 0.0, -9.0]]])
    image = rasterization(**scene, sh_degree=0)[0][0, 4, 4]
    assert np.allclose(image.numpy(), [0.5 * (0.5 + 0.28209479), 0.25, 0.0], atol=1e-5)


def wall(opacity: float, depth: float = 2.0, count: int = 1) -> dict[str, Any]:
    """Equal Gaussians at one place, wide enough that exp(-sigma) is 1 over the image."""
    scene = random_scene(np.random.default_rng(0), count, size=(8, 8))
    scene.update(viewmats=torch.eye(4)[None], backgrounds=None, colors=torch.ones(count, 3))
    scene["means"] = torch.tensor([[0.0, 0.0, depth]]).repeat(count, 1)
    scene["scales"] = torch.full((count, 3), 1000.0)
    scene["opacities"] = torch.full((count,), opacity)
    return scene


@pytest.mark.parametrize(("opacity", "alpha"), [(0.0, 0), (0.0039, 0), (0.00393, 0.00393),
                                                (0.5, 0.5), (1.0, 0.999)])  # fmt: skip
def test_alpha_is_cut_at_one_255th_and_held_at_0_999(opacity: float, alpha: float) -> None:
    alphas = rasterization(**wall(opacity))[1]
    assert np.allclose(alphas.numpy(), alpha, rtol=2e-5, atol=0)


@pytest.mark.parametrize(("opacity", "blended"), [(0.901, 3), (0.95, 3), (0.98, 2), (0.5, 13)])
def test_blending_ends_before_a_ten_thousandth_passes(opacity: float, blended: int) -> None:
    """The Gaussian that would bring T to 1e-4 or less is left out."""
    assert (1 - opacity) ** blended > 1e-4 > (1 - opacity) ** (blended + 1)
    alphas = rasterization(**wall(opacity, count=20))[1]
    assert np.allclose(1 - alphas.numpy(), (1 - opacity) ** blended, rtol=2e-2)


@pytest.mark.parametrize(("depth", "visible"), [(-1.0, False), (0.009, False), (0.011, True),
                                                (99.0, True), (101.0, False)])  # fmt: skip
def test_near_and_far_planes(depth: float, visible: bool) -> None:
    scene = wall(0.5, depth)
    _, alpha, info = rasterization(**scene, far_plane=100.0)
    assert (len(info["gaussian_ids"]) == 1) == visible
    assert bool((alpha > 0).all()) == visible


def test_radius_clip() -> None:
    scene = random_scene(np.random.default_rng(0), 200)
    radii = rasterization(**scene, packed=False)[2]["radii"][0]
    clipped = rasterization(**scene, packed=False, radius_clip=4.0)[2]["radii"][0]
    kept = (radii > 4).any(dim=-1)
    assert kept.any()
    assert (radii > 0).all(dim=-1).sum() > kept.sum()
    assert torch.equal(clipped, radii * kept[:, None])


def test_pixel_centres_are_at_a_half() -> None:
    """A small round Gaussian on the corner of four pixels lights them equally."""
    scene = random_scene(np.random.default_rng(0), 1, size=(8, 8))
    scene.update(viewmats=torch.eye(4)[None], backgrounds=None)
    scene.update(means=torch.tensor([[0.0, 0.0, 2.0]]), scales=torch.full((1, 3), 0.01))
    scene["Ks"] = torch.tensor([[[8.0, 0, 4], [0, 8.0, 4], [0, 0, 1]]])
    alpha = rasterization(**scene)[1][0, :, :, 0]
    assert np.allclose(alpha[3:5, 3:5].numpy(), float(alpha.max()), rtol=1e-6)
    assert np.allclose(alpha.numpy(), alpha.flip(0).flip(1).numpy(), rtol=1e-6)
