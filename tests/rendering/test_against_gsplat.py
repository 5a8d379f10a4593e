"""Projection against the PyTorch code that gsplat publishes; its cut-offs, by hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci

from splatseed.rendering import rasterization

from .scenes import random_scene

NAMES = ("radii", "means2d", "depths", "conics", "compensations")


def theirs(scene, **options):
    """gsplat's projection, in float64, [C, N, ...] each."""
    covariances, _ = _quat_scale_to_covar_preci(
        scene["quats"].double(), scene["scales"].double(), compute_preci=False
    )
    results = _fully_fused_projection(
        scene["means"].double(), covariances, scene["viewmats"].double(), scene["Ks"].double(),
        scene["width"], scene["height"], calc_compensations=True, **options,
    )  # fmt: skip
    return dict(zip(NAMES, results, strict=True))


def crowded(rng):
    """Two cameras so close that some Gaussians lie behind them and many outside of the image."""
    scene = random_scene(rng, 400, cameras=2, size=(50, 37))
    scene["viewmats"][:, 2, 3] = 0.8
    return scene


@pytest.mark.parametrize("options", [{}, {"eps2d": 1.5}, {"near_plane": 0.5, "far_plane": 1.2}])
def test_projection(rng, options):
    scene = crowded(rng)
    scene["opacities"] = torch.ones(400)  # their PyTorch code has no opacity-aware bound
    _, _, info = rasterization(**scene, packed=False, **options)
    expected = theirs(scene, **options)
    seen, ours = ((each["radii"] > 0).all(dim=-1) for each in (expected, info))
    assert min(seen.sum(), (~seen).sum()) > 50
    # An opacity of 1 reaches 1/255 at 3.329 sigmas, their box ends at 3.33: a pixel more or less.
    assert (info["radii"] - expected["radii"])[ours & seen].abs().max() <= 1
    assert (ours != seen).sum() <= 1
    for name, relative in (("means2d", 1e-6), ("depths", 1e-6), ("conics", 1e-5)):
        torch.testing.assert_close(
            info[name][ours & seen].double(), expected[name][ours & seen], rtol=relative, atol=1e-5
        )


def alone(count, size=8, **change):
    """White Gaussians two units in front of a camera at the origin, before black."""
    scene = random_scene(np.random.default_rng(0), count, size=(size, size))
    scene.update(viewmats=torch.eye(4)[None], backgrounds=None, colors=torch.ones(count, 3))
    scene["means"] = torch.tensor([[0.0, 0.0, 2.0]]).repeat(count, 1)
    scene["Ks"] = torch.tensor([[[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]])
    return {**scene, **change}


def test_radii_depend_on_the_opacity():
    """The box ends where alpha is 1/255: sigma = sqrt(2 log(255 opacity)) standard deviations."""
    opacities = [0.02, 0.3, 1.0]
    quats, scales = torch.tensor([[1.0, 0, 0, 0]] * 3), torch.tensor([[0.2, 0.1, 0.1]] * 3)
    scene = alone(3, 64, quats=quats, scales=scales, opacities=torch.tensor(opacities))
    _, _, info = rasterization(**scene, packed=False)
    # The covariance along x is (64 * 0.2 / 2)^2 + 0.3: a blur of 0.3 px^2 on 6.4 px.
    sigmas = np.sqrt(2 * np.log(255 * np.array(opacities)))
    expected = np.ceil(sigmas[:, None] * np.sqrt(np.array([6.4, 3.2]) ** 2 + 0.3))
    assert np.array_equal(info["radii"][0].numpy(), expected)


def wall(opacity, count=1):
    """Equal Gaussians at the same position, wide enough that exp(-sigma) is 1 over the image."""
    sizes, opacities = torch.full((count, 3), 1000.0), torch.full((count,), opacity)
    return alone(count, scales=sizes, opacities=opacities)


@pytest.mark.parametrize(
    ("opacity", "alpha"), [(0.0, 0), (0.0039, 0), (0.00393, 0.00393), (0.5, 0.5), (1.0, 0.999)]
)
def test_alpha_below_1_255th_is_zero_and_at_most_0_999(opacity, alpha):
    alphas = rasterization(**wall(opacity))[1]
    assert np.allclose(alphas.numpy(), alpha, rtol=2e-5, atol=0)


@pytest.mark.parametrize(("opacity", "blended"), [(0.901, 3), (0.95, 3), (0.98, 2), (0.5, 13)])
def test_blending_stops_before_the_minimum_transmittance(opacity, blended):
    """The Gaussian that would bring T to 1e-4 or less is skipped."""
    assert (1 - opacity) ** blended > 1e-4 > (1 - opacity) ** (blended + 1)
    alphas = rasterization(**wall(opacity, count=20))[1]
    assert np.allclose(1 - alphas.numpy(), (1 - opacity) ** blended, rtol=2e-2)


def test_radius_clip():
    scene = random_scene(np.random.default_rng(0), 200)
    radii = rasterization(**scene, packed=False)[2]["radii"][0]
    clipped = rasterization(**scene, packed=False, radius_clip=4.0)[2]["radii"][0]
    kept = (radii > 4).any(dim=-1)
    assert (radii > 0).all(dim=-1).sum() > kept.sum() > 0
    assert torch.equal(clipped, radii * kept[:, None])
