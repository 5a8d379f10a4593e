"""The loss kernel and the metrics against torchmetrics, autograd and LPIPS's authors."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="scoring needs PyTorch")

from PIL import Image as PillowImage
from torch import nn

from splatseed.camera import Camera
from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.photos.view import View
from splatseed.splat.evaluate import evaluate_views
from splatseed.splat.lpips import LPIPS_FILE, load_lpips
from splatseed.splat.metrics import color_corrected, flip_map, psnr
from splatseed.splat.ssim import l1_and_ssim, l1_and_ssim_by_convolution
from splatseed.training.trainer import photometric_loss

# L1, SSIM, PSNR -----------------------------------------------------------------------------------


def _pair(rng, height, width):
    x = rng.random((height, width, 3), np.float32)
    y = np.clip(x + rng.normal(0, 0.1, x.shape), 0, 1).astype(np.float32)
    return x, y


@pytest.mark.parametrize(("height", "width"), [(11, 11), (12, 40), (37, 23), (64, 50)])
def test_ssim_equals_torchmetrics_where_the_window_fits(rng, height, width):
    x, y = _pair(rng, height, width)
    pair = torch.from_numpy(x), torch.from_numpy(y)
    expected = float(_torchmetrics_ssim(*pair))
    assert l1_and_ssim(x, y, 0.8, 0.2)[1] == pytest.approx(expected, abs=2e-6)
    l1, ours, _ = l1_and_ssim_by_convolution(*pair, 0.8, 0.2)
    assert float(ours) == pytest.approx(expected, abs=2e-6)
    assert float(l1) == pytest.approx(np.abs(x - y).mean(), rel=1e-6)


def _torchmetrics_ssim(x, y):
    """Mean SSIM where the window fits entirely, differentiable.

    Collecting tests does not wait for torchmetrics, which imports transformers.
    """
    theirs = pytest.importorskip("torchmetrics.functional.image")
    images = (image.permute(2, 0, 1)[None] for image in (x, y))
    _, full = theirs.structural_similarity_index_measure(
        *images, data_range=1.0, return_full_image=True
    )
    return full[..., 5:-5, 5:-5].mean()


def _by_convolution(render, photograph):
    """The loss as on a GPU, its gradient from ``l1_and_ssim_by_convolution``."""
    l1, ssim, gradient = l1_and_ssim_by_convolution(render, photograph, 0.8, 0.2)
    value = 0.8 * l1 + 0.2 * (1 - ssim)
    return value + ((render - render.detach()) * gradient).sum()


@pytest.mark.parametrize("compute", [photometric_loss, _by_convolution])
def test_gradient_equals_autograd(rng, compute):
    x, y = (torch.from_numpy(image) for image in _pair(rng, 40, 29))
    ours, theirs = x.clone().requires_grad_(), x.double().requires_grad_()
    loss = compute(ours, y)
    expected = 0.8 * (theirs - y).abs().mean() + 0.2 * (1 - _torchmetrics_ssim(theirs, y.double()))
    (3 * loss).backward()
    (3 * expected).backward()
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)
    torch.testing.assert_close(ours.grad.double(), theirs.grad, rtol=1e-3, atol=1e-8)


def test_scores_are_of_clamped_renders(rng):
    theirs = pytest.importorskip("torchmetrics.functional.image")
    truth = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    photo = torch.from_numpy(truth / np.float32(255))
    noisy = photo + torch.from_numpy(rng.normal(0, 0.1, truth.shape).astype(np.float32))
    view = View("a.png", truth, Camera(np.eye(3), 64, 48, np.eye(4)))
    result = evaluate_views(lambda _: noisy, [view])
    x, y = (image.clamp(0, 1).permute(2, 0, 1)[None] for image in (noisy, photo))
    expected = theirs.peak_signal_noise_ratio(x, y, data_range=1.0)
    assert result.psnr == pytest.approx(float(expected), abs=1e-3)
    expected = theirs.structural_similarity_index_measure(x, y, sigma=1.5, data_range=1.0)
    assert result.ssim == pytest.approx(float(expected), abs=1e-5)


# FLIP ---------------------------------------------------------------------------------------------


def test_flip_equals_its_authors_tool(rng, tmp_path):
    """The tool reads PNG by itself, so channels, range and orientation must agree."""
    theirs = pytest.importorskip("flip_evaluator", reason="FLIP needs its package")
    photograph, render = rng.integers(0, 256, (2, 24, 40, 3), np.uint8)
    paths = [str(tmp_path / name) for name in ("photograph.png", "render.png")]
    for path, image in zip(paths, (photograph, render), strict=True):
        PillowImage.fromarray(image).save(path)
    expected, mean, _ = theirs.evaluate(*paths, "LDR", applyMagma=False)
    ours = flip_map(*(torch.from_numpy(image / np.float32(255)) for image in (render, photograph)))
    np.testing.assert_allclose(ours, expected[..., 0], atol=1e-5)
    assert ours.mean() == pytest.approx(mean, abs=1e-5)


def test_flip_is_0_for_equal_images_and_clamps(rng):
    photograph = torch.from_numpy(rng.random((60, 90, 3), np.float32))
    render = photograph.clone()
    render[:, :30] = 5.0
    errors = flip_map(render, photograph)
    assert errors.shape == (60, 90)
    assert errors[:, 60:].max() == 0.0  # beyond the reach of its filters
    assert 0.1 < errors[:, :30].mean() < errors.max() <= 1.0
    np.testing.assert_array_equal(errors, flip_map(render.clamp(0, 1), photograph))


# Colours ------------------------------------------------------------------------------------------


def _corrected_slowly(render, photograph):
    """multinerf's ``color_correct``, a pixel a row of the system."""
    x, y, eps = render.reshape(-1, 3).astype(float), photograph.reshape(-1, 3), 0.5 / 255
    inside = lambda values: (values >= eps) & (values <= 1 - eps)
    first = inside(x)
    for _ in range(5):
        squares = [x[:, i] * x[:, j] for i in range(3) for j in range(i, 3)]
        terms = np.stack([*squares, *x.T, np.ones(len(x))], axis=1)
        masks = (first & inside(x) & inside(y)).T
        fits = [np.linalg.lstsq(terms[m], y[m, c])[0] for c, m in enumerate(masks)]
        x = np.clip(terms @ np.stack(fits, axis=1), 0, 1)
    return x.reshape(render.shape)


