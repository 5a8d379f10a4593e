"""Image, alpha and every gradient against the float64 reference, in every mode."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from splatseed.rendering import rasterization, reference

from .scenes import DIFFERENTIABLE, gradients, random_scene, slow_rasterization

MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "three cameras": ({"cameras": 3}, {}),
    "three cameras, not packed": ({"cameras": 3}, {"packed": False}),
    "no background": ({}, {"backgrounds": None}),
    "antialiased": ({}, {"rasterize_mode": "antialiased"}),
    "antialiased depth": ({}, {"rasterize_mode": "antialiased", "render_mode": "RGB+ED"}),
    "antialiased, no blur to speak of": ({}, {"rasterize_mode": "antialiased", "eps2d": 0.01}),
    "more blur": ({}, {"eps2d": 2.0}),
    "planes that cull": ({}, {"near_plane": 2.7, "far_plane": 3.4}),
    **{f"mode {mode}": ({"cameras": 2}, {"render_mode": mode}) for mode in MODES},
    **{f"{each} channels": ({"channels": each}, {}) for each in (1, 3, 4, 5, 9)},
    **{f"degree {each}": ({"coefficients": 16, "cameras": 2}, {"sh_degree": each})
       for each in range(4)},
    "all four coefficients": ({"coefficients": 4}, {"sh_degree": 1, "render_mode": "RGB+D"}),
    **{f"{width} x {height} px": ({"size": (width, height)}, {})
       for width, height in ((1, 1), (5, 3), (8, 8), (9, 17), (64, 7))},
}  # fmt: skip


def assert_same(ours: Tensor, theirs: Tensor, what: str, tolerance: float = 1e-4) -> None:
    """Within ``tolerance`` of the largest entry.

    Expected depth, which divides by alpha, comes nearest to it: up to 7e-5; the rest stays below a
    third of that.
    """
    assert ours.shape == theirs.shape, what
    scale = max(float(theirs.abs().max()), 1e-3)
    assert float((ours.double() - theirs).abs().max()) <= tolerance * scale, what


def assert_agrees(scene: dict[str, Any], **options: Any) -> tuple[Tensor, Tensor]:
    """Compare; return the reference's image and alpha, for tests to check that they are not
    empty."""
    image, alpha, grads = gradients(scene, **options)
    slow_image, slow_alpha, expected = gradients(scene, slow=True, **options)
    assert_same(image, slow_image, "image")
    assert_same(alpha, slow_alpha, "alpha")
    for name, each in grads.items():
        assert_same(each, expected[name], f"gradient of {name}")
    return slow_image, slow_alpha


@pytest.mark.parametrize("case", CASES)
def test_agrees(case: str) -> None:
    shape, options = CASES[case]
    scene = random_scene(np.random.default_rng(list(CASES).index(case)), **shape)
    scene.update({name: options[name] for name in options if name in scene})
    image, alpha = assert_agrees(scene, **{k: v for k, v in options.items() if k not in scene})
    assert float(alpha.max()) > 0.1
    assert float(image.abs().max()) > 0.1


def test_colors_of_each_camera(rng) -> None:
    scene = random_scene(rng, cameras=2)
    scene["colors"] = torch.rand(2, *scene["colors"].shape, generator=torch.manual_seed(0))
    assert_agrees(scene)
    assert_agrees(scene, packed=False)


def test_coefficients_of_each_camera(rng) -> None:
    scene = random_scene(rng, cameras=2, coefficients=9)
    scene["colors"] = torch.randn(2, *scene["colors"].shape, generator=torch.manual_seed(0))
    assert_agrees(scene, sh_degree=2)


def test_a_render_may_be_changed_in_place(rng) -> None:
    scene = random_scene(rng)
    scene["means"].requires_grad_()
    grads = []
    for change in (torch.sqrt, torch.sqrt_):
        image, _, _ = rasterization(**scene)
        change(image).sum().backward()
        grads.append(scene["means"].grad.clone())
        scene["means"].grad = None
    assert torch.equal(*grads)
    assert float(grads[0].abs().sum()) > 0


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_pair_of_coefficients_is_their_concatenation(rng, degree: int) -> None:
    scene = random_scene(rng, coefficients=9, cameras=2)
    whole = scene["colors"].clone().requires_grad_()
    parts = [
        part.clone().requires_grad_() for part in (whole[:, :1].detach(), whole[:, 1:].detach())
    ]
    weights = torch.rand(2, scene["height"], scene["width"], 3, generator=torch.manual_seed(0))
    images = []
    for colors in (whole, tuple(parts)):
        image, _, _ = rasterization(**{**scene, "colors": colors}, sh_degree=degree)
        (image * weights).sum().backward()
        images.append(image)
    assert torch.equal(*images)
    assert torch.equal(torch.cat([part.grad for part in parts], dim=1), whole.grad)
    assert bool(whole.grad[:, : (degree + 1) ** 2].abs().sum() > 0)


@pytest.mark.parametrize("seed", range(3))
def test_cutoffs_of_opaque_scenes(seed: int) -> None:
    """Alpha is at most 0.999, and blending stops at a transmittance of 1e-4."""
    scene = random_scene(np.random.default_rng(seed), 150)
    scene["opacities"] = 1.0 - 0.02 * (1.0 - scene["opacities"])
    scene["scales"] = scene["scales"].clamp(min=0.15)
    _, alpha = assert_agrees(scene)
    assert float(alpha.median()) > 0.999
    assert float(alpha.max()) < 1.0 - reference.MIN_TRANSMITTANCE


def test_clamped_jacobian(rng) -> None:
    """Gaussians outside the image, whose x / z is clamped at 15% beyond the edge."""
    scene = random_scene(rng, 40, size=(24, 24))
    scene["Ks"][:, :2, :2] *= 3.0
    scene["scales"] = scene["scales"].clamp(min=0.3)
    scene["opacities"] = scene["opacities"] * 0.3
    points = scene["means"] @ scene["viewmats"][0, :3, :3].T + scene["viewmats"][0, :3, 3]
    u = points[:, 0] / points[:, 2] * scene["Ks"][0, 0, 0] + scene["Ks"][0, 0, 2]
    assert ((u < -0.2 * 24) | (u > 1.2 * 24)).sum() > 5
    assert_agrees(scene)


def test_packed_makes_no_difference(rng) -> None:
    scene = random_scene(rng, cameras=3)
    packed, dense = (rasterization(**scene, packed=packed) for packed in (True, False))
    assert torch.equal(packed[0], dense[0])
    assert torch.equal(packed[1], dense[1])


def test_info_lists_visible_gaussians(rng) -> None:
    scene = random_scene(rng, 80, cameras=3)
    scene["Ks"][:, :2, :2] *= 3.0
    (_, _, packed), (_, _, dense) = (rasterization(**scene, packed=p) for p in (True, False))
    seen = (dense["radii"] > 0).all(dim=-1)
    assert 0 < seen.sum() < seen.numel()
    cameras, ids = torch.nonzero(seen, as_tuple=True)
    assert torch.equal(packed["camera_ids"], cameras)
    assert torch.equal(packed["gaussian_ids"], ids)
    for name in ("means2d", "radii", "depths", "conics", "opacities"):
        assert torch.equal(packed[name], dense[name][seen]), name
    assert (packed["n_cameras"], packed["width"], packed["height"]) == (3, 29, 21)


@pytest.mark.parametrize(("packed", "channels"), [(True, 3), (False, 3), (False, 4)])
def test_gradient_of_2d_means(rng, packed: bool, channels: int) -> None:
    """The inputs of densification: d loss / d means2d, and the sum of its absolute values over
    pixels."""
    scene = random_scene(rng, cameras=2, channels=channels)
    ours, ours_abs, seen = _gradients_of_2d_means(scene, packed=packed)
    for camera in range(2):
        expected, expected_abs = _slow_gradients_of_2d_means(scene, camera)
        rows = seen[camera]
        assert_same(ours[camera], expected * rows[:, None], "gradient")
        assert_same(ours_abs[camera], expected_abs * rows[:, None], "absolute gradient")
        assert (ours_abs[camera] >= ours[camera].abs() - 1e-4).all()


def _gradients_of_2d_means(scene: dict[str, Any], *, packed: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Both gradients [C, N, 2], and the visible Gaussians, bool, [C, N]."""
    means = scene["means"].clone().requires_grad_()
    image, alpha, info = rasterization(**{**scene, "means": means}, packed=packed, absgrad=True)
    info["means2d"].retain_grad()
    _weighted(image, alpha).backward()
    shape = (2, len(means), 2)
    grads = info["means2d"].grad, info["means2d"].absgrad
    if not packed:
        return *grads, (info["radii"] > 0).all(dim=-1)
    rows = info["camera_ids"], info["gaussian_ids"]
    dense = [torch.zeros(shape).index_put(rows, each) for each in grads]
    return *dense, torch.zeros(shape[:2], dtype=torch.bool).index_put(rows, torch.tensor(True))


