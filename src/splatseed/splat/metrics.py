"""Metrics of two images [H, W, 3], values about 0..1, in PyTorch: PSNR, SSIM, FLIP and LPIPS.

LPIPS, version 0.1, is the distance of two images in the features of a network: f_l is the output of
its l-th of 5 stages, scaled to unit length over its channels; w_l >= 0 are learnt from human
judgements, and d(x, y) = sum_l mean_places sum_c w_lc (f_lc(x) - f_lc(y))^2 (Zhang et al. 2018, eq.
1). The networks' weights are torchvision's, the w_l torchmetrics'; torchmetrics makes the networks
by torchvision, which is tied to one version of PyTorch, so that they are made here. Nothing is
downloaded. Promise: on a GPU only what returns a Python number waits for it.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32
from torch import Tensor, nn
from torch.nn.functional import conv2d, conv_transpose2d, pad

from splatseed.errors import MissingDependencyError, SceneNotFoundError
from splatseed.io.files import special_kind, translate_errors
from splatseed.requirements import require
from splatseed.splat.ssim import C1, C2, WINDOW, l1_and_ssim, window_weights

LPIPS_NET, LPIPS_FILE = "vgg", "vgg16-397923af.pth"
"""The network of LPIPS, which papers on 3DGS report, and PyTorch's name for the file of weights."""
_URL = "https://download.pytorch.org/models/"
_TAPS = (3, 8, 15, 22, 29)  # the layers whose output is compared
# Each channel of an image in [-1, 1] becomes (value - SHIFT) / SCALE, as in the metric's code.
_SHIFT = (-0.030, -0.088, -0.188)
_SCALE = (0.458, 0.448, 0.450)
_UNSATURATED = 0.5 / 255
"""Least distance of a value from 0 and from 1 at which a camera has not cut it off."""
_CORRECTIONS = 5
"""Fits of a render's colours to a photograph's: after each, other pixels are saturated."""
_EPSILON = 1e-8
"""Added to the squared length, so that features that are all 0 can be scaled."""


