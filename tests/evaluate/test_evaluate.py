"""Scores must be those of the papers: checked against torchmetrics and by hand."""

from __future__ import annotations

import dataclasses
import json
import math

import numpy as np
import pytest
from PIL import Image

# An import below imports PyTorch, so that it has to come after the question whether it is there.
torch = pytest.importorskip("torch", reason="evaluation needs PyTorch")

from splatseed.errors import ParameterError, SceneFormatError, SceneNotFoundError
from splatseed.evaluate import (
    EvalResult,
    ViewScore,
    evaluate_model,
    evaluate_views,
    load_lpips,
    load_model,
    write_renders,
)
from splatseed.evaluate.lpips import LPIPS_NETS
from splatseed.evaluate.model import frame_of_scene, gaussian_renderer
from splatseed.io import load_scene
from splatseed.splat.gaussians import initial_gaussians
from splatseed.splat.ply import write_gaussians
from splatseed.views.view import View


@pytest.fixture
def truth(rng):
    return rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)


@pytest.fixture
def noisy(rng, truth):
    noise = rng.normal(0, 0.1, truth.shape).astype(np.float32)
    return torch.from_numpy(truth / np.float32(255) + noise)


def _view(image, name="a.png"):
    height, width = image.shape[:2]
    return View(name, image, np.eye(3), width, height, np.eye(4))


def test_scores_are_those_of_torchmetrics_on_clamped_renders(truth, noisy):
    functional = pytest.importorskip("torchmetrics.functional.image")
    result = evaluate_views(lambda _: noisy, [_view(truth)])

    def planes(image):
        return image.clamp(0, 1).permute(2, 0, 1)[None]

    x, y = planes(noisy), planes(torch.from_numpy(truth / np.float32(255)))
    psnr = functional.peak_signal_noise_ratio(x, y, data_range=1.0)
    ssim = functional.structural_similarity_index_measure(x, y, sigma=1.5, data_range=1.0)
    assert result.psnr == pytest.approx(float(psnr), abs=1e-3)
    assert result.ssim == pytest.approx(float(ssim), abs=1e-5)


def test_the_mean_psnr_is_that_of_the_images_not_of_the_mean_error():
    image = np.zeros((16, 16, 3), np.uint8)
    errors = {"a.png": 0.1, "b.png": 0.01}
    views = [_view(image, name) for name in errors]
    result = evaluate_views(lambda v: torch.full((16, 16, 3), errors[v.name]), views)
    assert [s.psnr for s in result.per_image] == pytest.approx([20, 40], abs=1e-4)
    assert result.psnr == pytest.approx(30, abs=1e-4)
    assert [s.name for s in result.per_image] == ["a.png", "b.png"]


def test_values_beyond_the_range_are_clamped():
    white = _view(np.full((16, 16, 3), 255, np.uint8))
    assert evaluate_views(lambda _: torch.full((16, 16, 3), 7.0), [white]).psnr == math.inf


def test_lpips_that_was_not_measured_says_why(truth, noisy):
    result = evaluate_views(lambda _: noisy, [_view(truth)], lpips_reason="no weights")
    assert result.lpips is None
    assert result.to_dict()["lpips"] is None
    assert result.to_dict()["lpips_reason"] == "no weights"


@pytest.mark.parametrize(
    ("image", "says"),
    [
        (torch.zeros(64, 48, 3), "of shape [48, 64, 3]"),
        (torch.full((48, 64, 3), math.nan), "finite values"),
    ],
)
def test_a_render_that_cannot_be_scored_is_refused(truth, image, says):
    with pytest.raises(ParameterError, match=says.replace("[", r"\[")):
        evaluate_views(lambda _: image, [_view(truth)])


def test_no_views_are_refused():
    with pytest.raises(ParameterError, match="views to score"):
        evaluate_views(lambda _: torch.zeros(1), [])


def test_json_is_valid_also_for_a_perfect_render():
    scores = (ViewScore("a", math.inf, 1.0, 0.0, 0.1), ViewScore("b", 30.0, 0.9, 0.2, 0.3))
    result = EvalResult(scores, lpips_net="vgg", lpips_reason="")
    content = json.loads(result.to_json())
    assert content["psnr"] is None
    assert content["per_image"][0]["psnr"] is None
    assert content["per_image"][1]["psnr"] == 30.0
    assert content["ssim"] == pytest.approx(0.95)
    assert content["lpips"] == pytest.approx(0.1)
    assert content["render_seconds"] == pytest.approx(0.2)