def _slow_gradients_of_2d_means(scene: dict[str, Any], camera: int) -> tuple[Tensor, Tensor]:
    """The reference with a 2D mean of its own for every pixel: [N, 2] each."""
    double = {k: v.double() if isinstance(v, Tensor) else v for k, v in scene.items()}
    viewmat, K = double["viewmats"][camera], double["Ks"][camera]
    width, height = scene["width"], scene["height"]
    points = double["means"] @ viewmat[:3, :3].T + viewmat[:3, 3]
    covariance, _ = reference._covariance2d(
        points, double["quats"], double["scales"], viewmat, K, width, height, 0.3
    )
    order = torch.argsort(points[:, 2])
    means2d = points[:, :2] / points[:, 2:] * reference._focal(K) + K[:2, 2]
    each = means2d[order, None, None, :].repeat(1, height, width, 1).requires_grad_()
    image, passing = reference._blend(
        each, torch.linalg.inv(covariance)[order], double["opacities"][order],
        double["colors"][order], width, height,
    )  # fmt: skip
    image = image + passing[..., None] * double["backgrounds"][camera]
    _weighted(image[None], (1.0 - passing)[None, ..., None], camera).backward()
    back = torch.argsort(order)
    return each.grad.sum(dim=(1, 2))[back], each.grad.abs().sum(dim=(1, 2))[back]