@torch.no_grad()
def psnr(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """Peak signal-to-noise ratio in dB of a render clamped to [0, 1], over the pixels of a mask.

    NaN if there are none.
    """
    error = (render.clamp(0, 1) - photograph).square()
    error = error if mask is None else error[mask]
    if not error.numel():
        return math.nan
    if error.device.type == "cpu":  # the last digits of PyTorch's depend on the number of threads
        mean = float(np.mean(error.numpy(), dtype=np.float64))
    else:
        mean = float(error.mean(dtype=torch.float64))
    return -10 * math.log10(mean) if mean else math.inf


@torch.no_grad()
def color_corrected(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> Float[Tensor, "H W 3"]:
    """A render in [0, 1] with the change of its colours that brings it closest to a photograph.

    Each channel becomes the quadratic polynomial of the render's three that fits best in least
    squares, over the pixels of the mask whose channel is saturated in neither image; this is
    repeated on the result. It is multinerf's ``color_correct`` (Barron et al. 2022), which
    nerfstudio has too, and gsplat's ``color_correct_quadratic``, in double precision; of equally
    good polynomials the one of least norm is taken, so that a render of one colour has one.
    """
    x, y = (image.reshape(-1, 3).T.double() for image in (render.clamp(0, 1), photograph))
    usable = _unsaturated(x) & _unsaturated(y)
    if mask is not None:
        usable &= mask.reshape(-1)
    for _ in range(_CORRECTIONS):
        r, g, b = x
        terms = torch.stack([r * r, r * g, r * b, g * g, g * b, b * b, r, g, b, torch.ones_like(r)])
        fits = []
        for target, valid in zip(y, usable & _unsaturated(x), strict=True):
            known = terms * valid
            inverse = torch.linalg.pinv(known @ terms.T, rtol=1e-12, hermitian=True)
            fits.append(inverse @ (known @ target))
        x = (torch.stack(fits) @ terms).clamp(0, 1)
    return x.T.reshape(render.shape).to(render.dtype)


def _unsaturated(values: Float[Tensor, "3 P"]) -> Bool[Tensor, "3 P"]:
    return (values >= _UNSATURATED) & (values <= 1 - _UNSATURATED)


@torch.no_grad()
def l1_and_ssim_by_convolution(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    l1_weight: float,
    ssim_weight: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""], Float[Tensor, "H W 3"]]:
    """``splat.ssim.l1_and_ssim`` on any device, by convolutions; its header has the equations."""
    x, y = render.permute(2, 0, 1), photograph.permute(2, 0, 1)
    c1, c2 = float(C1), float(C2)
    # cuDNN's TF32 would round inputs to ten bits, and E[x^2] - E[x]^2 cancel.
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        planes = torch.stack([x, y, x * y, torch.addcmul(y * y, x, x)])
        mean_x, mean_y, e_xy, e_2 = _blur(planes)
        product = mean_x * mean_y
        squares = torch.addcmul(mean_y * mean_y, mean_x, mean_x)
        half_a1 = product + c1 / 2
        half_a2 = (e_xy - product).add_(c2 / 2)
        b1, b2 = squares + c1, (e_2 - squares).add_(c2)
        # dS/de_xy = 2 A1 / (B1 B2), and S is that times A2 / 2.
        inverse = 4 / (b1 * b2)
        by_xy = half_a1 * inverse
        similarity = by_xy * half_a2
        by_2 = similarity / b2  # -dS/de_2
        # dS/dmu_x = 2 mu_y (A2 - A1) / (B1 B2) + 2 S mu_x (1 / B2 - 1 / B1)
        by_mean = torch.addcmul(
            (half_a2 - half_a1).mul_(mean_y).mul_(inverse), mean_x, by_2 - similarity / b1, value=2
        )
        of_mean, of_xy, of_2 = _spread(torch.stack([by_mean, by_xy, by_2]))
    gradient = torch.addcmul(of_mean, y, of_xy).addcmul_(x, of_2, value=-2)
    difference = x - y
    gradient.mul_(-ssim_weight / similarity.numel())
    gradient.add_(difference.sign(), alpha=l1_weight / difference.numel())
    return difference.abs_().mean(), similarity.mean(), gradient.permute(1, 2, 0)


def _ssim_map(x: Float[Tensor, "H W 3"], y: Float[Tensor, "H W 3"]) -> Float[Tensor, "3 H-10 W-10"]:
    """SSIM wherever the window fits, as in ``splat.ssim``'s header."""
    x, y = x.permute(2, 0, 1), y.permute(2, 0, 1)
    with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        mean_x, mean_y, e_xy, e_2 = _blur(torch.stack([x, y, x * y, x * x + y * y]))
    product, squares = mean_x * mean_y, mean_x**2 + mean_y**2
    c1, c2 = float(C1), float(C2)
    upper = (2 * product + c1) * (2 * (e_xy - product) + c2)
    ssim: Tensor = upper / ((squares + c1) * (e_2 - squares + c2))
    return ssim


def _blur(planes: Float[Tensor, "P 3 H W"]) -> Float[Tensor, "P 3 H-10 W-10"]:
    """Windowed means where the window fits entirely."""
    across, down = _window(planes.device)
    blurred = conv2d(conv2d(planes.flatten(0, 1).unsqueeze(1), down), across)
    return blurred.view(*planes.shape[:2], *blurred.shape[2:])


def _spread(maps: Float[Tensor, "P 3 h w"]) -> Float[Tensor, "P 3 h+10 w+10"]:
    """The transpose of ``_blur``."""
    across, down = _window(maps.device)
    spread = conv_transpose2d(conv_transpose2d(maps.flatten(0, 1).unsqueeze(1), across), down)
    return spread.view(*maps.shape[:2], *spread.shape[2:])


@lru_cache
def _window(device: torch.device) -> tuple[Float[Tensor, "1 1 1 11"], Float[Tensor, "1 1 11 1"]]:
    """The window along x and along y, kept on the device: copying it there would wait."""
    weights = torch.from_numpy(window_weights()).to(device)
    return weights.view(1, 1, 1, WINDOW), weights.view(1, 1, WINDOW, 1)


@torch.no_grad()
def ssim_of_all(
    render: Float[Tensor, "H W 3"],
    photograph: Float[Tensor, "H W 3"],
    mask: Bool[Tensor, "H W"] | None = None,
) -> float:
    """SSIM averaged over all pixels, or those of a mask; a mirrored margin lets the window fit.

    Where masked, the render should have the photograph's pixels (``rendering.fill_masked``).
    """
    margin = [WINDOW // 2] * 4
    x, y = (
        pad(image.clamp(0, 1).permute(2, 0, 1), margin, mode="reflect").permute(1, 2, 0)
        for image in (render, photograph)
    )
    if mask is not None:
        return float(_ssim_map(x, y)[:, mask].mean())
    if render.device.type != "cpu":
        return float(l1_and_ssim_by_convolution(x, y, 0.0, 1.0)[1])
    return float(l1_and_ssim(x.contiguous().numpy(), y.contiguous().numpy(), 0.0, 1.0)[1])


@torch.no_grad()
def flip_map(
    render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]
) -> Float32[np.ndarray, "H W"]:
    """FLIP of each pixel: how different two images look when one replaces the other, 0 to 1.

    It is LDR-FLIP for a screen with 67 pixels per degree of the eye's field, computed on the CPU
    by its authors' package (Andersson et al. 2020). Images are sRGB, clamped to [0, 1].

    Raises:
        MissingDependencyError: flip-evaluator is absent.
    """
    require("flip_evaluator")
    from flip_evaluator import evaluate  # noqa: PLC0415  (only FLIP needs it)

    images = (each.clamp(0, 1).cpu().contiguous().numpy() for each in (photograph, render))
    errors, _, _ = evaluate(*images, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(errors[..., 0])


@dataclass(frozen=True, eq=False)
class Lpips:
    """LPIPS with its weights, ready to compare images."""

    features: nn.Sequential  # the network's convolutions, in torchvision's order
    heads: list[Tensor]  # w_l of each stage, [1, C_l, 1, 1]

    @torch.no_grad()
    @torch.backends.cudnn.flags(enabled=True, allow_tf32=False)  # the score of any other device
    def __call__(self, render: Float[Tensor, "H W 3"], photograph: Float[Tensor, "H W 3"]) -> float:
        """The distance of two images of values 0..1; 0 where they are equal."""
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
    """LPIPS with VGG's weights, a file or the folder it lies in, by default in PyTorch's cache.

    Raises:
        MissingDependencyError: torchmetrics, which brings the w_l, is absent.
        SceneNotFoundError: There are no weights; says what to fetch, and where to put it.
        SceneFormatError: The file does not hold this network's weights.
    """
    path, layers, before = _weights_path(weights), list[nn.Module](), 3
    with torch.device("meta"):  # no random weights first: they would change PyTorch's generator
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


def lpips_is_here() -> bool:
    """Whether all that ``load_lpips`` needs is on this machine; no file is opened."""
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
    with warnings.catch_warnings(action="ignore"):  # about what a foreign file might be
        return dict(torch.load(path, map_location="cpu", weights_only=True))