def _random_weights(net, divisor=1):
    """Weights of a network by torchvision's names; channels as in the real one, or fewer."""
    channels = {
        "vgg": (64, 64, 128, 128, 256, 256, 256, 512, 512, 512, 512, 512, 512),
        "alex": (64, 192, 384, 256, 256),
    }[net]
    sizes = {"vgg": (3,) * 13, "alex": (11, 5, 3, 3, 3)}[net]
    generator = torch.Generator().manual_seed(0)
    state, before = {}, 3
    convs = [conv for stage in LPIPS_NETS[net].stages for conv in stage]
    for conv, count, size in zip(convs, channels, sizes, strict=True):
        shape = (count // divisor, before, size, size)
        weight = torch.randn(shape, generator=generator) * math.sqrt(2 / (before * size**2))
        state[f"features.{conv.layer}.weight"] = weight
        state[f"features.{conv.layer}.bias"] = 0.1 * torch.randn(shape[0], generator=generator)
        before = shape[0]
    return state


def _torchvision_features(net, state):
    """The network as torchvision lists it, for torchmetrics."""
    nn = torch.nn
    layers, channels = [], 3
    for number, stage in enumerate(LPIPS_NETS[net].stages):
        if net == "vgg" and number:
            layers.append(nn.MaxPool2d(2, 2))
        if net == "alex" and number in {1, 2}:
            layers.append(nn.MaxPool2d(3, 2))
        for conv in stage:
            weight = state[f"features.{conv.layer}.weight"]
            assert len(layers) == conv.layer
            assert weight.shape[1] == channels
            channels = len(weight)
            layers += [
                nn.Conv2d(weight.shape[1], channels, weight.shape[2], conv.stride, conv.padding),
                nn.ReLU(inplace=False),
            ]
    if net == "vgg":
        layers.append(nn.MaxPool2d(2, 2))
    features = nn.Sequential(*layers)
    features.load_state_dict({key.removeprefix("features."): v for key, v in state.items()})
    return features


@pytest.mark.parametrize("net", ["alex", "vgg"])
def test_lpips_is_that_of_torchmetrics(net, tmp_path, monkeypatch, truth, noisy):
    reference = pytest.importorskip("torchmetrics.functional.image.lpips")
    state = _random_weights(net)
    torch.save({**state, "classifier.1.weight": torch.zeros(1)}, tmp_path / LPIPS_NETS[net].file)
    features = _torchvision_features(net, state)
    monkeypatch.setattr(reference, "_get_tv_model_features", lambda *_: features)
    theirs = reference._LPIPS(net=net)
    image, photo = noisy.clamp(0, 1), torch.from_numpy(truth / np.float32(255))
    expected = theirs(*(i.permute(2, 0, 1)[None] for i in (image, photo)), normalize=True)
    lpips = load_lpips(net, tmp_path)
    assert lpips(image, photo) == pytest.approx(float(expected), rel=1e-4)
    assert lpips(photo, photo) == 0.0


@pytest.mark.parametrize(("net", "theirs"), [("alex", 0.1570625), ("vgg", 0.3332108)])
def test_lpips_with_the_published_weights_is_that_of_its_authors(net, theirs):
    """Numbers that the package ``lpips`` 0.1.4 gave for the same images."""
    try:
        metric = load_lpips(net)
    except SceneNotFoundError as error:
        pytest.skip(f"no weights in PyTorch's cache: {error}")
    row, column = np.mgrid[:96, :128]
    truth = np.stack([2 * row, 2 * column % 256, (row // 8 + column // 8) % 2 * 255], axis=-1)
    render = np.roll(truth, 3, axis=1) // 2 + 60
    pair = [torch.from_numpy(image / np.float32(255)).float() for image in (truth, render)]
    assert metric(*pair) == pytest.approx(theirs, abs=1e-6)


def test_lpips_reaches_the_result(tmp_path, truth, noisy):
    torch.save(_random_weights("alex"), tmp_path / LPIPS_NETS["alex"].file)
    lpips = load_lpips("alex", tmp_path / LPIPS_NETS["alex"].file)
    result = evaluate_views(lambda _: noisy, [_view(truth), _view(truth)], lpips=lpips)
    assert result.lpips_net == "alex"
    assert result.lpips_reason == ""
    assert result.lpips > 0
    assert result.lpips == result.per_image[0].lpips


def test_absent_weights_are_named_with_where_to_get_and_put_them(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(SceneNotFoundError) as caught:
        load_lpips("vgg")
    for text in (
        "https://",
        "vgg16-397923af.pth",
        str(tmp_path / "checkpoints"),
        "--lpips-weights",
    ):
        assert text in str(caught.value)


def test_cached_weights_are_found(tmp_path, monkeypatch):
    (tmp_path / "checkpoints").mkdir()
    torch.save(_random_weights("alex"), tmp_path / "checkpoints" / LPIPS_NETS["alex"].file)
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    assert load_lpips("alex").net == "alex"


def _other_network():
    return _random_weights("alex")


def _too_few_channels():
    return _random_weights("vgg", divisor=2)


def _list():
    return [torch.zeros(1)]


@pytest.mark.parametrize("make", [_other_network, _too_few_channels, _list])
def test_weights_of_something_else_are_refused(make, tmp_path):
    torch.save(make(), tmp_path / "weights.pth")
    with pytest.raises(SceneFormatError, match="weights that LPIPS needs"):
        load_lpips("vgg", tmp_path / "weights.pth")


@pytest.mark.parametrize("content", [b"", b"no weights", b"PK\x03\x04 cut off"])
def test_a_file_that_is_no_weights_is_refused(content, tmp_path):
    path = tmp_path / "weights.pth"
    path.write_bytes(content)
    with pytest.raises(SceneFormatError, match="cannot read"):
        load_lpips("vgg", path)


@pytest.fixture(scope="module")
def room(larger_room_path):
    return larger_room_path


@pytest.fixture(scope="module")
def model_path(room, tmp_path_factory):
    """The seeds themselves as Gaussians of the world, with some colour by direction."""
    gaussians = initial_gaussians(load_scene(room).points, opacity=0.9)
    gaussians.shN[:, :3] = np.random.default_rng(0).normal(0, 0.1, (len(gaussians), 3, 3))
    path = tmp_path_factory.mktemp("model") / "seeds.ply"
    write_gaussians(path, gaussians)
    return path


def test_a_ply_of_the_world_is_scored_on_the_test_views(room, model_path):
    model = load_model(model_path, room)
    result = evaluate_model(model)
    assert [s.name for s in result.per_image] == [i.name for i in load_scene(room).split()[1]]
    assert result.num_gaussians == len(load_scene(room).points)
    assert result.model_bytes == result.num_gaussians * 59 * 4
    black = evaluate_views(lambda v: torch.zeros(v.height, v.width, 3), model.views)
    assert result.psnr > black.psnr + 1


def test_a_model_looks_the_same_in_whatever_frame_it_is_rendered(room, model_path):
    scene = load_scene(room)
    model, frame = load_model(model_path, room), frame_of_scene(scene)
    other = dataclasses.replace(frame, origin=frame.origin + 0.5, scale=3 * frame.scale)
    moved = gaussian_renderer(model.gaussians, other)
    for view in model.views:
        # The near plane is closer there: nothing of the room lies that near.
        torch.testing.assert_close(moved(view), model.render(view), atol=2e-3, rtol=0)


def test_the_model_itself_is_left_as_it_was_read(room, model_path):
    model = load_model(model_path, room)
    before = {k: v.copy() for k, v in model.gaussians.arrays().items()}
    evaluate_model(model)
    for name, array in model.gaussians.arrays().items():
        np.testing.assert_array_equal(array, before[name])


def test_pictures_show_the_photograph_the_render_and_the_error(room, model_path, tmp_path):
    model = load_model(model_path, room, data_factor=2)
    write_renders(model, tmp_path)
    for view in model.views:
        assert (view.width, view.height) == (60, 45)
        with Image.open(tmp_path / view.name) as file:
            pixels = np.asarray(file)
        assert pixels.shape[0] == view.height
        assert pixels.shape[1] > 3 * view.width
        np.testing.assert_array_equal(pixels[:, : view.width], view.photograph)


def test_a_bare_cloud_is_no_scene_to_score_on(room, model_path):
    with pytest.raises(SceneNotFoundError, match="to have images"):
        load_model(model_path, room / "sparse/0/points3D.ply")
