"""Checks of ``rasterization``'s arguments on the CPU; kernels rely on them to skip bounds checks.

Notation: N Gaussians, C cameras, D channels, K coefficients a channel, batch dimensions before all
of them, as in ``rasterization``. Promise: whatever the kernels could not read, and whatever only
gsplat's CUDA code does, raises one ``ParameterError`` here; nothing is ignored and nothing is
rendered first.
"""

from __future__ import annotations

from collections.abc import Mapping
from numbers import Integral
from typing import Any, get_args

import torch
from torch import Tensor

from splatseed.errors import ParameterError
from splatseed.render.blending import CHANNELS
from splatseed.render.harmonics import MAX_DEGREE

CUDA_ONLY: Mapping[str, object] = {
    "distributed": False,
    "camera_model": "pinhole",
    "segmented": False,
    "covars": None,
    "with_ut": False,
    "with_eval3d": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "ftheta_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
}
"""gsplat's further arguments with their defaults."""


def check_unsupported(arguments: Mapping[str, object]) -> None:
    """Refuse arguments that only gsplat's CUDA code supports, and unknown ones.

    Raises:
        ParameterError: An unknown name, or one of ``CUDA_ONLY`` that is not at its default.
    """
    for name, value in arguments.items():
        if name not in CUDA_ONLY:
            raise ParameterError(
                "arguments of gsplat's rasterization",
                found=repr(name),
                fix="Correct the name, or leave it out.",
            )
        # gsplat's default for the shutter is an enumeration member, recognised by its name.
        is_default = value is CUDA_ONLY[name] or getattr(value, "name", None) == "GLOBAL"
        if not is_default and not (isinstance(value, str) and value == CUDA_ONLY[name]):
            raise ParameterError(
                f"{name} to be left at its default on the CPU",
                found=_describe(value),
                fix="Render on CUDA, or leave it out.",
            )


def check_numbers(
    width: int,
    height: int,
    tile_size: int,
    near_plane: float,
    eps2d: float,
    sh_degree: int | None,
    **choices: tuple[str, object],
) -> None:
    """Check the arguments that are not tensors.

    Args:
        width: Pixels, at least 1.
        height: Pixels, at least 1.
        tile_size: Pixels, at least 1.
        near_plane: At least 0: depths sort like their bits only if not negative.
        eps2d: px^2, at least 0.
        sh_degree: None, or 0 to ``MAX_DEGREE``.
        choices: By name, a value and the ``Literal`` of those allowed.

    Raises:
        ParameterError: One is out of its range.
    """
    for name, size in (("width", width), ("height", height), ("tile_size", tile_size)):
        _require(
            isinstance(size, Integral) and int(size) >= 1, f"{name} as an int of at least 1", size
        )
    for name, number in (("near_plane", near_plane), ("eps2d", eps2d)):
        _require(number >= 0, f"{name} of at least 0", number)
    degrees = (None, *range(MAX_DEGREE + 1))
    _require(sh_degree in degrees, f"an sh_degree from 0 to {MAX_DEGREE} on the CPU", sh_degree)
    for name, (value, literal) in choices.items():
        allowed = get_args(literal)
        _require(value in allowed, f"{name} as one of {', '.join(allowed)}", value)


