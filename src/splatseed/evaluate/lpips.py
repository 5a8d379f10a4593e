"""LPIPS: distance of two images in the features of a network trained on ImageNet.

Notation: f_l is the output of the l-th of 5 stages at each place, scaled to unit length over its
channels; w_l >= 0 are weights of the channels learnt from human judgements. Then

    d(x, y) = sum_l mean_places sum_c w_lc (f_lc(x) - f_lc(y))^2     (Zhang et al. 2018, eq. 1)

Promise: version 0.1 of the metric, with the weights that torchvision publishes and the w_l that
torchmetrics ships; torchvision itself is not needed; nothing is downloaded. Where weights are
absent the error says what to fetch and where to put it.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d

from splatseed.errors import MissingDependencyError, SceneFormatError, SceneNotFoundError
from splatseed.io.files import odd_kind
from splatseed.requirements import require

LpipsNet = Literal["vgg", "alex"]

# Each channel of an image in [-1, 1] becomes (value - SHIFT) / SCALE, as in the metric's code.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
EPSILON = 1e-8
"""Added to the squared length, so that features that are all 0 can be scaled."""
GIVE_PATH = "pass its path with --lpips-weights"


class Conv(NamedTuple):
    """A convolution and the ReLU behind it."""

    layer: int
    """Its place in torchvision's list, by which its weights are named."""
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Backbone:
    """A network as LPIPS uses it.

    Args:
        file: The name that PyTorch gives the file of its weights.
        pool: Size of the max-pooling windows; their stride is 2.
        pooled: The stages that begin with max-pooling.
        stages: The convolutions of each stage; features are taken after the last of each.
    """

    file: str
    pool: int
    pooled: frozenset[int]
    stages: tuple[tuple[Conv, ...], ...]

    @property
    def url(self) -> str:
        """Where the weights are published."""
        return f"https://download.pytorch.org/models/{self.file}"

    @property
    def keys(self) -> tuple[str, ...]:
        """The names of the weights that are used."""
        convs = [conv.layer for stage in self.stages for conv in stage]
        return tuple(f"features.{i}.{part}" for i in convs for part in ("weight", "bias"))


LPIPS_NETS: Mapping[str, Backbone] = MappingProxyType(
    {
        "vgg": Backbone(
            "vgg16-397923af.pth",
            2,
            frozenset({1, 2, 3, 4}),
            (
                (Conv(0), Conv(2)),
                (Conv(5), Conv(7)),
                (Conv(10), Conv(12), Conv(14)),
                (Conv(17), Conv(19), Conv(21)),
                (Conv(24), Conv(26), Conv(28)),
            ),
        ),
        "alex": Backbone(
            "alexnet-owt-7be5be79.pth",
            3,
            frozenset({1, 2}),
            ((Conv(0, 4, 2),), (Conv(3, 1, 2),), (Conv(6),), (Conv(8),), (Conv(10),)),
        ),
    }
)