def _weighted(image: Tensor, alpha: Tensor, camera: int = 0) -> Tensor:
    """A loss whose weights are, for each camera, the same in both precisions."""
    loss = image.new_zeros(())
    for i in range(len(image)):
        weights = torch.randn(*image.shape[1:], 2, generator=torch.manual_seed(camera + i))
        weights = weights.to(image)
        loss = loss + (image[i] * weights[..., 0]).sum() + (alpha[i] * weights[..., :1, 1]).sum()
    return loss


def test_order_of_input_makes_no_difference(rng) -> None:
    """Depths being distinct, a permutation of the Gaussians gives the same picture."""
    scene = random_scene(rng)
    order = torch.randperm(60, generator=torch.manual_seed(0))
    shuffled = {**scene, **{k: scene[k][order] for k in
                            ("means", "quats", "scales", "opacities", "colors")}}  # fmt: skip
    assert torch.equal(rasterization(**scene)[0], rasterization(**shuffled)[0])


def test_ties_in_depth_go_by_index() -> None:
    count = 5
    scene = random_scene(np.random.default_rng(0), count, size=(16, 16))
    scene["viewmats"] = torch.eye(4)[None]
    scene["means"] = torch.tensor([[0.0, 0.0, 2.0]]).repeat(count, 1)
    scene["scales"] = torch.full((count, 3), 0.5)
    scene["opacities"] = torch.full((count,), 0.5)
    assert_agrees(scene)
    reversed_ = {**scene, "colors": scene["colors"].flip(0)}
    assert not torch.allclose(rasterization(**scene)[0], rasterization(**reversed_)[0], atol=1e-3)


