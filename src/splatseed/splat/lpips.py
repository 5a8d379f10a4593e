"""LPIPS, version 0.1: the distance of two images in the feature space of a network.

d(x, y) = sum_l mean_pixels sum_c w_lc (f_lc(x) - f_lc(y))^2 (Zhang et al. 2018, eq. 1): f_l is
the output of the l-th of 5 stages, scaled to unit length over its channels, and w_l >= 0 are learnt
weights. The network's weights are torchvision's, the w_l torchmetrics'. The network is built here,
because torchmetrics needs torchvision for it, which requires one version of PyTorch. Nothing is
downloaded.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor, nn

from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.io.files import special_kind, translate_errors
from splatseed.requirements import require

LPIPS_NET, LPIPS_FILE = "vgg", "vgg16-397923af.pth"
"""The network that papers on 3DGS use for LPIPS, and PyTorch's name of its weights file."""
_URL = "https://download.pytorch.org/models/"
_TAPS = (3, 8, 15, 22, 29)  # layers whose outputs are compared
# Each channel of an image in [-1, 1] becomes (value - SHIFT) / SCALE, as in the metric's code.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_EPSILON = 1e-8
"""Added to squared lengths, so that zero features can be normalised."""


@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS with its weights."""

    features: nn.Sequential  # the network's convolutions, in torchvision's order
    heads: list[Tensor]  # w_l of each stage, [1, C_l, 1, 1]

    @torch.no_grad()
    @torch.backends.cudnn.flags(enabled=True, allow_tf32=False)  # the same score on all devices
    def __call__(self, render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
        """Return the distance of two images of values in [0, 1]; 0 for equal images."""
        pair = torch.stack([render, photograph]).permute(0, 3, 1, 2)
        shift, scale = (pair.new_tensor(values).view(1, 3, 1, 1) for values in (_SHIFT, _SCALE))
        x, total, heads = (2 * pair - 1 - shift) / scale, 0.0, iter(self.heads)
        for i, layer in enumerate(self.features.to(render.device)):
            x = layer(x)
            if i in _TAPS:
                unit = x / torch.sqrt(_EPSILON + x.square().sum(dim=1, keepdim=True))
                head = next(heads).to(render.device)
                total += float((head * (unit[:1] - unit[1:]).square()).sum(dim=1).mean())
        return total


def load_lpips(weights: Path | None = None) -> Lpips:
    """Load LPIPS with VGG's weights: a file or its folder, by default PyTorch's cache.

    Raises:
        MissingDependencyError: torchmetrics, which has the w_l, is absent.
        SceneNotFoundError: The weights are missing; the message names the file to download.
        SceneFormatError: The file has no weights of this network.
    """
    path, layers, before = _weights_path(weights), list[nn.Module](), 3
    with torch.device("meta"):  # random weights would change PyTorch's generator
        for channels, count in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3)):
            for _ in range(count):
                layers += [nn.Conv2d(before, channels, 3, padding=1), nn.ReLU(inplace=True)]
                before = channels
            layers.append(nn.MaxPool2d(2))
    features = nn.Sequential(*layers)
    with translate_errors(
        path, f"the weights of {LPIPS_NET} for LPIPS", fix="Download the file again."
    ):
        named = [(name.partition("."), value) for name, value in _read(path).items()]
        own = {name: value.float() for (part, _, name), value in named if part == "features"}
        features.load_state_dict(own, assign=True)
    package = find_spec("torchmetrics")  # importing it takes a second
    folder = Path(str(package.origin)).parent / "functional" / "image" / "lpips_models"  # type: ignore[union-attr]  # required above
    heads = _read(folder / f"{LPIPS_NET}.pth")
    return Lpips(features, [heads[f"lin{i}.model.1.weight"] for i in range(len(_TAPS))])


def has_lpips_weights() -> bool:
    """Whether the weights of ``load_lpips`` exist; no file is opened."""
    try:
        return _weights_path(None).is_file()
    except (MissingDependencyError, SceneNotFoundError):
        return False


def _weights_path(given: Path | None) -> Path:
    require("torchmetrics")
    folder = Path(torch.hub.get_dir()) / "checkpoints" if given is None else given
    path = folder if folder.is_file() else folder / LPIPS_FILE
    if not path.is_file():
        place = f"{folder}, or a folder" if given is None else "a folder"
        raise SceneNotFoundError(
            f"the weights for LPIPS, {path.name}",
            found="none"
            if given is None
            else f"{special_kind(given) or 'no such file'} at {given}",
            fix=f"Download {_URL}{path.name}, put it into {place}; pass its path as "
            "`lpips_weights`.",
        )
    return path


def _read(path: Path) -> dict[str, Tensor]:
    with warnings.catch_warnings(action="ignore"):  # about unknown files
        return dict(torch.load(path, map_location="cpu", weights_only=True))
