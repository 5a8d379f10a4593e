"""LPIPS is that of torchmetrics and of its authors, with weights that are on this machine."""

from __future__ import annotations

import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="scoring needs PyTorch")
reference = pytest.importorskip("torchmetrics.functional.image.lpips")

from torch import nn

from splatseed.errors import SceneFormatError, SceneNotFoundError
from splatseed.splat.metrics import LPIPS_FILES, load_lpips

VGG = "64 64 M 128 128 M 256 256 256 M 512 512 512 M 512 512 512 M"
"""Torchvision's configuration D."""


def _torchvision_features(net):
    """The network's convolutions as torchvision lists them, with random weights."""
    if net == "alex":
        layers = [
            *(nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2), nn.ReLU()),
            *(nn.MaxPool2d(3, 2), nn.Conv2d(64, 192, 5, padding=2), nn.ReLU()),
            *(nn.MaxPool2d(3, 2), nn.Conv2d(192, 384, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(384, 256, 3, padding=1), nn.ReLU()),
            *(nn.Conv2d(256, 256, 3, padding=1), nn.ReLU(), nn.MaxPool2d(3, 2)),
        ]
    else:
        layers, before = [], 3
        for word in VGG.split():
            if word == "M":
                layers.append(nn.MaxPool2d(2, 2))
            else:
                layers += [nn.Conv2d(before, int(word), 3, padding=1), nn.ReLU()]
                before = int(word)
    generator = torch.Generator().manual_seed(0)
    for layer in layers:
        for weights in layer.parameters():
            spread = math.sqrt(2 / weights[0].numel()) if weights.ndim > 1 else 0.1
            weights.data.normal_(0, spread, generator=generator)
    return nn.Sequential(*layers)


@pytest.fixture(scope="module")
def networks(tmp_path_factory):
    """A folder with the weights of both networks as PyTorch's cache has them, and the layers."""
    folder = tmp_path_factory.mktemp("hub") / "checkpoints"
    folder.mkdir()
    features = {net: _torchvision_features(net) for net in LPIPS_FILES}
    for net, layers in features.items():
        state = {f"features.{name}": value for name, value in layers.state_dict().items()}
        torch.save({**state, "classifier.1.weight": torch.zeros(1)}, folder / LPIPS_FILES[net])
    return folder, features


@pytest.mark.parametrize("net", LPIPS_FILES)
def test_lpips_is_that_of_torchmetrics(net, networks, rng, monkeypatch):
    folder, features = networks
    monkeypatch.setattr(reference, "_get_tv_model_features", lambda *_: features[net])
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(folder.parent))
    image, photo = torch.from_numpy(rng.random((2, 48, 64, 3), np.float32))
    theirs = reference._LPIPS(net=net)
    expected = theirs(*(i.permute(2, 0, 1)[None] for i in (image, photo)), normalize=True)
    before = torch.random.get_rng_state()
    for weights in (None, folder, folder / LPIPS_FILES[net]):
        lpips = load_lpips(net, weights)
        assert lpips(image, photo) == pytest.approx(float(expected), rel=1e-4)
    assert lpips(photo, photo) == 0.0
    assert torch.equal(before, torch.random.get_rng_state())  # training after it is the same


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


def test_absent_weights_are_named_with_where_to_get_and_put_them(tmp_path, monkeypatch):
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    with pytest.raises(SceneNotFoundError) as caught:
        load_lpips("vgg")
    for text in ("https://", LPIPS_FILES["vgg"], f"{tmp_path}/checkpoints", "--lpips-weights"):
        assert text in str(caught.value)


@pytest.mark.parametrize("content", ["another network", "a list", b"", b"text", b"PK\x03\x04 cut"])
def test_a_file_of_something_else_is_refused(content, networks, tmp_path):
    path = tmp_path / "weights.pth"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content == "a list":
        torch.save([torch.zeros(1)], path)
    else:
        path = networks[0] / LPIPS_FILES["alex"]
    with pytest.raises(SceneFormatError, match=path.name):
        load_lpips("vgg", path)