def test_reference_differentiates_itself() -> None:
    """The specification's own gradients against central differences, in float64."""
    scene = _smooth_scene(coefficients=4)
    inputs = [scene[name].double().requires_grad_() for name in DIFFERENTIABLE]
    rest = {"Ks": scene["Ks"].double(), "width": 6, "height": 5, "sh_degree": 1}

    def render(*tensors: Tensor) -> tuple[Tensor, Tensor]:
        return slow_rasterization(**dict(zip(DIFFERENTIABLE, tensors, strict=True)), **rest)

    assert torch.autograd.gradcheck(render, inputs, eps=1e-7, atol=1e-5, rtol=1e-4, fast_mode=True)


def _smooth_scene(**shape: Any) -> dict[str, Any]:
    """Five Gaussians over all of a tiny image: no cut-off where a difference would jump."""
    scene = random_scene(np.random.default_rng(5), 5, size=(6, 5), **shape)
    scene["means"] = scene["means"] * 0.3
    scene["scales"] = scene["scales"] + 0.6
    scene["opacities"] = scene["opacities"] * 0.4 + 0.3
    return scene


STEPS = {"means": 2e-3, "quats": 2e-3, "scales": 1e-3, "opacities": 2e-3, "colors": 1e-2,
         "viewmats": 1e-3}  # fmt: skip


@pytest.mark.parametrize("name", STEPS)
def test_central_differences(name: str) -> None:
    """Our own float32 gradients against our own images, wide enough to see over rounding."""
    scene = _smooth_scene()
    _, _, grads = gradients(scene)
    for index in np.ndindex(*scene[name].shape[:-1], min(scene[name].shape[-1], 4)):
        losses = [_loss(scene, name, index, sign * STEPS[name]) for sign in (-2, -1, 1, 2)]
        slope = (losses[0] - 8 * losses[1] + 8 * losses[2] - losses[3]) / (12 * STEPS[name])
        largest = float(grads[name].abs().max())
        assert abs(slope - float(grads[name][index])) <= 2e-3 * largest, (name, index)


def _loss(scene: dict[str, Any], name: str, index: tuple[int, ...], step: float) -> float:
    """The loss of ``gradients`` with one number moved."""
    moved = scene[name].clone()
    moved[index] += step
    image, alpha, _ = rasterization(**{**scene, name: moved})
    weights = np.random.default_rng(1)
    loss = (image.double().numpy() * weights.normal(size=tuple(image.shape))).sum()
    return float(loss + (alpha.double().numpy() * weights.normal(size=tuple(alpha.shape))).sum())


def test_stages_follow_one_another() -> None:
    """A gradient of zero in, a gradient of zero out: nothing is added on the way."""
    scene = random_scene(np.random.default_rng(0))
    inputs = {
        name: value.clone().requires_grad_() if isinstance(value, Tensor) else value
        for name, value in scene.items()
    }
    image, _, _ = rasterization(**inputs)
    (0.0 * image).sum().backward()
    assert all(
        not inputs[name].grad.any()
        for name in ("means", "quats", "scales", "opacities", "colors", "viewmats")
    )


def test_depth_rises_with_distance() -> None:
    """Expected depth of an opaque wall is its distance, whatever the mode calls it."""
    depths = [1.5, 2.0, 4.0]
    rendered = []
    for depth in depths:
        wall = random_scene(np.random.default_rng(0), 1, size=(8, 8))
        wall["viewmats"], wall["backgrounds"] = torch.eye(4)[None], None
        wall["means"] = torch.tensor([[0.0, 0.0, depth]])
        wall["scales"] = torch.full((1, 3), 50.0)
        wall["opacities"] = torch.tensor([0.99])
        rendered.append(float(rasterization(**wall, render_mode="ED")[0][0, 4, 4, 0]))
    assert np.allclose(rendered, depths, rtol=1e-5)
    assert all(near < far for near, far in pairwise(rendered))