def check_tensors(
    colors: Tensor | tuple[Tensor, Tensor],
    tensors: Mapping[str, Tensor | None],
    sh_degree: int | None,
) -> None:
    """Check types and shapes: colors, means, quats, scales, opacities, viewmats, Ks, backgrounds.

    Raises:
        ParameterError: One is not a float32 CPU tensor, or its shape does not fit the others.
    """
    parts = colors if isinstance(colors, tuple) else (colors,)
    for name, each in (*tensors.items(), *(("colors", part) for part in parts)):
        fits = (
            isinstance(each, Tensor) and each.dtype == torch.float32 and each.device.type == "cpu"
        )
        optional = each is None and name == "backgrounds"
        _require(fits or optional, f"{name} as a float32 tensor on the CPU, like means", each)
    shapes = {name: tuple(each.shape) for name, each in tensors.items() if each is not None}
    *batch, n, _ = shapes["means"] if len(shapes["means"]) > 1 else (0, 0, 0)
    _require(0 not in batch, "means of shape [..., N, 3], no batch dimension 0", tensors["means"])
    _check_shapes(
        {"means": (*batch, n, 3), "quats": (*batch, n, 4), "scales": (*batch, n, 3),
         "opacities": (*batch, n)},
        tensors,
    )  # fmt: skip
    cameras = shapes["viewmats"][-3] if len(shapes["viewmats"]) == len(batch) + 3 else 0
    like = _words(*batch, "C", 4, 4)
    _require(cameras, f"viewmats of shape {like}, of at least one camera", tensors["viewmats"])
    leading = (*batch, cameras)
    if isinstance(colors, tuple):
        _check_pair(colors, (*batch, n), sh_degree)
    else:
        _check_colors(colors, (*batch, n), (*leading, n), sh_degree)
    _check_shapes(
        {"viewmats": (*leading, 4, 4), "Ks": (*leading, 3, 3),
         "backgrounds": (*leading, parts[0].shape[-1])},
        tensors,
    )  # fmt: skip


def _check_shapes(
    expected: Mapping[str, tuple[int, ...]], tensors: Mapping[str, Tensor | None]
) -> None:
    for name, shape in expected.items():
        found = tensors[name]
        fits = found is None or tuple(found.shape) == shape
        _require(fits, f"{name} of shape {list(shape)}", found)


def _words(*sizes: object) -> str:
    return f"[{', '.join(map(str, sizes))}]"


def _check_colors(
    colors: Any, shared: tuple[int, ...], own: tuple[int, ...], sh_degree: int | None
) -> None:
    """Colours shared by the cameras or one set per camera: the number of axes decides."""
    shape = tuple(colors.shape)
    if sh_degree is None:
        fits, ends = shape[:-1] in {shared, own} and shape[-1] >= 1, ["D"]
    else:
        terms = (sh_degree + 1) ** 2
        ends = [f"K >= {terms}", "3"]
        fits = shape[:-2] in {shared, own} and shape[-2] >= terms and shape[-1] == 3
    shapes = f"{_words(*shared, *ends)} or {_words(*own, *ends)}"
    _require(fits, f"colors of shape {shapes}", colors)


def _check_pair(colors: tuple[Tensor, ...], shared: tuple[int, ...], sh_degree: int | None) -> None:
    """The first coefficient and the rest."""
    terms = 0 if sh_degree is None else sh_degree * (sh_degree + 2)
    base, *others = (tuple(part.shape) for part in colors)
    fits = sh_degree is not None and base == (*shared, 1, 3) and len(others) == 1
    if fits:
        rest = others[0]
        fits = (*rest[:-2], *rest[-1:]) == (*shared, 3) and rest[-2] >= terms
    shapes = f"{_words(*shared, 1, 3)} and {_words(*shared, f'K >= {terms}', 3)}"
    _require(fits, f"with an sh_degree, a pair of colors of shapes {shapes}", [base, *others])


def check_absgrad(absgrad: bool, channels: int) -> None:
    """Refuse absolute gradients of more channels than one pass takes: they are not additive.

    Raises:
        ParameterError: There are more than ``CHANNELS``, depth included.
    """
    limit = f"no more than {CHANNELS} channels, depth included, with absgrad on the CPU"
    _require(not absgrad or channels <= CHANNELS, limit, channels)


def check_sparse(sparse_grad: bool, packed: bool, batch: tuple[int, ...]) -> None:
    """Refuse sparse gradients without packing or in batches, as gsplat does.

    Raises:
        ParameterError: ``sparse_grad`` without ``packed``, or with batch dimensions.
    """
    _require(packed or not sparse_grad, "packed=True with sparse_grad=True", packed)
    _require(not (sparse_grad and batch), "no batch dimensions with sparse_grad=True", list(batch))


def _require(fits: object, expected: str, found: object) -> None:
    if not fits:
        raise ParameterError(
            expected, found=_describe(found), fix="Correct the arguments of rasterization."
        )


def _describe(value: object) -> str:
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        kind = type(value).__name__
        return f"{kind} {value.dtype} {list(value.shape)} on {getattr(value, 'device', 'cpu')}"
    return repr(value)