class Lpips:
    """The metric with its weights, ready to compare images.

    Args:
        net: Its name, a key of ``LPIPS_NETS``.
        weights: Of the convolutions, by torchvision's names.
        heads: w_l of each stage, [1, C_l, 1, 1].
    """

    def __init__(
        self, net: LpipsNet, weights: Mapping[str, Tensor], heads: tuple[Tensor, ...]
    ) -> None:
        self.net = net
        self._weights = dict(weights)
        self._heads = heads

    @torch.no_grad()
    def __call__(self, render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
        """The distance of two images of values 0..1; 0 where they are equal."""
        self._move(render.device)
        pair = torch.stack([render, photograph]).permute(0, 3, 1, 2)
        shift, scale = (pair.new_tensor(values).view(1, 3, 1, 1) for values in (SHIFT, SCALE))
        total = 0.0
        for features, head in zip(
            self._features((2 * pair - 1 - shift) / scale), self._heads, strict=True
        ):
            length = torch.sqrt(EPSILON + features.square().sum(dim=1, keepdim=True))
            unit = features / length
            total += float((head * (unit[:1] - unit[1:]).square()).sum(dim=1).mean())
        return total

    def _features(self, images: Float[Tensor, "2 3 H W"]) -> Iterator[Float[Tensor, "2 C h w"]]:
        """The features after each stage."""
        backbone = LPIPS_NETS[self.net]
        x = images
        for number, stage in enumerate(backbone.stages):
            if number in backbone.pooled:
                x = max_pool2d(x, backbone.pool, stride=2)
            for conv in stage:
                weight, bias = (
                    self._weights[f"features.{conv.layer}.{part}"] for part in ("weight", "bias")
                )
                x = conv2d(x, weight, bias, conv.stride, conv.padding).relu_()
            yield x

    def _move(self, device: torch.device) -> None:
        self._weights = {name: value.to(device) for name, value in self._weights.items()}
        self._heads = tuple(head.to(device) for head in self._heads)


def load_lpips(net: LpipsNet = "vgg", weights: Path | None = None) -> Lpips:
    """The metric, with weights that are on this machine.

    Args:
        net: The backbone; papers on 3DGS report vgg.
        weights: The file of its weights, or the folder that it lies in; PyTorch's own cache when
            left out.

    Raises:
        MissingDependencyError: torchmetrics, which brings the w_l, is absent.
        SceneNotFoundError: There are no weights; says what to fetch, and where to put it.
        SceneFormatError: The file does not hold this network's weights.
    """
    require("torchmetrics")
    path = _weights_path(LPIPS_NETS[net], weights)
    state, heads = _read_state(path), _read_heads(net)
    _check(path, net, state, heads)
    return Lpips(net, {key: state[key].float() for key in LPIPS_NETS[net].keys}, heads)


def lpips_is_here(net: LpipsNet = "vgg") -> bool:
    """Whether all that ``load_lpips`` needs is on this machine; no file is opened."""
    try:
        require("torchmetrics")
        _weights_path(LPIPS_NETS[net], None)
    except (MissingDependencyError, SceneNotFoundError):
        return False
    return True


def _weights_path(backbone: Backbone, given: Path | None) -> Path:
    """The file of weights, which exists."""
    folder = Path(torch.hub.get_dir()) / "checkpoints" if given is None else given
    path = folder if folder.is_file() else folder / backbone.file
    if not path.is_file():
        raise SceneNotFoundError(
            f"the weights for LPIPS, {backbone.file}",
            found="none" if given is None else f"{odd_kind(given) or 'no such file'} at {given}",
            fix=f"Download {backbone.url} and put it into {folder if given is None else 'a folder'}"
            f"{', or ' if given is None else '; '}{GIVE_PATH}.",
        )
    return path


def _read_state(path: Path) -> Mapping[str, Tensor]:
    """The tensors in a file by name; no code in it is run."""
    try:
        with warnings.catch_warnings(action="ignore"):  # about what a foreign file might be
            state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # noqa: BLE001  (PyTorch raises anything for a damaged file)
        raise _misfit(path, f"a file that PyTorch cannot read ({type(error).__name__})") from None
    if not isinstance(state, Mapping):
        raise _misfit(path, f"a {type(state).__name__}")
    return state


def _read_heads(net: LpipsNet) -> tuple[Tensor, ...]:
    """The w_l that torchmetrics ships, [1, C_l, 1, 1] each."""
    spec = find_spec("torchmetrics")
    places = spec.submodule_search_locations if spec else None
    package = Path(places[0]) if places else Path()
    state = _read_state(package / "functional" / "image" / "lpips_models" / f"{net}.pth")
    stages = range(len(LPIPS_NETS[net].stages))
    return tuple(state[f"lin{stage}.model.1.weight"] for stage in stages)


def _check(path: Path, net: str, state: Mapping[str, Tensor], heads: tuple[Tensor, ...]) -> None:
    """Refuse the weights of another network."""
    backbone, channels = LPIPS_NETS[net], 3
    missing = [key for key in backbone.keys if not isinstance(state.get(key), Tensor)]
    if missing:
        raise _misfit(path, f"no {missing[0]}")
    for stage, head in zip(backbone.stages, heads, strict=True):
        for conv in stage:
            shape = tuple(state[f"features.{conv.layer}.weight"].shape)
            if len(shape) != 4 or shape[1] != channels:
                raise _misfit(path, f"features.{conv.layer}.weight of shape {list(shape)}")
            if tuple(state[f"features.{conv.layer}.bias"].shape) != shape[:1]:
                raise _misfit(path, f"features.{conv.layer}.bias of another size than its weight")
            channels = shape[0]
        if channels != head.shape[1]:
            raise _misfit(path, f"{channels} channels after layer {stage[-1].layer}")


def _misfit(path: Path, found: str) -> SceneFormatError:
    return SceneFormatError(
        f"{path} to hold the weights that LPIPS needs",
        found=found,
        fix="Download the file again, and see that it is for the network named by --lpips-net.",
    )