def test_colour_correction_equals_multinerf_and_gsplat(rng):
    photograph = rng.random((40, 30, 3)).astype(np.float32)
    mixed = photograph @ np.array([[0.8, 0.1, 0], [0, 0.6, 0], [0, 0.1, 1.4]], np.float32)
    render = np.clip(mixed**1.1 + 0.03 * rng.standard_normal(mixed.shape), 0, 1).astype(np.float32)
    corrected = color_corrected(torch.from_numpy(render), torch.from_numpy(photograph))
    np.testing.assert_allclose(corrected, _corrected_slowly(render, photograph), atol=1e-5)


def test_colour_correction_removes_exposure_but_no_errors_of_content(rng):
    photograph = torch.from_numpy(rng.random((40, 30, 3), np.float32))
    dark = 0.6 * photograph + 0.05
    assert psnr(dark, photograph) < 20
    assert psnr(color_corrected(dark, photograph), photograph) > 60
    assert psnr(color_corrected(dark.flip(0), photograph), photograph) < 15
    for value in (0.0, 0.5, 1.0):  # nothing to fit, or the same everywhere
        assert bool(color_corrected(torch.full_like(dark, value), photograph).isfinite().all())


# LPIPS --------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A cache of PyTorch with random weights of VGG, and its layers as torchvision lists them."""
    layers, before = [], 3
    for word in [64, 64, "M", 128, 128, "M", *[256] * 3, "M", *[512] * 3, "M", *[512] * 3, "M"]:
        if word == "M":
            layers.append(nn.MaxPool2d(2, 2))
        else:
            layers += [nn.Conv2d(before, word, 3, padding=1), nn.ReLU()]
            before = word
    generator = torch.Generator().manual_seed(0)
    for weights in (each for layer in layers for each in layer.parameters()):
        spread = math.sqrt(2 / weights[0].numel()) if weights.ndim > 1 else 0.1
        weights.data.normal_(0, spread, generator=generator)
    features, folder = nn.Sequential(*layers), tmp_path_factory.mktemp("hub") / "checkpoints"
    folder.mkdir()
    state = {f"features.{name}": value for name, value in features.state_dict().items()}
    torch.save({**state, "classifier.1.weight": torch.zeros(1)}, folder / LPIPS_FILE)
    return folder, features


def test_lpips_equals_torchmetrics(network, rng, monkeypatch):
    folder, features = network
    reference = pytest.importorskip("torchmetrics.functional.image.lpips")
    monkeypatch.setattr(reference, "_get_tv_model_features", lambda *_: features)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(folder.parent))
    image, photo = torch.from_numpy(rng.random((2, 48, 64, 3), np.float32))
    theirs = reference._LPIPS(net="vgg")
    expected = theirs(*(i.permute(2, 0, 1)[None] for i in (image, photo)), normalize=True)
    before = torch.random.get_rng_state()
    for weights in (None, folder, folder / LPIPS_FILE):
        lpips = load_lpips(weights)
        assert lpips(image, photo) == pytest.approx(float(expected), rel=1e-4)
    assert lpips(photo, photo) == 0.0
    assert torch.equal(before, torch.random.get_rng_state())  # training after it is the same


def test_lpips_with_published_weights_equals_its_authors():
    """A number that the package ``lpips`` 0.1.4 gave for the same images."""
    try:
        metric = load_lpips()
    except SceneNotFoundError as error:
        pytest.skip(f"no weights in PyTorch's cache: {error}")
    row, column = np.mgrid[:96, :128]
    truth = np.stack([2 * row, 2 * column % 256, (row // 8 + column // 8) % 2 * 255], axis=-1)
    render = np.roll(truth, 3, axis=1) // 2 + 60
    pair = [torch.from_numpy(image / np.float32(255)).float() for image in (truth, render)]
    assert metric(*pair) == pytest.approx(0.3332108, abs=1e-6)


@pytest.mark.parametrize("content", [{}, [torch.zeros(1)], b"", b"text", b"PK\x03\x04 cut"])
def test_a_file_without_the_weights_is_refused(content, tmp_path):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        torch.save(content, path)
    with pytest.raises(SceneFormatError, match=path.name):
        load_lpips(path)
